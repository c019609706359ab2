"""Coverage factors, chi-square tests and the decision rule of ISO 14253-1."""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy import special
from scipy.optimize import brentq

from estimation.errors import EstimationError
from estimation.transform import FloatArray


class Outcome(StrEnum):
    """The four results of an evaluation, as named by OPC 40001-101."""

    OK = "OK"
    NOT_OK = "NotOK"
    NOT_DECIDABLE = "NotDecidable"
    UNDEFINED = "Undefined"


def coverage_factor(dimension: int, probability: float = 0.95, dof: float = math.inf) -> float:
    """Factor k_p of the ellipsoid that holds a normal vector with `probability`.

    k_p(3) = 2.79548 at 95 %. With a covariance estimated from `dof` degrees of freedom,
    k^2 = dof m / (dof - m + 1) F(m, dof - m + 1).

    Raises
    ------
    EstimationError
        Fewer degrees of freedom than dimensions, or a probability outside (0, 1).

    Source: JCGM 102 (chi-square) and Hotelling's T^2 distribution (STANDARDS.md, A4).
    """
    _check_probability(probability)
    if dimension < 1:
        raise EstimationError(f"Coverage factor for {dimension} dimensions", "Give 1 or more")
    if math.isinf(dof) and dof > 0:
        return math.sqrt(2.0 * special.gammaincinv(dimension / 2.0, probability))
    remaining = dof - dimension + 1.0
    if not remaining > 0.0:
        raise EstimationError(
            f"Coverage factor in {dimension} dimensions from {dof:g} degrees of freedom",
            f"Repeat the measurement until there are {dimension} or more",
        )
    fisher = special.fdtri(float(dimension), remaining, probability)
    return math.sqrt(dof * dimension / remaining * fisher)


def expanded_uncertainty(
    covariance: ArrayLike, dof: float = math.inf, probability: float = 0.95
) -> FloatArray:
    """U = k_p times the largest principal standard deviation of points.

    Parameters
    ----------
    covariance : (..., 3, 3), square of any length unit; a matrix of another size m works the same way.

    Returns
    -------
    (...), in that length unit; shape () for one matrix.

    Raises
    ------
    EstimationError
        A matrix that is no covariance, or too few degrees of freedom.
    """
    matrices = np.asarray(covariance, dtype=np.float64)
    factor = coverage_factor(matrices.shape[-1], probability, dof)
    if not np.isfinite(matrices).all():
        raise EstimationError("Covariance with entries that are not finite", "Repeat the estimate")
    eigenvalues = np.linalg.eigvalsh(matrices)
    largest = np.asarray(eigenvalues[..., -1])
    if np.any(eigenvalues[..., 0] < -1e-9 * np.abs(largest)):
        raise EstimationError(
            f"Covariance with a negative eigenvalue, {eigenvalues[..., 0].min():.3g}",
            "Repeat the estimate; a covariance has none",
        )
    return np.asarray(factor * np.sqrt(np.maximum(largest, 0.0)))


@dataclass(frozen=True, slots=True)
class ChiSquareTest:
    """A sum of squares against the band that honest data keep.

    `level` is the probability that honest data fail; `p_value` that they come out as extreme as `value`.
    """

    value: float
    dof: int
    lower: float
    upper: float
    level: float
    p_value: float
    passed: bool


def chi_square_two_sided(value: float, dof: int, level: float = 0.05) -> ChiSquareTest:
    """Tests a weighted sum of squares both ways: too large, or too small for the noise that is claimed.

    NaN fails. Raises EstimationError without degrees of freedom.
    """
    _check_test(dof, level)
    lower = 2.0 * float(special.gammaincinv(dof / 2.0, level / 2.0))
    upper = 2.0 * float(special.gammainccinv(dof / 2.0, level / 2.0))
    below, above = _tails(value, dof)
    passed = lower <= value <= upper
    return ChiSquareTest(value, dof, lower, upper, level, min(1.0, 2.0 * min(below, above)), passed)


def chi_square_upper(value: float, dof: int, level: float = 0.05) -> ChiSquareTest:
    """Tests whether a weighted sum of squares is too large; `lower` is 0.

    NaN fails. Raises EstimationError without degrees of freedom.
    """
    _check_test(dof, level)
    upper = 2.0 * float(special.gammainccinv(dof / 2.0, level))
    return ChiSquareTest(value, dof, 0.0, upper, level, _tails(value, dof)[1], 0.0 <= value <= upper)


def bonferroni_limit(count: int, level: float = 0.05, dimension: int = 1) -> float:
    """Mahalanobis distance that honest data exceed with probability `level` in any of `count` points."""
    _check_test(dimension, level)
    if count < 1:
        raise EstimationError(f"Outlier limit for {count} points", "Give 1 or more")
    return math.sqrt(2.0 * float(special.gammainccinv(dimension / 2.0, level / count)))


