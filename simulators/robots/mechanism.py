"""The mechanical arm: axes with planned motion, and what is true of them, whatever protocol moves them."""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Final

import numpy as np

from estimation.transform import FloatArray
from simulators.interfaces import ByteDevice
from simulators.robots.motion_profile import AxisMotion

NOISE_BLOCK: Final = 4096


class MechanicalArm:
    """Joints at any instant up to the present. A robot simulator is one of these with a protocol in front.

    `motions` (n,) are the axes from the base outwards; they count in units of `unit_rad`.
    """

    def __init__(self, motions: Sequence[AxisMotion], unit_rad: float) -> None:
        self._motions, self._unit_rad = list(motions), unit_rad

    def advance(self, time_s: float) -> None:
        """Let everything happen that is due by then."""

    def permit(self, permitted: bool, time_s: float) -> None:
        """Give or take the run permission (emergency stop, guard door)."""
        raise NotImplementedError

    def fault(self, joint: int, code: int, time_s: float) -> None:
        """Let the robot fail with an error code of its own."""
        raise NotImplementedError

    def restart(self, time_s: float) -> None:
        """The supply drops for a moment."""
        raise NotImplementedError

    def connections(self) -> dict[str, Callable[[], ByteDevice]]:
        """What a client finds at each socket of this robot, "" being the main one; none on a CAN bus."""
        return {}

    def joints_at(self, time_s: float) -> FloatArray:
        """True joint angles (n,) at any instant up to the present, rad."""
        positions = [motion.position(time_s) for motion in self._motions]
        return np.array(positions) * self._unit_rad

    def standstill(self, time_s: float) -> tuple[int, ...] | None:
        """Which standstill this instant belongs to; None while a joint moves."""
        if any(motion.moving(time_s) for motion in self._motions):
            return None
        return tuple([motion.phase_number(time_s) for motion in self._motions])

    def course(self, time_s: float) -> tuple[list[float], list[float], float]:
        """Speeds and accelerations (n,) then, rad/s and rad/s^2; until when the latter hold, as known now."""
        unit = self._unit_rad
        speeds, accelerations, ends = zip(*[motion.course(time_s) for motion in self._motions], strict=True)
        return [v * unit for v in speeds], [a * unit for a in accelerations], min(ends)

    def plans(self) -> int:
        """Changes whenever the plan of any joint does."""
        return sum([motion.plans for motion in self._motions])


def reading_noise(rng: np.random.Generator, sigma: float) -> Callable[[], float]:
    """Errors of one joint's readings one after the other, drawn in blocks because one by one is slow."""
    own = rng.spawn(1)[0]

    def blocks() -> Iterator[list[float]]:
        while True:
            yield (own.standard_normal(NOISE_BLOCK) * sigma).tolist()

    return chain.from_iterable(blocks()).__next__
