"""Synchronised joint moves: one profile for all, within every joint's limits."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from drivers.robots.motion_profile import synchronize

distances = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6)
limits = st.lists(st.floats(0.1, 5.0), min_size=6, max_size=6)


@given(distances, limits, limits)
def test_every_joint_takes_the_same_time_and_keeps_its_limits(
    distance: list[float], speed: list[float], acceleration: list[float]
) -> None:
    way = np.array(distance)
    assume(np.abs(way).max() > 1e-6)
    move = synchronize(way, np.array(speed), np.array(acceleration))
    assert np.all(move.velocity <= np.array(speed) * (1 + 1e-12))
    assert np.all(move.acceleration <= np.array(acceleration) * (1 + 1e-12))
    for d, v, a in zip(np.abs(way), move.velocity, move.acceleration, strict=True):
        if d > 1e-9:  # the time of this joint alone, by the textbook
            alone_s = d / v + v / a if v * v <= a * d else 2 * np.sqrt(d / a)
            assert alone_s == pytest.approx(move.duration_s, rel=1e-9)


def test_no_way_takes_no_time() -> None:
    assert synchronize(np.zeros(6), np.ones(6), np.ones(6)).duration_s == 0.0


def test_a_trapezoid_and_a_triangle() -> None:
    assert synchronize(np.array([2.0]), np.array([1.0]), np.array([2.0])).duration_s == pytest.approx(2.5)
    assert synchronize(np.array([0.5]), np.array([9.0]), np.array([2.0])).duration_s == pytest.approx(1.0)
