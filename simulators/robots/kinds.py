"""Which robots can be simulated, by the name of their driver in the cell file."""

from collections.abc import Callable
from typing import Final

import numpy as np

from estimation.errors import CellFileError
from estimation.transform import FloatArray
from simulators.robots.abb import AbbRobot
from simulators.robots.canopen_arm import SimulatedArm
from simulators.robots.igus_irc import IgusRobot
from simulators.robots.mechanism import MechanicalArm
from simulators.robots.melfa import MelfaRobot, MelfaSettings
from simulators.robots.ur import UrRobot
from simulators.world.world_file import ArmSpec

Make = Callable[[ArmSpec, np.random.Generator, FloatArray | None, float], MechanicalArm]


def _melfa_serial(
    spec: ArmSpec, rng: np.random.Generator, noise_factors: FloatArray | None, motion_speed: float
) -> MelfaRobot:
    return MelfaRobot(spec, rng, noise_factors, motion_speed, MelfaSettings(baud=9600))


ROBOTS: Final[dict[str, Make]] = {
    "abb-open": AbbRobot,
    "canopen-402": SimulatedArm,
    "igus-irc": IgusRobot,
    "melfa-serial": _melfa_serial,
    "melfa-tcp": MelfaRobot,
    "ur": UrRobot,
}


def make_robot(
    kind: str,
    spec: ArmSpec,
    rng: np.random.Generator,
    noise_factors: FloatArray | None = None,
    motion_speed: float = 1.0,
) -> MechanicalArm:
    """The simulated robot of this kind. Raises CellFileError if there is none."""
    if kind not in ROBOTS:
        raise CellFileError(f"No simulator for robot {kind!r}", f"Choose one of {', '.join(ROBOTS)}")
    return ROBOTS[kind](spec, rng, noise_factors, motion_speed)
