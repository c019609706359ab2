"""A robot driver against its simulator in virtual time: what the tests of all such robots start from."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from controller.cellfile.robots import Robot as RobotTable
from controller.robots import make_robot
from drivers.capabilities import Robot
from simulators.robots.controlled_arm import ControlledArm
from simulators.virtual import SimulatedCell, VirtualByteLink

CELL = Path(__file__).parents[3] / "cells" / "bench-block"
COARSE = {"max_speed": "90 deg/s", "in_position": "0.02 deg", "encoder_step": "0.01 deg"}
MELFA_TCP: dict[str, Any] = COARSE | {
    "driver": "melfa-tcp", "host": "127.0.0.1", "stop_port": 10002, "model": "RV-4FL-D"
}  # fmt: skip
MELFA_SERIAL: dict[str, Any] = COARSE | {
    "driver": "melfa-serial", "port": "/dev/ttyUSB0", "model": "RV-4FL-D"
}  # fmt: skip
IGUS: dict[str, Any] = COARSE | {"driver": "igus-irc", "host": "127.0.0.1", "model": "iRC"}
UR: dict[str, Any] = {
    "driver": "ur", "host": "127.0.0.1", "model": "UR5", "serial_number": "20235500123"
}  # fmt: skip
ABB: dict[str, Any] = {
    "driver": "abb-open", "host": "127.0.0.1", "model": "IRB 1400", "reach": "900 mm",
    "in_position": "0.02 deg", "encoder_step": "0.01 deg",
}  # fmt: skip
OF_CANOPEN = ("port", "interface", "bitrate", "nodes", "sync_period", "cruise_sync_period")


def frozen(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: frozen(child) for key, child in value.items()}
    return tuple(frozen(child) for child in value) if isinstance(value, list) else value


class RobotRig:
    """One simulated cell with this robot in it, and the driver that a cell file would make for it."""

    def __init__(self, cache: Path, settings: dict[str, Any], noise_factor: float = 1.0) -> None:
        table = tomllib.loads((CELL / "cell.toml").read_text())["robot"]
        table = {key: value for key, value in table.items() if key not in OF_CANOPEN} | settings
        self.table: RobotTable = TypeAdapter(RobotTable).validate_python(frozen(table))
        self.world = SimulatedCell(
            CELL, seed=5, cache_dir=cache, robot=self.table.driver, noise_factor=noise_factor
        )
        self.clock = self.world.clock
        self.robot: Robot = make_robot(self.table, self.world.ports, self.clock, keep_alive_thread=False)

    @property
    def arm(self) -> ControlledArm:
        arm = self.world.arm
        assert isinstance(arm, ControlledArm)
        return arm

    def link(self, name: str = "robot") -> VirtualByteLink:
        link = self.world.ports.links[name]
        assert isinstance(link, VirtualByteLink)
        return link

    def change(self, **settings: Any) -> None:
        """Other settings of the simulated controller."""
        arm: Any = self.arm
        arm.settings = replace(arm.settings, **settings)

    def sent(self) -> list[bytes]:
        """What is sent from now on."""
        sent, link = list[bytes](), self.link()
        write = link.write

        def logged(data: bytes) -> None:
            sent.append(data)
            write(data)

        link.write = logged  # type: ignore[method-assign]
        return sent

    def truth_rad(self) -> Any:
        return self.arm.joints_at(self.clock.now_s())


class TimedProbe:
    """A probe that is touched at an instant; polled every 4 ms."""

    poll_uncertainty_s = 0.006

    def __init__(self, rig: RobotRig, touched_s: float) -> None:
        self._rig, self.contact_s = rig, touched_s

    def touched_at_s(self) -> float | None:
        self._rig.clock.sleep(0.004)
        now = self._rig.clock.now_s()
        return now if now >= self.contact_s else None

    def is_open(self) -> bool:
        return True

    def arm(self) -> None:
        pass
