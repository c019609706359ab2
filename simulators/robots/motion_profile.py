"""Motion of one axis: phases of constant acceleration, kept so that any past instant can be asked for."""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final, NamedTuple

KEPT_PHASES: Final = 20_000  # hours of work; older ones are dropped by halves


class Phase(NamedTuple):
    """From `start_s` on: p + v dt + a dt^2 / 2."""

    start_s: float
    position: float
    velocity: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class State:
    position: float
    velocity: float


def plan_move(
    start_s: float, position: float, velocity: float, target: float, speed: float, acceleration: float
) -> list[Phase]:
    """Trapezoidal profile from any state of motion to rest at `target`; the last phase is that rest."""
    phases: list[Phase] = []
    t, p, v = start_s, position, velocity

    def add(change: float, duration: float) -> None:
        nonlocal t, p, v
        if duration > 0:
            phases.append(Phase(t, p, v, change))
            p += v * duration + change * duration**2 / 2
            v += change * duration
            t += duration

    braking_distance = v * v / (2 * acceleration)
    if v != 0 and ((target - p) * v < 0 or braking_distance > abs(target - p)):
        add(-math.copysign(acceleration, v), abs(v) / acceleration)  # cannot stop in time, or runs away
        v = 0.0
    sign = math.copysign(1.0, target - p)
    if abs(v) > speed:
        add(-sign * acceleration, (abs(v) - speed) / acceleration)
        v = sign * speed
    distance = abs(target - p)
    if distance > 0:
        peak = min(speed, math.sqrt(acceleration * distance + v * v / 2))
        cruise_distance = distance - (2 * peak * peak - v * v) / (2 * acceleration)
        add(sign * acceleration, (peak - abs(v)) / acceleration)
        v = sign * peak
        add(0.0, cruise_distance / peak)
        add(-sign * acceleration, peak / acceleration)
    phases.append(Phase(t, target, 0.0, 0.0))
    return phases


def plan_stop(start_s: float, position: float, velocity: float, deceleration: float) -> list[Phase]:
    """The shortest way to rest at this deceleration."""
    if velocity == 0:
        return [Phase(start_s, position, 0.0, 0.0)]
    duration = abs(velocity) / deceleration
    end = position + velocity * duration / 2
    return [
        Phase(start_s, position, velocity, -math.copysign(deceleration, velocity)),
        Phase(start_s + duration, end, 0.0, 0.0),
    ]


class AxisMotion:
    """Where one axis was, is, and will be unless something intervenes."""

    def __init__(self, position: float) -> None:
        self._starts = [-math.inf]
        self._phases = [Phase(0.0, position, 0.0, 0.0)]
        self._known, self._known_from_s, self._known_until_s = self._phases[0], -math.inf, math.inf
        self.end_s = -math.inf  # when the present plan comes to rest
        self.target = position
        self.plans = 0  # how often the plan changed

    def follow(self, phases: list[Phase]) -> None:
        """Replace what was planned from the first phase's start on; the last phase is rest."""
        first = bisect_right(self._starts, phases[0].start_s)
        if self._starts[first - 1] == phases[0].start_s:
            first -= 1
        del self._starts[first:], self._phases[first:]
        self._known_until_s = -math.inf
        self._starts += [phase.start_s for phase in phases]
        self._phases += phases
        self.end_s, self.target = phases[-1].start_s, phases[-1].position
        self.plans += 1
        if len(self._starts) > KEPT_PHASES:
            del self._starts[1 : KEPT_PHASES // 2], self._phases[1 : KEPT_PHASES // 2]

    def phase_number(self, time_s: float) -> int:
        """Which phase holds at an instant; the same number means the same plan."""
        starts = self._starts
        last = len(starts) - 1
        return last if time_s >= starts[last] else bisect_right(starts, time_s) - 1

    def _phase(self, time_s: float) -> Phase:
        """The phase that holds at an instant; the one found last is known, because time goes on slowly."""
        if not self._known_from_s <= time_s < self._known_until_s:
            starts, number = self._starts, self.phase_number(time_s)
            self._known, self._known_from_s = self._phases[number], starts[number]
            self._known_until_s = starts[number + 1] if number + 1 < len(starts) else math.inf
        return self._known

    def position(self, time_s: float) -> float:
        known = self._known_from_s <= time_s < self._known_until_s  # as nearly always; this runs very often
        start, p, v, a = self._known if known else self._phase(time_s)
        if v == 0 and a == 0:
            return p
        dt = time_s - start
        return p + v * dt + a * dt * dt / 2

    def velocity(self, time_s: float) -> float:
        start, _, v, a = self._phase(time_s)
        return v + a * (time_s - start) if a else v

    def moving(self, time_s: float) -> bool:
        return time_s < self.end_s

    def course(self, time_s: float) -> tuple[float, float, float]:
        """Velocity and acceleration at an instant, and until when the latter holds, as planned now."""
        start, _, v, a = self._phase(time_s)
        return v + a * (time_s - start), a, self._known_until_s
