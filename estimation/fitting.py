"""Minimum of the joint cost in whitened coordinates: Levenberg-Marquardt, robust start, outlier gate."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from estimation.chart import Chart, solved
from estimation.errors import ContradictingData, EstimationError
from estimation.model import Descent, DescentLimits, Ended, Passes, Point, Rows
from estimation.transform import FloatArray

Robust = Literal["none", "huber", "cauchy"]
LARGEST_REJECTED_SHARE: Final = 0.1
_TUNING: Final[Mapping[Robust, float]] = {"huber": 1.345, "cauchy": 2.385}  # 95 % efficient on honest noise
_REWEIGHTINGS: Final = 4  # passes with the noise variance taken at the latest estimate
_ROBUST_PASSES: Final = 12
_MEDIAN: Final = 0.6745  # of the size of a standard normal variable
SMALLEST_VARIANCE: Final = 1e-30  # m^2: a row without any noise has no finite weight
_FIRST_TOLERANCE: Final = 1e-2  # standard deviations, for passes that only prepare the next
# Coordinates are of the size of a metre, which is what residuals are rounded by.
_LIMITS: Final = DescentLimits(
    iterations=50, polishing_steps=3, rounding_m=1e-15, rounding=1e-14, largest_damping=1e12
)
_REASONS: Final[Mapping[Ended, str]] = {
    Ended.SMALL: "step and gradient small",
    Ended.FLOOR: "cost at its rounding",
    Ended.STUCK: "No step lowers the cost, gradient {gradient:.3g}, limit {tolerance:.3g}",
    Ended.LONG: "No convergence in {iterations} iterations: last step {last_step:.3g} standard deviations, "
    "limit {tolerance:.3g}",
}
_NEAR_START: Final = "Check that the nominal poses are near the real ones, and the readings"


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A minimum, with what led there."""

    z: FloatArray
    rows: Rows
    jacobian: FloatArray  # (m, n) by z
    used: NDArray[np.bool_]
    costs: tuple[tuple[float, ...], ...]
    stop_reason: str
    converged: bool

    def require_converged(self) -> None:
        """Raise EstimationError unless this is a minimum."""
        if not self.converged:
            raise EstimationError(self.stop_reason, _NEAR_START)


def _solve(chart: Chart, start: Point, weight: FloatArray, tolerance: float) -> Descent:
    """Levenberg-Marquardt in z with fixed weights (m,) = 1/sigma per row; the prior adds to the cost."""
    if chart.compiled is None:
        return _in_steps(chart, start, weight, tolerance)
    return chart.compiled.descent(start[0], weight, chart.prior_rows, tolerance, _LIMITS)


def _in_steps(chart: Chart, start: Point, weight: FloatArray, tolerance: float) -> Descent:
    z, rows, jacobian = start
    prior = chart.prior_rows
    prior_normal = np.diag(prior)
    residual = weight * rows.residual_m
    cost = float(residual @ residual + z @ (prior * z))
    costs, damping, growth, last_step, polished = [cost], 0.0, 2.0, np.inf, 0
    for _ in range(_LIMITS.iterations):
        whitened = weight[:, None] * jacobian
        normal = whitened.T @ whitened + prior_normal
        gradient = whitened.T @ residual + prior * z
        newton = solved(normal, -gradient)
        # Never below zero but for rounding, along freedoms that are next to open.
        expected = max(float(-gradient @ newton), 0.0)  # the undamped step squared, in posterior sigmas
        steepest = float(np.max(np.abs(gradient) / np.sqrt(np.diag(normal)), initial=0.0))
        if steepest <= tolerance and min(last_step, np.sqrt(expected)) <= tolerance:
            return Descent(Ended.SMALL, (z, rows, jacobian), (tuple(costs),), steepest, last_step)
        if polished >= _LIMITS.polishing_steps:
            return Descent(Ended.FLOOR, (z, rows, jacobian), (tuple(costs),), steepest, last_step)
        # Below the rounding of the cost no step can prove that it helps: take a few in good faith.
        rounding = _LIMITS.rounding_m * float(np.linalg.norm(residual * weight)) + _LIMITS.rounding * cost
        at_floor = expected <= rounding
        polished += at_floor
        while True:
            if damping == 0.0 or at_floor:
                step = newton
            else:
                step = solved(normal + damping * np.diag(np.diag(normal)), -gradient)
            trial = z + step
            _, trial_rows, trial_jacobian = chart.evaluate(trial)
            trial_residual = weight * trial_rows.residual_m
            trial_cost = float(trial_residual @ trial_residual + trial @ (prior * trial))
            promised = float(-step @ (2.0 * gradient + normal @ step))
            gain = (cost - trial_cost) / promised
            if trial_cost <= cost or at_floor:
                trial_cost = min(trial_cost, cost)
                break
            if damping > _LIMITS.largest_damping:
                return Descent(Ended.STUCK, (z, rows, jacobian), (tuple(costs),), steepest, last_step)
            damping, growth = max(damping * growth, 1e-3), growth * 2.0
        # Nielsen's rule: the better the linear model did, the less damping; a good step needs none.
        damping = 0.0 if gain > 0.9 else damping * max(1 / 3, 1 - (2 * gain - 1) ** 3)
        growth = 2.0
        last_step = float(np.sqrt(np.maximum(step @ normal @ step, 0.0)))
        z, rows, jacobian, residual, cost = trial, trial_rows, trial_jacobian, trial_residual, trial_cost
        costs.append(cost)
    return Descent(Ended.LONG, (z, rows, jacobian), (tuple(costs),), steepest, last_step)


