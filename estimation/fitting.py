"""Minimum of the joint cost in whitened coordinates: Levenberg-Marquardt, robust start, outlier gate."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from estimation.chart import Point, Problem
from estimation.errors import EstimationError
from estimation.measurement import Rows
from estimation.transform import FloatArray

Robust = Literal["none", "huber", "cauchy"]
LARGEST_REJECTED_SHARE: Final = 0.1
_TUNING: Final[Mapping[Robust, float]] = {"huber": 1.345, "cauchy": 2.385}  # 95 % efficient on honest noise
_LARGEST_ITERATIONS: Final = 50
_REWEIGHTINGS: Final = 4  # passes with the noise variance taken at the latest estimate
_ROBUST_PASSES: Final = 12
SMALLEST_VARIANCE: Final = 1e-30  # m^2: a row without any noise has no finite weight
_FIRST_TOLERANCE: Final = 1e-2  # standard deviations, for passes that only prepare the next
_ROUNDING: Final = 1e-14  # of the cost
_ROUNDING_M: Final = 1e-15  # of a residual, coordinates being of the size of a metre
_POLISHING_STEPS: Final = 3
_LARGEST_DAMPING: Final = 1e12
_NEAR_START: Final = "Check that the nominal poses in the cell file are near the real ones, and the readings"


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A minimum, with what led there."""

    z: FloatArray
    rows: Rows
    jacobian: FloatArray  # (m, n) by z
    used: NDArray[np.bool_]
    costs: tuple[tuple[float, ...], ...]
    stop_reason: str


def _solve(
    problem: Problem, start: Point, weight: FloatArray, tolerance: float
) -> tuple[Point, tuple[float, ...], str]:
    """Levenberg-Marquardt in z with fixed weights (m,) = 1/sigma per row; the prior adds |z|^2."""
    z, rows, jacobian = start
    residual = weight * rows.residual_m
    cost = float(residual @ residual + z @ z)
    costs, damping, growth, last_step, polished = [cost], 0.0, 2.0, np.inf, 0
    for _ in range(_LARGEST_ITERATIONS):
        whitened = weight[:, None] * jacobian
        normal = whitened.T @ whitened + np.eye(len(z))
        gradient = whitened.T @ residual + z
        newton = np.linalg.solve(normal, -gradient)
        expected = float(-gradient @ newton)  # the undamped step squared, in posterior sigmas
        steepest = float(np.max(np.abs(gradient) / np.sqrt(np.diag(normal)), initial=0.0))
        if steepest <= tolerance and min(last_step, np.sqrt(expected)) <= tolerance:
            return (z, rows, jacobian), tuple(costs), "step and gradient small"
        if polished >= _POLISHING_STEPS:
            return (z, rows, jacobian), tuple(costs), "cost at its rounding"
        # Below the rounding of the cost no step can prove that it helps: take a few in good faith.
        rounding = _ROUNDING_M * float(np.linalg.norm(residual * weight)) + _ROUNDING * cost
        at_floor = expected <= rounding
        polished += at_floor
        while True:
            scaled = normal + damping * np.diag(np.diag(normal))
            step = newton if damping == 0.0 or at_floor else np.linalg.solve(scaled, -gradient)
            trial = z + step
            _, trial_rows, trial_jacobian = problem.evaluate(trial)
            trial_residual = weight * trial_rows.residual_m
            trial_cost = float(trial_residual @ trial_residual + trial @ trial)
            promised = float(-step @ (2.0 * gradient + normal @ step))
            gain = (cost - trial_cost) / promised
            if trial_cost <= cost or at_floor:
                trial_cost = min(trial_cost, cost)
                break
            if damping > _LARGEST_DAMPING:
                raise EstimationError(
                    f"No step lowers the cost, gradient {steepest:.3g}, limit {tolerance:.3g}", _NEAR_START
                )
            damping, growth = max(damping * growth, 1e-3), growth * 2.0
        # Nielsen's rule: the better the linear model did, the less damping; a good step needs none.
        damping = 0.0 if gain > 0.9 else damping * max(1 / 3, 1 - (2 * gain - 1) ** 3)
        growth = 2.0
        last_step = float(np.sqrt(step @ normal @ step))
        z, rows, jacobian, residual, cost = trial, trial_rows, trial_jacobian, trial_residual, trial_cost
        costs.append(cost)
    raise EstimationError(
        f"No convergence in {_LARGEST_ITERATIONS} iterations: last step {last_step:.3g} standard deviations, "
        f"limit {tolerance:.3g}",
        _NEAR_START,
    )


