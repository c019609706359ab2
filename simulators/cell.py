"""One simulated cell: world, truth and the three devices, put together for a seed and a scenario."""

from pathlib import Path
from typing import Any

import numpy as np

from estimation.errors import CellFileError
from simulators.probes.kinds import make_probe
from simulators.robots.kinds import make_robot
from simulators.sensors.kinds import Optics, make_laser
from simulators.world.contact import StylusContact
from simulators.world.truth import draw_truth, stream
from simulators.world.world import World
from simulators.world.world_file import read_world_file


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
        self.arm = make_robot(robot, file.arm, stream(seed, "noise.joints"), factors, motion_speed)
        self.world = World(file, self.truth, self.arm, noise_factor, self.scenario.part_present, cache_dir)
        truth = self.truth
        rng = stream(seed, "noise.laser.reading")
        optics = Optics(file.laser, self.world, truth.laser_scale, truth.laser_offset_m, rng, noise_factor)
        self.laser_wire = make_laser(laser, optics)
        self.contact = StylusContact(self.world, self.arm)
        self.probe_wire = make_probe(probe, self.contact, file.probe, stream(seed, "noise.probe.reading"))
        self.laser, self.probe = self.laser_wire.model, self.probe_wire.model

    def bump(self) -> None:
        """Knock the laser as the scenario says."""
        self.world.bump_laser(self.scenario.bump_translation_m, self.scenario.bump_rotation_rad)

    def truth_json(self) -> dict[str, Any]:
        """What only the demo and the tests may know."""
        bump = [*self.scenario.bump_translation_m.tolist(), *self.scenario.bump_rotation_rad.tolist()]
        return {**self.truth.to_json(), "scenario": self.scenario.name, "bump": bump}
