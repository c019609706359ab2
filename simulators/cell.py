"""One simulated cell: world, truth and the three devices, put together for a seed and a scenario."""

from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import CellFileError
from simulators.device_kind import DeviceKind, Setting, Simulated
from simulators.probes.kinds import PROBES, Stylus, stylus_of
from simulators.registry import choose
from simulators.robots.canopen_arm import SimulatedArm
from simulators.robots.kinds import ROBOTS, Mechanics
from simulators.robots.mechanism import MechanicalArm
from simulators.sensors.kinds import LASERS, Optics
from simulators.world.contact import StylusContact
from simulators.world.truth import draw_truth, stream
from simulators.world.world import World
from simulators.world.world_file import ProbeSpec, read_world_file


class CellModel:
    """The devices, wired to one world.

    `robot`, `laser` and `probe` name the drivers that shall find their devices; behind each protocol are the
    same mechanical arm, beam and stylus.
    `motion_speed` shortens fast moves; `error_factor` and `noise_factor` 0 make a nominal, silent cell.
    Raises CellFileError.
    """

    def __init__(
        self,
        world_dir: Path,
        seed: int,
        scenario: str = "honest",
        motion_speed: float = 1.0,
        error_factor: float = 1.0,
        noise_factor: float = 1.0,
        cache_dir: Path | None = None,
        robot: str = "canopen-402",
        laser: str = "optoncdt-1420",
        probe: str = "adam-6052",
    ) -> None:
        self.file = file = read_world_file(world_dir)
        if scenario not in file.scenarios:
            known = ", ".join(file.scenarios)
            raise CellFileError(f"No scenario {scenario!r} in world.toml", f"Choose one of {known}")
        self.scenario = file.scenarios[scenario]
        self.truth = draw_truth(file, seed, error_factor)
        joints = len(file.arm.nodes)
        factors = np.array(self.scenario.joint_noise_factors or [1.0] * joints) * noise_factor
        mechanics = Mechanics(file.arm, stream(seed, "noise.joints"), factors, motion_speed)
        robot_kind = choose(robot, "robot", ROBOTS)
        wired_robot = robot_kind.make(robot_kind.settings, mechanics)
        self.arm: MechanicalArm = wired_robot.model
        self.world = World(file, self.truth, self.arm, noise_factor, self.scenario.part_present, cache_dir)
        truth = self.truth
        rng = stream(seed, "noise.laser.reading")
        optics = Optics(file.laser, self.world, truth.laser_scale, truth.laser_offset_m, rng, noise_factor)
        laser_kind = choose(laser, "laser", LASERS)
        self.contact = StylusContact(self.world, self.arm)
        if file.arm.touch_probe and isinstance(self.arm, SimulatedArm):
            self.arm.wire_touch_inputs(self.contact.first_closing)
        stylus = stylus_of(self.contact, stream(seed, "noise.probe.reading"))
        probe_kind = choose(probe, "probe", PROBES)
        self.devices: dict[str, Simulated] = {
            "robot": wired_robot,
            "laser": laser_kind.make(laser_kind.settings, optics),
            "probe": probe_kind.make(_wired_to(file.probe, probe_kind), stylus),
        }

    @property
    def laser(self) -> Any:
        """The simulated laser, for those who know its kind."""
        return self.devices["laser"].model

    @property
    def probe(self) -> Any:
        """The simulated probe, for those who know its kind."""
        return self.devices["probe"].model

    def bump(self) -> None:
        """Knock the laser as the scenario says."""
        self.world.bump_laser(self.scenario.bump_translation_m, self.scenario.bump_rotation_rad)

    def truth_json(self) -> dict[str, Any]:
        """What only the demo and the tests may know."""
        bump = [*self.scenario.bump_translation_m.tolist(), *self.scenario.bump_rotation_rad.tolist()]
        return {**self.truth.to_json(), "scenario": self.scenario.name, "bump": bump}


def _wired_to(spec: ProbeSpec, kind: DeviceKind[Stylus]) -> dict[str, Setting]:
    """The settings of this kind, with what the world says of them."""
    said: dict[str, Setting] = {"channel": spec.channel, "reply_delay_ms": spec.reply_delay_s * 1e3}
    return {key: said.get(key, value) for key, value in kind.settings.items()}
