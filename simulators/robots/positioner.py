"""How a drive moves: profile position (mode 1) and interpolated position (mode 7) of CiA 402."""

import math
from typing import Final

from simulators.canopen_objects import Key, Value
from simulators.robots.motion_profile import AxisMotion, Phase, plan_move, plan_stop

PROFILE_POSITION: Final = 1
INTERPOLATED: Final = 7


class Positioner:
    """Set-points, halt and limits of one axis; counts and counts/s. `values` are the drive's objects."""

    def __init__(
        self, motion: AxisMotion, values: dict[Key, Value], speed_limit: float, time_s: float
    ) -> None:
        self._motion, self._values, self._speed_limit = motion, values, speed_limit
        self._acknowledged = False  # bit 4 was taken and still stands
        self._buffered: float | None = None  # set-point that waits for the present one
        self._halted = self._limited = False
        self._factor = 1.0  # of motion speed, of the present move
        self._target = motion.position(time_s)

    def status_bits(self, mode: int, interpolating: bool, time_s: float) -> int:
        """Bits 10 to 12 of the statusword."""
        word = 0x800 if self._limited else 0
        if mode == PROFILE_POSITION:
            if self._buffered is None and not self._motion.moving(time_s):
                word |= 0x400
            if self._acknowledged or self._buffered is not None:
                word |= 0x1000
        elif interpolating:
            word |= 0x1000
        return word

    @property
    def buffered_start_s(self) -> float:
        """When the set-point that waits for the present move starts."""
        return self._motion.end_s if self._buffered is not None and not self._halted else math.inf

    def start_buffered(self, time_s: float) -> None:
        """The present move has ended: go on with the one that waits."""
        if self._buffered is not None:
            self._target, self._buffered = self._buffered, None
            self.start(time_s, self._factor)

    def release_set_point(self) -> None:
        """The master has taken bit 4 back."""
        self._acknowledged = False

    def control(self, word: int, rising: int, time_s: float) -> bool:
        """Mode 1: act on a controlword and its rising bits; True if a move waits to be started."""
        starts = False
        if word & 0x100 and not self._halted:
            self._halted, self._buffered = True, None
            self.stop(float(self._values[0x6083, 0]), time_s)
        elif self._halted and not word & 0x100:
            self._halted = False
            starts = True  # CiA 402: the interrupted positioning goes on
        if rising & 0x10:
            target = float(self._values[0x607A, 0])
            if word & 0x40:
                target += self._motion.position(time_s)
            self._acknowledged = True
            if self._motion.moving(time_s) and not word & 0x20 and not self._halted:
                self._buffered = target
            else:
                self._target, self._buffered = target, None
                starts = not self._halted
        return starts

    def waiting_speed(self, time_s: float) -> float:
        """Profile velocity of the move that waits to be started; 0 if it leads nowhere."""
        still = self._target == self._motion.position(time_s)
        return 0.0 if still else min(float(self._values[0x6081, 0]), self._speed_limit)

    def _reachable(self, target: float) -> float:
        lower, upper = int(self._values[0x607D, 1]), int(self._values[0x607D, 2])
        reachable = min(max(target, lower), upper)
        self._limited = reachable != target
        return reachable

    def start(self, time_s: float, factor: float) -> None:
        """Start the move that waits, its time divided by `factor`."""
        self._factor = factor
        target = self._reachable(self._target)
        speed = min(float(self._values[0x6081, 0]), self._speed_limit) * factor
        acceleration = float(self._values[0x6083, 0]) * factor**2
        motion = self._motion
        position, velocity = motion.position(time_s), motion.velocity(time_s)
        if speed > 0 and acceleration > 0:
            motion.follow(plan_move(time_s, position, velocity, target, speed, acceleration))

    def interpolate(self, period_s: float, time_s: float) -> bool:
        """Mode 7, at a SYNC: go to 60C1h:01 within the period. False if that is a following error."""
        position = self._motion.position(time_s)
        target = self._reachable(float(self._values[0x60C1, 1]))
        if abs(target - position) > float(self._values[0x6065, 0]):
            return False
        if target != position and period_s > 0:
            end = Phase(time_s + period_s, target, 0.0, 0.0)
            self._motion.follow([Phase(time_s, position, (target - position) / period_s, 0.0), end])
        return True

    def stop(self, deceleration: float, time_s: float) -> None:
        """Come to rest, in a move that was sped up as much sooner; forgets a set-point that waits."""
        self._buffered = None
        motion = self._motion
        if motion.moving(time_s):
            position, velocity = motion.position(time_s), motion.velocity(time_s)
            motion.follow(plan_stop(time_s, position, velocity, max(deceleration, 1.0) * self._factor**2))
