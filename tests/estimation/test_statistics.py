import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import EstimationError
from estimation.statistics import (
    Outcome,
    bonferroni_limit,
    chi_square_two_sided,
    chi_square_upper,
    coverage_factor,
    decide,
    expanded_uncertainty,
    guard_band,
)


def test_outcomes_are_the_four_of_opc_40001_101() -> None:
    assert [str(outcome) for outcome in Outcome] == ["OK", "NotOK", "NotDecidable", "Undefined"]


@pytest.mark.parametrize(
    ("dimension", "dof", "expected"),
    [
        (1, math.inf, 1.95996),
        (2, math.inf, 2.44775),
        (3, math.inf, 2.79548),
        (6, math.inf, 3.54846),
        (3, 10, 3.90),
        (3, 20, 3.25),
        (3, 100, 2.87),
        (6, 30, 4.23),
    ],
)
def test_coverage_factors_of_the_tables(dimension: int, dof: float, expected: float) -> None:
    assert coverage_factor(dimension, dof=dof) == pytest.approx(
        expected, abs=0.006 if dof < math.inf else 1e-5
    )


def test_coverage_factor_with_many_degrees_of_freedom_is_the_known_one() -> None:
    assert coverage_factor(3, dof=1e9) == pytest.approx(coverage_factor(3), rel=1e-6)


@pytest.mark.parametrize(
    ("dimension", "dof", "probability"), [(3, 2, 0.95), (3, math.nan, 0.95), (3, 9, 1.0)]
)
def test_coverage_factor_refuses(dimension: int, dof: float, probability: float) -> None:
    with pytest.raises(EstimationError):
        coverage_factor(dimension, probability, dof)


def test_expanded_uncertainty_is_set_by_the_longest_axis() -> None:
    covariances = np.stack([np.diag([1.0, 4.0, 9.0]), np.diag([0.25, 0.0, 0.0])])
    assert expanded_uncertainty(covariances) == pytest.approx([3 * 2.79548, 0.5 * 2.79548], rel=1e-5)
    assert expanded_uncertainty(covariances[0]).shape == ()
    assert float(expanded_uncertainty(covariances[0], dof=10)) == pytest.approx(3 * 3.90, rel=2e-3)


@pytest.mark.parametrize("bad", [np.diag([1.0, 1.0, math.nan]), np.diag([1.0, 1.0, -1e-3])])
def test_expanded_uncertainty_refuses_what_is_no_covariance(bad: np.ndarray) -> None:
    with pytest.raises(EstimationError, match="Covariance with"):
        expanded_uncertainty(bad)


def test_chi_square_band_of_60_degrees_of_freedom() -> None:
    test = chi_square_two_sided(60.0, 60)
    assert (test.lower, test.upper) == pytest.approx((40.5, 83.3), abs=0.05)
    assert test.passed
    assert not chi_square_two_sided(84.0, 60).passed
    assert not chi_square_two_sided(40.0, 60).passed  # claims more noise than there is
    assert chi_square_upper(40.0, 60).passed


@given(st.floats(0.01, 300.0), st.integers(1, 100), st.floats(0.001, 0.2))
def test_p_value_and_band_agree(value: float, dof: int, level: float) -> None:
    for test in (chi_square_two_sided(value, dof, level), chi_square_upper(value, dof, level)):
        if abs(test.p_value - level) > 1e-9:
            assert test.passed == (test.p_value > level)


def test_chi_square_fails_nan_and_refuses_no_redundancy() -> None:
    assert not chi_square_two_sided(math.nan, 5).passed
    assert not chi_square_upper(math.nan, 5).passed
    with pytest.raises(EstimationError, match="0 degrees of freedom"):
        chi_square_upper(1.0, 0)


