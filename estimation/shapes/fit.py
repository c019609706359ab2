"""Least-squares surfaces from points alone: no start is needed, and what is not determined is refused."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from estimation.shapes.checks import (
    Points,
    checked_points,
    checked_sigma,
    flags_of,
    refuse_other_surface,
    refuse_undetermined,
)
from estimation.shapes.cone import Cone
from estimation.shapes.cylinder import Cylinder
from estimation.shapes.optimum import FINEST, Optimum, minima, minimise
from estimation.shapes.passes import NO_WEIGHTS
from estimation.shapes.plane import Plane
from estimation.shapes.refusals import Cause, FitRefused
from estimation.shapes.result import SurfaceFit
from estimation.shapes.sampling import spread
from estimation.shapes.shape import Shape
from estimation.shapes.sphere import Sphere
from estimation.shapes.suspicions import suspicions
from estimation.shapes.torus import Torus
from estimation.transform import FloatArray

KINDS: Final[dict[str, type[Shape]]] = {each.KIND: each for each in (Plane, Sphere, Cylinder, Cone, Torus)}
SAMPLE: Final = 2000  # points that find the minimum; all of them then refine it
_FINE: Final = 1e-11  # step that may be left with more points, in sizes and radians
_WORTH: Final = 10.0  # times the variance: what a freedom must take off the squares to be needed
_UNLIKELY: Final = 1e-3  # probability of so large residuals, below which a surface does not fit
_HUBER: Final = 1.345  # standard deviations: 95 % as efficient as least squares on honest data
_ROBUST_ROUNDS: Final = 50
_FALSE_ALARMS: Final = 0.01  # of the outlier gate, over all points together
_LARGEST_REJECTED: Final = 0.10
_SCALE_OF_MEDIAN: Final = 1.4826  # standard deviation over median absolute deviation, normal distribution


def fit_surface(
    kind: str, points_m: FloatArray, sigma_m: float | FloatArray | None = None, robust: bool = False
) -> SurfaceFit:
    """Surface of least (weighted) squared orthogonal distances.

    Parameters
    ----------
    kind : "plane", "sphere", "cylinder", "cone" or "torus".
    points_m : (n, 3), metres.
    sigma_m : standard deviation along the normal, for all points or (n,); None: from the residuals.
    robust : Huber's loss first, then a gate for outliers (1 % false alarms over all points), then least
        squares of the others; at most 10 % of the points may be left out.

    Raises
    ------
    FitRefused : the points do not determine this surface, or lie on another one; its `cause` says why.

    Notes
    -----
    Covariance to first order, (J^T W J)^-1 at the minimum.
    """
    fit = fit_without_second_thoughts(kind, points_m, sigma_m, robust)
    flags = suspicions(fit, np.asarray(points_m, dtype=np.float64), KINDS.values(), robust)
    return replace(fit, flags=flags + fit.flags)


def fit_without_second_thoughts(
    kind: str, points_m: FloatArray, sigma_m: float | FloatArray | None = None, robust: bool = False
) -> SurfaceFit:
    """`fit_surface` without the flags that look at its distances again: for those who compare kinds."""
    checked = checked_points(points_m, KINDS[kind], sigma_known=sigma_m is not None)
    sigma = checked_sigma(sigma_m, len(checked.points_m))
    weights = NO_WEIGHTS if sigma is None or sigma.ndim == 0 else 1.0 / sigma
    best, ratio = _global_minimum(KINDS[kind], checked, weights, sigma)
    if robust:
        best, weights = _without_outliers(best, checked, weights, sigma)
    return _result(best, checked, weights, sigma, ratio)


def _global_minimum(
    kind: type[Shape], checked: Points, weights: FloatArray, sigma: FloatArray | None
) -> tuple[Optimum, float]:
    """The lowest minimum for all points, and the cost of the next one over its cost."""
    points = checked.points_m
    count = len(points)
    places = spread(count, SAMPLE)
    found = minima(kind, points[places], weights[places] if len(weights) else NO_WEIGHTS)
    if not found:
        raise FitRefused(
            Cause.NO_CONVERGENCE, f"No {kind.KIND} was found near the points", "Name another surface"
        )
    best = _refined(found[0].shape, checked, weights)
    if not best.converged:
        raise _unsettled(best, points[places], sigma[places] if sigma is not None and sigma.ndim else sigma)
    if len(found) == 1:
        return best, np.inf
    if len(places) == count and (len(weights) or sigma is not None):
        gap = (found[1].cost - found[0].cost) / (1.0 if len(weights) else float(sigma) ** 2)  # type: ignore[arg-type]
        if gap < 9.0:
            raise FitRefused(
                Cause.AMBIGUOUS,
                f"Two different surfaces of kind {kind.KIND} fit the points equally well",
                "Measure a larger piece of the surface",
            )
    floor = (1e-12 * checked.size_m) ** 2 * len(places)
    return best, float(found[1].cost / max(found[0].cost, floor))


def _unsettled(best: Optimum, points_m: FloatArray, sigma: FloatArray | None) -> FitRefused:
    """The refusal of a fit that does not settle: where a simpler surface does as well, and elsewhere."""
    shape = best.shape
    weights = 1.0 / sigma if sigma is not None and sigma.ndim else np.ones(len(points_m))
    square = float(np.sum((shape.distance(points_m) * weights) ** 2))
    for simpler in KINDS.values():
        spare = len(shape.FREEDOMS) - len(simpler.FREEDOMS)
        worth = 1.0 + _WORTH * spare / max(len(points_m) - len(shape.FREEDOMS), 1)
        if spare <= 0:
            break
        try:
            fit = fit_without_second_thoughts(simpler.KIND, points_m, sigma)
        except FitRefused:
            continue
        if fit.cost <= worth * square and not (fit.p_value is not None and fit.p_value < _UNLIKELY):
            return FitRefused(
                Cause.SIMPLER_SURFACE,
                f"The fit of a {shape.KIND} does not settle, and a {simpler.KIND} fits no worse than what it "
                "reached",
                f"Fit a {simpler.KIND}, or measure a larger piece of the {shape.KIND}",
            )
    return FitRefused(
        Cause.NO_CONVERGENCE,
        f"The fit of a {shape.KIND} did not settle in {best.iterations} iterations",
        "Name another surface, or measure a larger piece of this one",
    )


def _refined(start: Shape, checked: Points, weights: FloatArray) -> Optimum:
    centroid = checked.centroid_m
    # With many points a step to the last digit is not worth its pass.
    tolerance = FINEST if len(checked.points_m) <= SAMPLE else _FINE
    found = minimise(start.settled(centroid), checked.points_m, weights, checked.size_m, tolerance)
    return replace(found, shape=found.shape.settled(centroid))


@dataclass(frozen=True, slots=True, eq=False)
class _Scatter:
    """Standard deviation of each point, given or from the median of the residuals."""

    sigma: FloatArray | None

    def of(self, residual: FloatArray) -> FloatArray:
        if self.sigma is not None:
            return np.broadcast_to(self.sigma, residual.shape)
        middle = _SCALE_OF_MEDIAN * float(np.median(np.abs(residual)))
        return np.full(len(residual), max(middle, np.finfo(np.float64).tiny))


def _without_outliers(
    start: Optimum, checked: Points, weights: FloatArray, sigma: FloatArray | None
) -> tuple[Optimum, FloatArray]:
    """Least squares of the points that pass the gate; the weight of the others is 0."""
    points = checked.points_m
    scatter = _Scatter(sigma)
    best = start
    for _ in range(_ROBUST_ROUNDS):
        residual = best.shape.distance(points)
        scaled = np.abs(residual) / scatter.of(residual)
        soft = np.sqrt(_HUBER / np.maximum(scaled, _HUBER)) * (weights if len(weights) else 1.0)
        after = minimise(best.shape, points, soft, checked.size_m, tolerance=1e-9)
        moved = np.max(np.abs(after.shape.distance(points) - residual))
        best = after
        if moved < 1e-3 * float(np.median(scatter.of(residual))):
            break
    limit = -ndtri(_FALSE_ALARMS / (2.0 * len(points)))
    full = weights if len(weights) else np.ones(len(points))
    kept = np.zeros(len(points), dtype=bool)
    for _ in range(_ROBUST_ROUNDS):
        residual = best.shape.distance(points)
        passing = np.abs(residual) <= limit * scatter.of(residual)
        if np.count_nonzero(~passing) > _LARGEST_REJECTED * len(points):
            raise FitRefused(
                Cause.OUTLIERS,
                f"{np.count_nonzero(~passing)} of {len(points)} points lie off the surface, more than 10 %",
                "Separate the surfaces in the file, or name the right one",
            )
        if np.array_equal(passing, kept):
            break
        kept = passing
        best = _refined(best.shape, checked, np.where(kept, full, 0.0))
    if kept.all() and not len(weights):
        return _refined(best.shape, checked, NO_WEIGHTS), NO_WEIGHTS
    return best, np.where(kept, full, 0.0)


def _result(
    best: Optimum, checked: Points, weights: FloatArray, sigma: FloatArray | None, ratio: float
) -> SurfaceFit:
    shape, points = best.shape, checked.points_m
    if len(weights):
        used = weights > 0.0
        residual = shape.distance(points)[used]
        count, square = len(residual), float(residual @ residual)
        rejected = np.flatnonzero(~used)
    else:
        count, square = len(points), best.cost
        rejected = np.empty(0, dtype=np.intp)
    redundancy = count - len(shape.FREEDOMS)
    scalar = sigma is None or sigma.ndim == 0
    if sigma is None:
        sigma_m: float | None = float(np.sqrt(square / redundancy))
        factor, dof = None, float(redundancy)
    else:
        sigma_m = float(sigma) if scalar else None
        weighted = square / float(sigma) ** 2 if scalar else best.cost
        factor, dof = (weighted / redundancy if redundancy else None), np.inf
    refuse_undetermined(shape, best.information, sigma_m if scalar else 1.0, checked.size_m)
    refuse_other_surface(shape, float(np.sqrt(square / count)), checked.size_m)
    frame, jacobian = shape.reported()
    variance = sigma_m**2 if scalar and sigma_m is not None else 1.0
    covariance = variance * (jacobian @ np.linalg.inv(best.information) @ jacobian.T)
    fit = SurfaceFit(
        shape=shape,
        frame=frame,
        parameter_names=shape.freedoms,
        covariance=(covariance + covariance.T) / 2.0,
        sigma_m=sigma_m,
        dof=dof,
        redundancy=redundancy,
        rms_m=float(np.sqrt(square / count)),
        variance_factor=factor,
        points=count,
        rejected=rejected,
        flags=(),
        iterations=best.iterations,
        initial_cost=best.initial_cost,
        cost=best.cost,
        stop_reason=best.stop_reason,
        alternative_ratio=ratio,
        _points_m=points,
        _weights=weights,
        _information=best.information,
    )
    return flags_of(fit)
