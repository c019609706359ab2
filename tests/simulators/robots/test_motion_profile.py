"""Motion profiles: continuous, within limits, and at rest where they should end."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.robots.motion_profile import AxisMotion, plan_move, plan_stop

positions = st.floats(-1e5, 1e5)
speeds = st.floats(1, 1e5)
accelerations = st.floats(100, 1e6)


@given(positions, st.floats(-5e4, 5e4), positions, speeds, accelerations)
def test_a_move_is_continuous_and_ends_at_rest_at_its_target(
    start: float, velocity: float, target: float, speed: float, acceleration: float
) -> None:
    axis = AxisMotion(start)
    phases = plan_move(1.0, start, velocity, target, speed, acceleration)
    axis.follow(phases)
    assert axis.position(axis.end_s) == target and axis.velocity(axis.end_s) == 0
    scale = max(abs(start), abs(target), abs(velocity), speed, 1.0)
    for before, after in itertools.pairwise(phases):
        dt = after.start_s - before.start_s
        assert dt >= 0
        reached = before.position + before.velocity * dt + before.acceleration * dt * dt / 2
        assert reached == pytest.approx(after.position, abs=1e-6 * scale)
        assert before.velocity + before.acceleration * dt == pytest.approx(after.velocity, abs=1e-6 * scale)
        assert abs(before.acceleration) <= acceleration
        assert abs(after.velocity) <= max(speed, abs(velocity)) * (1 + 1e-9)


def test_a_trapezoid_takes_as_long_as_it_should() -> None:
    phases = plan_move(0.0, 0.0, 0.0, 100.0, 50.0, 100.0)
    assert phases[-1].start_s == pytest.approx(100 / 50 + 50 / 100)
    assert plan_move(0.0, 0.0, 0.0, 4.0, 50.0, 100.0)[-1].start_s == pytest.approx(0.4)  # a triangle


def test_a_stop_is_the_shortest() -> None:
    *_, rest = plan_stop(2.0, 10.0, -50.0, 100.0)
    assert rest.start_s == pytest.approx(2.5) and rest.position == pytest.approx(10.0 - 12.5)


def test_the_past_stays_when_the_plan_changes() -> None:
    axis = AxisMotion(0.0)
    axis.follow(plan_move(0.0, 0.0, 0.0, 100.0, 10.0, 100.0))
    times = np.linspace(-1, 2, 50)
    before = [axis.position(t) for t in times]
    axis.follow(plan_stop(2.0, axis.position(2.0), axis.velocity(2.0), 1000.0))
    assert [axis.position(t) for t in times] == before
    assert axis.end_s == pytest.approx(2.01)
    assert axis.course(-1.0) == (0.0, 0.0, 0.0)
    assert axis.course(1.0) == pytest.approx((10.0, 0.0, 2.0))
    assert axis.course(2.005) == pytest.approx((5.0, -1000.0, 2.01))
    assert axis.course(5.0) == (0.0, 0.0, np.inf)