def test_outlier_limit_grows_with_the_number_of_points() -> None:
    assert bonferroni_limit(100) == pytest.approx(3.48, abs=0.005)
    assert bonferroni_limit(1) == pytest.approx(1.95996, abs=1e-5)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1.0 - 1.645 - 0.01, Outcome.OK),
        (1.0 - 1.644, Outcome.NOT_DECIDABLE),
        (1.0, Outcome.NOT_DECIDABLE),
        (1.0 + 1.644, Outcome.NOT_DECIDABLE),
        (1.0 + 1.646, Outcome.NOT_OK),
        (math.nan, Outcome.UNDEFINED),
        (math.inf, Outcome.UNDEFINED),
    ],
)
def test_zones_of_an_upper_limit(value: float, expected: Outcome) -> None:
    decision = decide(value, 1.0, upper=1.0)
    assert decision.outcome is expected
    if expected is not Outcome.UNDEFINED:
        assert decision.guard_band == pytest.approx(1.645, abs=1e-3)


def test_acceptance_limit_itself_is_ok() -> None:
    guard = guard_band(0.02, -math.inf, 0.4)
    assert decide(0.4 - guard, 0.02, upper=0.4).outcome is Outcome.OK
    assert decide(0.4, 0.0, upper=0.4).outcome is Outcome.OK
    assert decide(0.4, 0.0, lower=0.4).outcome is Outcome.OK
    assert decide(0.4 + 1e-12, 0.0, upper=0.4).outcome is Outcome.NOT_OK


@pytest.mark.parametrize(("dof", "factor"), [(5, 2.015), (10, 1.812), (20, 1.725), (30, 1.697)])
def test_few_degrees_of_freedom_widen_the_guard_band(dof: float, factor: float) -> None:
    assert guard_band(1.0, -math.inf, 10.0, dof) == pytest.approx(factor, abs=1e-3)


def test_close_limits_share_the_risk() -> None:
    guard = guard_band(1.0, -2.0, 2.0)
    assert 1.645 < guard < 2.0
    assert decide(2.0 - guard - 1e-9, 1.0, -2.0, 2.0).conformance_probability == pytest.approx(0.95, abs=1e-8)
    assert decide(2.0 - guard + 1e-6, 1.0, -2.0, 2.0).outcome is Outcome.NOT_DECIDABLE


def test_limits_closer_than_u_accept_and_reject_nothing_inside() -> None:
    for half_width in (1.9, 0.01):
        decision = decide(0.0, 1.0, -half_width, half_width)
        assert decision.outcome is Outcome.NOT_DECIDABLE
        assert math.isinf(decision.guard_band)
    assert decide(0.01 + 1.7, 1.0, -0.01, 0.01).outcome is Outcome.NOT_OK


@given(
    value=st.floats(-3, 3),
    u=st.floats(0.01, 2.0),
    width=st.floats(0.1, 4.0),
    dof=st.one_of(st.just(math.inf), st.floats(3, 100)),
)
def test_verdict_claims_no_more_than_the_conformance_probability(
    value: float, u: float, width: float, dof: float
) -> None:
    decision = decide(value, u, -width / 2, width / 2, dof)
    p = decision.conformance_probability
    assert 0.0 <= p <= 1.0
    match decision.outcome:
        case Outcome.OK:
            assert p >= 0.95 - 1e-9
        case Outcome.NOT_OK:
            assert p <= 0.05 + 1e-9
        case _:
            assert p < 0.95 + 1e-9


def test_wrong_accept_rate_at_the_limit_is_five_percent() -> None:
    measured = 1.0 + 0.1 * np.random.default_rng(3).normal(size=4000)
    accepted = sum(decide(float(y), 0.1, upper=1.0).outcome is Outcome.OK for y in measured)
    assert accepted / 4000 == pytest.approx(0.05, abs=0.012)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, -1.0, 0.0, 1.0), "uncertainty -1"),
        ((0.0, 1.0, 2.0, 1.0), "Limits 2 to 1"),
        ((0.0, 1.0, math.nan, 1.0), "Limits nan"),
        ((0.0, 1.0), "No limit"),
        ((0.0, 1.0, 0.0, 1.0, 0.0), "0 degrees"),
        ((0.0, 1.0, 0.0, 1.0, 9.0, 0.4), "Probability 0.4"),
    ],
)
def test_decide_refuses(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        decide(*arguments)
