"""Counting coverage: exact binomial bounds, and an honest and a dishonest covariance told apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, chi2

from estimation.errors import EstimationError
from estimation.proof.coverage import Coverage, normalised_error_squared, rate_bounds


@given(st.integers(1, 2000), st.data())
def test_bounds_are_those_of_clopper_and_pearson(trials: int, data: st.DataObject) -> None:
    count = data.draw(st.integers(0, trials))
    expected = binomtest(count, trials).proportion_ci(method="exact")
    assert rate_bounds(count, trials) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_an_honest_covariance_passes_and_a_claim_too_small_or_too_large_fails() -> None:
    random = np.random.default_rng(1)
    for dimension in (3, 5, 6):
        nees = random.chisquare(dimension, 5000)
        assert Coverage(dimension, nees).accepted
        assert not Coverage(dimension, nees * 1.1).accepted
        assert not Coverage(dimension, nees / 1.1).accepted
        assert not Coverage(dimension, nees, refused=300).accepted
        assert Coverage(dimension, nees, refused=250).accepted


def test_the_band_is_that_of_chi_square() -> None:
    coverage = Coverage(5, np.ones(300))
    expected = chi2.ppf([0.0005, 0.9995], 1500) / 1500
    assert coverage.band() == pytest.approx(tuple(expected))


def test_cells_of_several_workers_add_up() -> None:
    whole = Coverage(2, np.array([1.0, 9.0])).merged(Coverage(2, np.array([2.0]), refused=1))
    assert (whole.cells, whole.inside, whole.refused) == (4, 2, 1)
    with pytest.raises(EstimationError, match="apart"):
        whole.merged(Coverage(3, np.zeros(1)))


def test_normalised_error_counts_in_standard_deviations() -> None:
    assert normalised_error_squared(np.array([2.0, 0.0]), np.diag([1.0, 9.0])) == pytest.approx(4.0)
    assert normalised_error_squared(np.array([0.0, 3.0]), np.diag([1.0, 9.0])) == pytest.approx(1.0)
