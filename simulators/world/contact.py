"""The switch of the stylus: when it closed and opened, found only when somebody asks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from estimation.transform import FloatArray
from simulators.world.kinematics import Triple
from simulators.world.truth import stream
from simulators.world.world import World

SHORTEST_STEP_S: Final = 2e-3  # nobody touches and lets go within; the instant itself is found by bisection
LONGEST_STEP_S: Final = 0.3
REARM_M: Final = 1e-4  # away from the surface, the next contact has a scatter of its own
MOMENT_S: Final = 1e-4  # in which the present speed of the ball is found
CONTACT_TIME_S: Final = 1e-6  # to which an instant of contact is found


class MovingArm(Protocol):
    """The moving arm, as far as the stylus must know it."""

    def advance(self, time_s: float) -> None:
        """Let everything happen that is due by then."""

    def joints_at(self, time_s: float) -> FloatArray:
        """True joint angles (n,) at a past instant, rad."""

    def course(self, time_s: float) -> tuple[Sequence[float], Sequence[float], float]:
        """Speeds and accelerations (n,) of the joints then, rad/s and rad/s^2; until when the latter hold."""

    def plans(self) -> int:
        """Changes whenever the planned motion does."""


@dataclass(frozen=True, slots=True)
class Touch:
    """One closing of the contact."""

    time_s: float
    surface: str


class StylusContact:
    """Follows the gap between ball and world with steps that no motion of the arm can overtake."""

    def __init__(self, world: World, arm: MovingArm) -> None:
        self._world, self._arm = world, arm
        self._reaches: list[float] = world.ball_reaches_m().tolist()
        self._noise = stream(world.truth.seed, "noise.probe")
        self.count = 0  # closings since power-on
        self.touches: list[Touch] = []
        self.deepest_m = 0.0  # how far the stylus was ever pushed in
        self._released = False
        self._draw_scatter()
        self._time_s, self._safe_s = 0.0, -math.inf  # the gap is known then; no change until then
        self._plans, self._revision = -1, world.revision
        self._ball_m = self._ball(0.0)
        self._gap_m, _ = self._gap(self._ball_m)
        self.closed = self._gap_m <= 0

    def _draw_scatter(self) -> None:
        touch, flat = self._noise.standard_normal(2).tolist()
        file = self._world.file
        self._scatter_m = touch * file.probe.noise_m * self._world.noise_factor
        self._flat_m = flat * file.plate.flatness_m * self._world.noise_factor

    def _ball(self, time_s: float) -> Triple:
        return self._world.ball(self._arm.joints_at(time_s))

    def _gap(self, ball: Triple) -> tuple[float, str]:
        """Smallest gap, including the scatter of this contact: it closes at zero."""
        nearest, smallest = "", math.inf
        for name, gap in self._world.ball_clearances_m(ball):
            if name == "plate":
                gap -= self._flat_m
            if gap < smallest:
                nearest, smallest = name, gap
        return smallest - self._scatter_m, nearest

    def update(self, time_s: float) -> None:
        """Find every closing and opening up to then."""
        self._arm.advance(time_s)
        plans = self._arm.plans()
        if self._revision != self._world.revision:  # something was moved by hand: look again
            self._revision, self._time_s, self._safe_s = self._world.revision, time_s, -math.inf
            self._look(time_s)
        if time_s < self._safe_s and plans == self._plans:
            return
        self._plans = plans
        while True:
            self._safe_s = self._unchanged_until_s()
            if self._safe_s > time_s or self._time_s >= time_s:
                return
            self._look(min(max(self._safe_s, self._time_s + SHORTEST_STEP_S), time_s))

    def first_closing(self, since_s: float, until_s: float) -> float | None:
        """When the contact closed first in this time."""
        self.update(until_s)
        return next((t.time_s for t in self.touches if since_s <= t.time_s <= until_s), None)

    def unchanged_until_s(self, time_s: float) -> float:
        """`closed` does not change before this, as long as the arm does what it plans at `time_s`."""
        self.update(time_s)
        return self._safe_s

    def depths_m(self, times_s: FloatArray) -> FloatArray:
        """How far the stylus was pressed in at past instants (n,); 0 where it was free."""
        self.update(float(times_s[-1]))
        gaps = [self._gap(self._ball(time_s))[0] for time_s in times_s.tolist()]
        depths: FloatArray = np.maximum(-np.array(gaps), 0.0)
        return depths

    def _unchanged_until_s(self) -> float:
        """The contact cannot change before: so long at least the ball needs for the way to a change."""
        time_s = self._time_s
        way_m = self._world.file.probe.release_m - self._gap_m if self.closed else self._gap_m
        speeds, accelerations, until_s = self._arm.course(time_s)
        speed = self._ball_speed(speeds)
        while way_m > 0 and time_s < math.inf:
            moves = any(speeds) or any(accelerations)
            duration_s = min(until_s - time_s, LONGEST_STEP_S if moves else math.inf)
            after = (
                [w + a * duration_s for w, a in zip(speeds, accelerations, strict=True)] if moves else speeds
            )
            fastest = [max(abs(w), abs(v)) for w, v in zip(speeds, after, strict=True)]
            change = self._round_the_axes(fastest) + self._reach(accelerations)
            way_s = 2 * way_m / (speed + math.sqrt(speed**2 + 2 * change * way_m) + 1e-12)
            if way_s <= duration_s:
                return time_s + way_s
            way_m -= (speed + change * duration_s / 2) * duration_s
            time_s += duration_s
            speeds, accelerations, until_s = self._arm.course(time_s)
            jumps = self._reach([now - v for now, v in zip(speeds, after, strict=True)])
            speed += change * duration_s + jumps
        return time_s

    def _ball_speed(self, speeds: Sequence[float]) -> float:
        """Of the ball, when the joints have these speeds."""
        if not any(speeds):
            return 0.0
        there = self._world.ball(self._arm.joints_at(self._time_s) + MOMENT_S * np.array(speeds))
        bend = self._round_the_axes([abs(w) for w in speeds])
        return math.dist(self._ball_m, there) / MOMENT_S + bend * MOMENT_S / 2

    def _round_the_axes(self, speeds: Sequence[float]) -> float:
        """The most that turning at these speeds (not negative) accelerates the ball, m/s^2.

        Axis i bends what axis j does to the ball; the lever is that of whichever is nearer to the ball.
        """
        bend = before = 0.0
        for speed, reach in zip(speeds, self._reaches, strict=True):
            bend += reach * speed * (speed + 2.0 * before)
            before += speed
        return bend

    def _reach(self, changes: Sequence[float]) -> float:
        """The most that changes of all joints can be at the ball."""
        return sum([abs(change) * reach for change, reach in zip(changes, self._reaches, strict=True)])

    def _look(self, time_s: float) -> None:
        before_s, self._time_s = self._time_s, time_s
        self._ball_m = ball = self._ball(time_s)
        self._gap_m, surface = self._gap(ball)
        if self.closed:
            self.deepest_m = max(self.deepest_m, -self._gap_m)
            if self._gap_m >= self._world.file.probe.release_m:
                self.closed, self._released = False, True
        elif self._released and self._gap_m >= REARM_M:
            self._released = False
            self._draw_scatter()
            self._gap_m, _ = self._gap(ball)
        elif self._gap_m <= 0:
            self.closed = True
            self.count += 1
            self.touches.append(Touch(self._instant(before_s, time_s), surface))

    def _instant(self, open_s: float, closed_s: float) -> float:
        while closed_s - open_s > CONTACT_TIME_S:
            middle = (open_s + closed_s) / 2
            open_s, closed_s = (
                (open_s, middle) if self._gap(self._ball(middle))[0] <= 0 else (middle, closed_s)
            )
        return closed_s