@dataclass(frozen=True, slots=True)
class Decision:
    """A value against its limits; all in the unit of `value`.

    `guard_band` is the distance that an accepted value keeps from its limit; infinite when the limits are
    so close together, or u so large, that no value can be accepted.
    """

    outcome: Outcome
    value: float
    u: float
    lower: float
    upper: float
    dof: float
    probability: float
    guard_band: float
    conformance_probability: float  # NaN when undefined


def decide(
    value: float,
    u: float,
    lower: float = -math.inf,
    upper: float = math.inf,
    dof: float = math.inf,
    probability: float = 0.95,
) -> Decision:
    """Conformity of a measured value with its limits, by conformance probability.

    OK: the true value is within the limits with `probability`. NotOK: it is beyond one limit with
    `probability`. NotDecidable: neither can be claimed. Undefined: value, u or dof are not numbers.
    A limit itself belongs to conformity. Student's distribution is used when dof is finite.

    Raises
    ------
    EstimationError
        u negative, no limit, limits in the wrong order, or a probability not between 0.5 and 1.

    Source: ISO 14253-1:2017 default rule and JCGM 106 (STANDARDS.md, A3).
    """
    if math.isnan(value) or math.isnan(u) or math.isnan(dof) or math.isinf(value) or math.isinf(u):
        outcome, guard, conforming = Outcome.UNDEFINED, math.nan, math.nan
    else:
        guard = guard_band(u, lower, upper, dof, probability)
        conforming = _conformance(value, u, lower, upper, dof)
        one_sided = _quantile(probability, dof) * u
        if lower + guard <= value <= upper - guard:
            outcome = Outcome.OK
        elif value >= upper + one_sided or value <= lower - one_sided:
            outcome = Outcome.NOT_OK
        else:
            outcome = Outcome.NOT_DECIDABLE
    return Decision(outcome, value, u, lower, upper, dof, probability, guard, conforming)


def guard_band(
    u: float, lower: float, upper: float, dof: float = math.inf, probability: float = 0.95
) -> float:
    """Distance from its limits that a value must keep to be accepted; infinite if none can be accepted.

    1.645 u for one limit at 95 %; solved numerically where the other limit is close enough to matter.
    Raises EstimationError as `decide` does.
    """
    _check_probability(probability, least=0.5)
    if u < 0.0 or math.isnan(u):
        raise EstimationError(f"Standard uncertainty {u:g}", "Give zero or more")
    if not dof > 0.0:
        raise EstimationError(
            f"{dof:g} degrees of freedom", "Give more than zero, or infinity when u is known"
        )
    if not lower <= upper or lower == math.inf or upper == -math.inf:
        raise EstimationError(f"Limits {lower:g} to {upper:g}", "Give the lower limit first")
    if math.isinf(lower) and math.isinf(upper):
        raise EstimationError("No limit to decide against", "Give a lower limit, an upper limit or both")
    guard = _quantile(probability, dof) * u
    half = (upper - lower) / 2.0
    if u == 0.0 or math.isinf(half):
        return guard

    def surplus(distance: float) -> float:
        """Conformance probability this far inside the upper limit, less what is asked."""
        return _conformance(-distance, u, -2.0 * half, 0.0, dof) - probability

    if surplus(half) < 0.0:
        return math.inf
    if surplus(guard) >= 0.0:  # the other limit is too far away to matter
        return guard
    return float(brentq(surplus, guard, half, xtol=1e-12 * half))


def _conformance(value: float, u: float, lower: float, upper: float, dof: float) -> float:
    """P(lower <= true value <= upper)."""
    if u == 0.0:
        return float(lower <= value <= upper)
    outside = _upper_tail((upper - value) / u, dof) + _upper_tail((value - lower) / u, dof)
    return max(0.0, 1.0 - outside)


def _upper_tail(distance: float, dof: float) -> float:
    """P(X > distance) of the normal or Student's distribution."""
    return float(special.ndtr(-distance) if math.isinf(dof) else special.stdtr(dof, -distance))


def _quantile(probability: float, dof: float) -> float:
    """Of the normal or Student's distribution."""
    return float(special.ndtri(probability) if math.isinf(dof) else special.stdtrit(dof, probability))


def _tails(value: float, dof: int) -> tuple[float, float]:
    """P(X <= value), P(X > value) of chi-square."""
    half = value / 2.0
    return float(special.gammainc(dof / 2.0, half)), float(special.gammaincc(dof / 2.0, half))


def _check_probability(probability: float, least: float = 0.0) -> None:
    if not least < probability < 1.0:
        raise EstimationError(f"Probability {probability:g}", f"Give one between {least:g} and 1")


def _check_test(dof: int, level: float) -> None:
    if dof < 1:
        raise EstimationError(f"Chi-square test with {dof} degrees of freedom", "Take more measurements")
    _check_probability(level)
