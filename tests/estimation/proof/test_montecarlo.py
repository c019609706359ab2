"""Worked examples of JCGM 101, and the properties of the adaptive procedure."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm

from estimation.errors import EstimationError
from estimation.proof.montecarlo import (
    adaptive,
    block_size,
    numerical_tolerance,
    summary,
    validate_linear,
)

FloatArray = NDArray[np.float64]


def blocks(seed: int, draw: object) -> object:
    """A function for `adaptive`: every block has a stream of its own."""

    def run(number: int, trials: int) -> FloatArray:
        return draw(np.random.default_rng([seed, number]), trials)  # type: ignore[operator, no-any-return]

    return run


def mass_mg(rng: np.random.Generator, trials: int) -> FloatArray:
    """Example 9.3: deviation of a mass from nominal, by comparison in air."""
    m_rc = rng.normal(100_000.000, 0.050, trials)
    d_rc = rng.normal(1.234, 0.020, trials)
    air = rng.uniform(1.10, 1.30, trials)
    rho_w = rng.uniform(7_000.0, 9_000.0, trials)
    rho_r = rng.uniform(7_950.0, 8_050.0, trials)
    return np.asarray((m_rc + d_rc) * (1 + (air - 1.2) * (1 / rho_w - 1 / rho_r)) - 100_000.0)


def test_example_9_2_of_the_guide_normal_and_rectangular_inputs() -> None:
    normal = adaptive(blocks(1, lambda rng, n: rng.normal(size=(n, 4)).sum(axis=1)))  # type: ignore[arg-type]
    (seen,) = normal.summaries
    assert (seen.value, seen.u) == (pytest.approx(0.0, abs=0.05), pytest.approx(2.0, abs=0.05))
    assert (seen.low, seen.high) == (pytest.approx(-3.92, abs=0.1), pytest.approx(3.92, abs=0.1))
    assert normal.stable
    edge = np.sqrt(3)
    flat = adaptive(
        blocks(2, lambda rng, n: rng.uniform(-edge, edge, (n, 4)).sum(axis=1)),  # type: ignore[arg-type]
        digits=2,
    )
    assert flat.summaries[0].high == pytest.approx(3.88, abs=0.03)


def test_example_9_3_of_the_guide_refutes_the_linear_result() -> None:
    """The guide: 1.2340 mg, u 0.0754, shortest interval [1.0834, 1.3825]; linear: u 0.0539, not valid."""
    run = adaptive(blocks(3, mass_mg), 50_000, 1, interval="shortest", most_trials=1_000_000)  # type: ignore[arg-type]
    (seen,) = run.summaries
    assert seen.value == pytest.approx(1.2340, abs=1e-3)
    assert seen.u == pytest.approx(0.0754, abs=5e-4)
    assert seen.low == pytest.approx(1.0834, abs=3e-3)
    assert seen.high == pytest.approx(1.3825, abs=3e-3)
    verdict = validate_linear(1.2340, 1.95996 * 0.0539, seen, numerical_tolerance(0.075, 1))
    assert not verdict.passed
    assert verdict.d_low == pytest.approx(0.0451, abs=3e-3)
    assert verdict.d_high == pytest.approx(0.0430, abs=3e-3)


def test_a_linear_model_is_validated() -> None:
    run = adaptive(blocks(4, lambda rng, n: rng.normal(5.0, 0.35, n)), digits=2)  # type: ignore[arg-type]
    assert run.stable
    (seen,) = run.summaries
    tolerance = numerical_tolerance(0.35, 1)
    assert validate_linear(5.0, 1.959964 * 0.35, seen, tolerance).passed
    assert not validate_linear(5.0, 1.959964 * 0.30, seen, tolerance).passed


def test_it_stops_when_the_figures_are_stable_and_says_when_they_are_not() -> None:
    draw = blocks(5, lambda rng, n: rng.normal(size=(n, 2)))
    one, two = (adaptive(draw, digits=digits) for digits in (1, 2))  # type: ignore[arg-type]
    assert one.stable and two.stable and one.trials < two.trials
    cut = adaptive(draw, digits=3, most_trials=30_000)  # type: ignore[arg-type]
    assert not cut.stable and cut.trials == 30_000


def test_the_result_does_not_depend_on_who_runs_the_blocks() -> None:
    draw = blocks(6, lambda rng, n: rng.normal(size=n))
    first, again = (adaptive(draw, digits=1) for _ in range(2))  # type: ignore[arg-type]
    assert first.summaries == again.summaries


@pytest.mark.parametrize(
    ("u", "digits", "tolerance"),
    [(0.00035, 2, 5e-6), (0.00035, 1, 5e-5), (2.0, 2, 0.05), (0.0996, 2, 0.005), (35.0, 2, 0.5)],
)
def test_numerical_tolerance_is_half_of_the_last_digit(u: float, digits: int, tolerance: float) -> None:
    assert numerical_tolerance(u, digits) == pytest.approx(tolerance)


def test_the_block_is_that_of_the_guide() -> None:
    assert block_size(0.95) == 10_000
    assert block_size(0.999) == 100_000


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 0.99))
def test_the_shortest_interval_is_never_longer_and_holds_as_much(seed: int, probability: float) -> None:
    values = np.random.default_rng(seed).lognormal(size=2000)
    symmetric, shortest = summary(values, probability), summary(values, probability, "shortest")
    assert shortest.high - shortest.low <= symmetric.high - symmetric.low + 1e-12
    held = np.mean((values >= shortest.low) & (values <= shortest.high))
    assert held == pytest.approx(probability, abs=2e-3)


def test_too_few_or_broken_trials_are_refused() -> None:
    with pytest.raises(EstimationError, match="50 trials"):
        summary(np.zeros(50))
    with pytest.raises(EstimationError, match="not finite"):
        summary(np.append(norm.rvs(size=500, random_state=1), np.nan))
    with pytest.raises(EstimationError, match="above zero"):
        numerical_tolerance(0.0)
