"""The switch of the stylus: when it closed and opened, found only when somebody asks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from estimation.transform import FloatArray
from simulators.truth import stream
from simulators.world import World

SHORTEST_STEP_S: Final = 2e-3  # nobody touches and lets go within; the instant itself is found by bisection
LONGEST_STEP_S: Final = (
    0.1  # the motion looked ahead; a slow touch must not be paced by the fast move after it
)
REARM_M: Final = 1e-4  # away from the surface, the next contact has a scatter of its own
CONTACT_TIME_S: Final = 1e-6  # to which an instant of contact is found


class MovingArm(Protocol):
    """The moving arm, as far as the stylus must know it."""

    def advance(self, time_s: float) -> None:
        """Let everything happen that is due by then."""

    def joints_at(self, time_s: float) -> FloatArray:
        """True joint angles (n,) at a past instant, rad."""

    def rests_until(self, time_s: float) -> float:
        """When the standstill that holds then ends; that instant itself if there is none."""

    def speed_bounds_rad_s(self, start_s: float, end_s: float) -> Sequence[float]:
        """No joint is faster between these instants, as planned now."""

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
        self._gap_m, _ = self._gap(0.0)
        self.closed = self._gap_m <= 0

    def _draw_scatter(self) -> None:
        touch, flat = self._noise.standard_normal(2).tolist()
        file = self._world.file
        self._scatter_m = touch * file.probe.noise_m * self._world.noise_factor
        self._flat_m = flat * file.plate.flatness_m * self._world.noise_factor

    def _gap(self, time_s: float) -> tuple[float, str]:
        """Smallest gap, including the scatter of this contact: it closes at zero."""
        nearest, smallest = "", math.inf
        for name, gap in self._world.clearances_m(self._arm.joints_at(time_s)):
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
            following = self._next_look()
            if following > time_s:
                self._safe_s = following
                return
            self._look(following)

    def _next_look(self) -> float:
        """The contact cannot change before."""
        bound = self._speed_bound_m_s()
        if not bound:  # at rest, and perhaps for long
            resting_until = self._arm.rests_until(self._time_s)
            if math.isinf(resting_until):
                return math.inf
            self._time_s = resting_until
            bound = self._speed_bound_m_s()
        missing = self._world.file.probe.release_m - self._gap_m if self.closed else self._gap_m
        step_s = missing / bound if bound else LONGEST_STEP_S
        return self._time_s + min(max(step_s, SHORTEST_STEP_S), LONGEST_STEP_S)

    def _speed_bound_m_s(self) -> float:
        speeds = self._arm.speed_bounds_rad_s(self._time_s, self._time_s + LONGEST_STEP_S)
        return sum([speed * reach for speed, reach in zip(speeds, self._reaches, strict=True)])

    def _look(self, time_s: float) -> None:
        before_s, self._time_s = self._time_s, time_s
        self._gap_m, surface = self._gap(time_s)
        if self.closed:
            self.deepest_m = max(self.deepest_m, -self._gap_m)
            if self._gap_m >= self._world.file.probe.release_m:
                self.closed, self._released = False, True
        elif self._released and self._gap_m >= REARM_M:
            self._released = False
            self._draw_scatter()
            self._gap_m, _ = self._gap(time_s)
        elif self._gap_m <= 0:
            self.closed = True
            self.count += 1
            self.touches.append(Touch(self._instant(before_s, time_s), surface))

    def _instant(self, open_s: float, closed_s: float) -> float:
        while closed_s - open_s > CONTACT_TIME_S:
            middle = (open_s + closed_s) / 2
            open_s, closed_s = (open_s, middle) if self._gap(middle)[0] <= 0 else (middle, closed_s)
        return closed_s


def ball_in_base(world: World, joints_rad: FloatArray) -> FloatArray:
    """True ball centre (3,) in base, metres."""
    pose = world.flange_pose(joints_rad)
    return np.asarray(pose[:3, :3] @ world.truth.flange_T_probe[:3, 3] + pose[:3, 3])