def reweighted(
    chart: Chart, z: FloatArray, used: NDArray[np.bool_], tolerance: float, known: Point | None = None
) -> Fit:
    """Passes with noise variance and whitening taken at the estimate, until they stand still.

    `known` is the point at z when its rows are there already.
    """
    # The first variance is that of the prior's values: no use in converging to the last digit with it.
    passes = Passes(_REWEIGHTINGS, max(tolerance, _FIRST_TOLERANCE), tolerance, SMALLEST_VARIANCE)
    if chart.compiled is None:
        found = _in_passes(chart, z, used, passes, known)
    else:
        found = chart.compiled.reweighted(z, used, chart.prior_rows, passes, _LIMITS)
    reason = _REASONS[found.ended].format(
        gradient=found.gradient,
        last_step=found.last_step,
        tolerance=tolerance if len(found.costs) > 1 else passes.first_tolerance,
        iterations=_LIMITS.iterations,
    )
    return Fit(*found.point, used, found.costs, reason, found.ended <= Ended.FLOOR)


def _in_passes(
    chart: Chart, z: FloatArray, used: NDArray[np.bool_], passes: Passes, known: Point | None
) -> Descent:
    chart, point = _weighed(chart, z, known)
    variance = row_variance(point[1])
    costs: tuple[tuple[float, ...], ...] = ()
    for number in range(passes.most):
        tolerance = passes.tolerance if number else passes.first_tolerance
        found = _solve(chart, point, used / np.sqrt(variance), tolerance)
        costs, reached = costs + found.costs, found.point
        chart, point = _weighed(chart, reached[0], reached)
        latest = row_variance(point[1])
        settled = np.max(np.abs(latest / variance - 1.0)) < passes.tolerance
        if settled and point is not reached:
            turned = np.max(np.abs(point[1].residual_m - reached[1].residual_m) / np.sqrt(variance))
            settled = turned < passes.tolerance
        variance = latest
        if found.ended > Ended.FLOOR or (settled and number):
            break
    return found._replace(point=point, costs=costs)


def _weighed(chart: Chart, z: FloatArray, known: Point | None = None) -> tuple[Chart, Point]:
    """The chart that whitens as it does at z, and its rows there; `known` are those that it had so far."""
    weighed = chart.weighed_at(z)
    if known is not None and weighed.model is chart.model:
        return chart, known
    return weighed, weighed.evaluate(z)


def robust_start(chart: Chart, z: FloatArray, robust: Robust) -> FloatArray:
    """Iteratively reweighted least squares; only a start, so loose and few passes."""
    chart, point = _weighed(chart, z)
    sigma = np.sqrt(row_variance(point[1]))
    # Before the first fit the prior is part of every residual: judged by the noise alone, all are outliers.
    known = point[2] * chart.prior_rows
    scale = np.sqrt(sigma**2 + np.einsum("mn,mn->m", known, known))
    if not chart.prior_rows.all():  # where a flat start lies off, only the residuals themselves say how far
        scale = scale * max(float(np.median(_sizes(point[1], scale))) / _MEDIAN, 1.0)
    # Changes are judged in standard deviations: the prior's, for flat freedoms those that one row leaves.
    largest = np.max(np.abs(point[2]) / sigma[:, None], axis=0, initial=0.0)
    unit = np.where(chart.prior_rows > 0.0, 1.0, largest)
    for _ in range(_ROBUST_PASSES):
        before, rows, _ = point
        size = _sizes(rows, scale) / _TUNING[robust]
        weight = np.maximum(size, 1.0) ** -0.5 if robust == "huber" else (1.0 + size**2) ** -0.5
        point = _solve(chart, point, np.repeat(weight, rows.group) / sigma, _FIRST_TOLERANCE).point
        if np.max(np.abs(point[0] - before) * unit, initial=0.0) < _FIRST_TOLERANCE:
            break
        scale = sigma = np.sqrt(row_variance(point[1]))
    return point[0]