def reweighted(problem: Problem, z: FloatArray, used: NDArray[np.bool_], tolerance: float) -> Fit:
    """Passes with the noise variance taken at the estimate, until it stands still."""
    point = problem.evaluate(z)
    variance = row_variance(point[1])
    costs: list[tuple[float, ...]] = []
    for number in range(_REWEIGHTINGS):
        # The first variance is that of the prior's values: no use in converging to the last digit with it.
        limit = tolerance if number else max(tolerance, _FIRST_TOLERANCE)
        point, course, reason = _solve(problem, point, used / np.sqrt(variance), limit)
        costs.append(course)
        latest = row_variance(point[1])
        settled = np.max(np.abs(latest / variance - 1.0)) < tolerance
        variance = latest
        if settled and number:
            break
    return Fit(*point, used, tuple(costs), reason)


def robust_start(problem: Problem, z: FloatArray, robust: Robust) -> FloatArray:
    """Iteratively reweighted least squares; only a start, so loose and few passes."""
    point = problem.evaluate(z)
    sigma = np.sqrt(row_variance(point[1]))
    # Before the first fit the prior is part of every residual: judged by the noise alone, all are outliers.
    scale = np.sqrt(sigma**2 + np.einsum("mn,mn->m", point[2], point[2]))
    for _ in range(_ROBUST_PASSES):
        before, rows, _ = point
        size = np.abs(rows.residual_m) / scale / _TUNING[robust]
        weight = np.maximum(size, 1.0) ** -0.5 if robust == "huber" else (1.0 + size**2) ** -0.5
        point = _solve(problem, point, weight / sigma, _FIRST_TOLERANCE)[0]
        if np.max(np.abs(point[0] - before), initial=0.0) < _FIRST_TOLERANCE:
            break
        scale = sigma = np.sqrt(row_variance(point[1]))
    return point[0]


def gated(problem: Problem, z: FloatArray, robust: Robust, level: float, tolerance: float) -> Fit:
    """Mahalanobis gate: each row against what all the other accepted rows predict for it."""
    limit = float(chdtri(1, level / problem.rows))  # Bonferroni
    allowed = int(LARGEST_REJECTED_SHARE * problem.rows)
    used = np.ones(problem.rows, dtype=np.bool_)
    if robust != "none":  # judge first where outliers cannot hide each other, as if no row were in the fit
        _, rows, jacobian = problem.evaluate(z)
        variance = row_variance(rows)
        squared = rows.residual_m**2 / (variance + _spread(jacobian, variance, used))
        worst_rows = np.argsort(squared)[problem.rows - allowed :]
        used[worst_rows] = squared[worst_rows] <= limit
    fit = reweighted(problem, z, used, tolerance)
    for _ in range(2 * allowed + 3):
        variance = row_variance(fit.rows)
        spread = _spread(fit.jacobian, variance, fit.used)
        own = np.where(fit.used, np.maximum(variance - spread, 1e-9 * variance), variance + spread)
        squared = fit.rows.residual_m**2 / own
        # Rows may come back, and only the worst leaves at a time: it drags honest rows over the limit.
        used = fit.used | (squared <= limit)
        worst = int(np.argmax(np.where(used, squared, -1.0)))
        used[worst] = squared[worst] <= limit
        if np.sum(~used) > allowed:
            raise EstimationError(
                f"More than {allowed} of {problem.rows} measurements contradict the others",
                "Look for a moved object, a wrong feature or a loose sensor, then measure again",
            )
        if (used == fit.used).all():
            break
        fit = reweighted(problem, fit.z, used, tolerance)
    return fit


def _spread(jacobian: FloatArray, variance: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Diagonal (m,) of H P H^T with the posterior P of the used rows."""
    whitened = jacobian[used] / np.sqrt(variance[used])[:, None]
    normal = whitened.T @ whitened + np.eye(jacobian.shape[1])
    spread: FloatArray = np.einsum("mn,nm->m", jacobian, np.linalg.solve(normal, jacobian.T))
    return spread


def row_variance(rows: Rows) -> FloatArray:
    return np.maximum(rows.noise_variance, SMALLEST_VARIANCE)
