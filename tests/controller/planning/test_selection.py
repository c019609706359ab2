"""Greedy selection: right sums, better than chance, the same every time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.planning.selection import largest_std, select
from estimation.errors import EstimationError
from estimation.transform import FloatArray


def _problem(seed: int, states: int = 12, candidates: int = 60) -> tuple[FloatArray, ...]:
    random = np.random.default_rng(seed)
    root = random.normal(size=(states, states))
    rows = random.normal(size=(candidates, states))
    gates = random.normal(size=(2, 3, states))
    return root @ root.T / states, rows, random.uniform(0.01, 0.1, candidates), gates


def _posterior(
    covariance: FloatArray, rows: FloatArray, variance: FloatArray, chosen: FloatArray
) -> FloatArray:
    information = np.linalg.inv(covariance) + rows[chosen].T @ (rows[chosen] / variance[chosen, None])
    return np.linalg.inv(information)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.integers(1, 20), st.integers(0, 2))
def test_the_covariance_is_that_of_the_chosen_rows(seed: int, count: int, exchanges: int) -> None:
    covariance, rows, variance, gates = _problem(seed)
    selection = select(covariance, rows, variance, gates, count, exchanges)
    expected = _posterior(covariance, rows, variance, selection.chosen)
    assert len(set(selection.chosen.tolist())) == count
    np.testing.assert_allclose(selection.covariance, expected, atol=1e-9)
    assert selection.largest_std_m == pytest.approx(largest_std(gates, expected))


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_every_measurement_helps_or_at_least_does_no_harm(seed: int) -> None:
    selection = select(*_problem(seed), count=20, exchanges=0)
    assert np.all(np.diff(selection.curve_m) <= 1e-12)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000))
def test_chosen_beats_drawn(seed: int) -> None:
    covariance, rows, variance, gates = _problem(seed)
    random = np.random.default_rng(seed)
    drawn = [
        largest_std(gates, _posterior(covariance, rows, variance, random.choice(60, 8, replace=False)))
        for _ in range(30)
    ]
    assert select(covariance, rows, variance, gates, 8).largest_std_m <= np.median(drawn)


def test_no_face_takes_more_than_its_share() -> None:
    covariance, rows, variance, gates = _problem(3)
    group = np.arange(60) % 3
    chosen = select(covariance, rows, variance, gates, 9, group=group, group_limit=3).chosen
    assert np.bincount(group[chosen]).tolist() == [3, 3, 3]


def test_too_few_candidates_are_refused_with_both_numbers() -> None:
    covariance, rows, variance, gates = _problem(0, candidates=5)
    with pytest.raises(EstimationError, match=r"5 reachable measurements, 6 wanted"):
        select(covariance, rows, variance, gates, 6)