def cauchy_cost(chart: Chart, z: FloatArray) -> float:
    """Cost in which outliers count little: of honest data about that of least squares."""
    chart, (_, rows, _) = _weighed(chart, z)
    c = _TUNING["cauchy"]
    size = _sizes(rows, np.sqrt(row_variance(rows)))
    return float(rows.group * np.sum(c**2 * np.log1p((size / c) ** 2)) + z @ (chart.prior_rows * z))


def gated(chart: Chart, z: FloatArray, robust: Robust, level: float, tolerance: float) -> Fit:
    """Mahalanobis gate: each observation against what all the other accepted ones predict for it."""
    start = chart.evaluate(z)
    group = start[1].group
    count = len(start[1].residual_m) // group
    limit = float(chdtri(group, level / count))  # Bonferroni
    allowed = int(LARGEST_REJECTED_SHARE * count)
    used = np.ones(count, dtype=np.bool_)
    if robust != "none":  # judge first where outliers cannot hide each other, as if none were in the fit
        squared = _squared(chart, start, used, np.zeros_like(used))
        worst_ones = np.argsort(squared)[count - allowed :]
        used[worst_ones] = squared[worst_ones] <= limit
    fit = reweighted(chart, z, np.repeat(used, group), tolerance)
    for _ in range(2 * allowed + 3):
        squared = _squared(chart, (fit.z, fit.rows, fit.jacobian), used, used)
        before = used
        # Some may come back, and only the worst leaves at a time: it drags honest ones over the limit.
        used = before | (squared <= limit)
        worst = int(np.argmax(np.where(used, squared, -1.0)))
        used[worst] = squared[worst] <= limit
        if np.sum(~used) > allowed:
            raise ContradictingData(
                f"More than {allowed} of {count} measurements contradict the others"
                if allowed
                else f"The {count} measurements contradict each other, and of so few none can be left out",
                "Look for a moved object, a wrong feature or a loose sensor, then measure again",
            )
        if (used == before).all():
            break
        fit = reweighted(chart, fit.z, np.repeat(used, group), tolerance)
    fit.require_converged()
    return fit


def _sizes(rows: Rows, scale: FloatArray) -> FloatArray:
    """(g,) root mean square of each observation's residuals over their scale (m,)."""
    squares = ((rows.residual_m / scale) ** 2).reshape(-1, rows.group)
    return np.asarray(np.sqrt(squares.mean(axis=1)))


def _squared(chart: Chart, point: Point, used: NDArray[np.bool_], fitted: NDArray[np.bool_]) -> FloatArray:
    """Squared Mahalanobis distances (g,) of observations, given that those `used` (g,) determine P.

    The residual of an observation that was `fitted` (g,) has the covariance Q - H P H^T, else Q + H P H^T.
    """
    _, rows, jacobian = point
    variance, group = row_variance(rows), rows.group
    chosen = np.repeat(used, group)
    whitened = jacobian[chosen] / np.sqrt(variance[chosen])[:, None]
    normal = whitened.T @ whitened + np.diag(chart.prior_rows)
    across = solved(normal, jacobian.T).reshape(-1, len(used), group)
    spread = np.einsum("gkn,ngl->gkl", jacobian.reshape(len(used), group, -1), across)
    sign = np.where(fitted, -1.0, 1.0)[:, None, None]
    own = variance.reshape(-1, group)[:, :, None] * np.eye(group) + sign * spread
    values, vectors = np.linalg.eigh(own)
    values = np.maximum(values, 1e-9 * variance.reshape(-1, group).min(axis=1)[:, None])
    along = np.einsum("gk,gkl->gl", rows.residual_m.reshape(-1, group), vectors)
    return np.asarray(np.sum(along**2 / values, axis=1))


def row_variance(rows: Rows) -> FloatArray:
    """Q as a diagonal (m,), m^2, no row without any noise."""
    return np.maximum(rows.noise_variance, SMALLEST_VARIANCE)
