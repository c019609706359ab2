"""The least-squares optimum of a shape: Levenberg-Marquardt to the last digit, from several starts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimation.shapes.passes import NO_WEIGHTS, products
from estimation.shapes.shape import Shape
from estimation.transform import FloatArray

_LARGEST_ITERATIONS: Final = 300
_FLOOR: Final = 1e-13  # of the cost: a smaller decrease cannot be told from rounding
_ROUNDING: Final = 1e-16
FINEST: Final = 1e-14  # step that may be left, in sizes of the data and radians
_FAST: Final = 0.05  # of the step before
_COARSE: Final = 1e-6
_COARSE_ITERATIONS: Final = 30  # a start that takes longer is a bad one
_LARGEST_DAMPING: Final = 1e12
_TRIED_STARTS: Final = 12
_TRIAL_ITERATIONS: Final = 6
_TRIAL_POINTS: Final = 500  # that rank the starts
_POLISHED_STARTS: Final = 4
_HOPELESS: Final = 1e4  # times the cost of a minimum, after the trial: a hundred times as far from the points
_FEW_POINTS: Final = 60  # for which any start may be the only good one
_AGREEING: Final = 3  # ways to the same minimum, from the best starts
_ENOUGH_TO_AGREE: Final = 15  # fewer points have minima that several starts find, and are not the lowest
_EXACT: Final = 1e-24  # mean square of a perfect fit, in squares of the size
_SAME: Final = 1e-6  # of the cost: two minima are one


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """A minimum of the sum of weighted squared distances, and how it was reached."""

    shape: Shape
    information: FloatArray  # (p, p) J^T J, weighted
    cost: float
    initial_cost: float
    iterations: int
    stop_reason: str
    converged: bool = True


def minimise(
    shape: Shape,
    points_m: FloatArray,
    weights: FloatArray = NO_WEIGHTS,
    size_m: float = 1.0,
    tolerance: float = FINEST,
    largest_iterations: int = _LARGEST_ITERATIONS,
) -> Optimum:
    """Minimum near a start.

    Parameters
    ----------
    points_m, weights : (n, 3), and (n,) or (0,) for ones: the cost is the sum of (weight distance)^2.
    size_m : of the data; steps are judged by it.
    tolerance : largest step that may be left, in sizes and radians.
    """
    count = len(shape.FREEDOMS)
    unit = np.array([1.0 if shape.is_angle(name) else size_m for name in shape.FREEDOMS])
    sums = products(shape, points_m, weights)
    # Weighted squares that coordinates rounded to 1e-16 of the size leave in a perfect fit.
    rounding = (_ROUNDING * size_m) ** 2 * (float(weights @ weights) if len(weights) else len(points_m))
    initial = float(sums[count, count])
    damping, growth, last_step = 0.0, 2.0, np.inf
    for iteration in range(largest_iterations):
        normal, gradient, cost = sums[:count, :count], sums[:count, count], float(sums[count, count])
        scale = np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float64).tiny))
        scaled, slope = normal / np.outer(scale, scale), gradient / scale
        while True:
            step, promised = _step(scaled, slope, damping)
            trial = shape.moved(step / scale)
            trial_sums = products(trial, points_m, weights)
            trial_cost = float(trial_sums[count, count])
            at_floor = promised <= _FLOOR * cost + rounding
            if trial_cost <= cost or at_floor:
                break
            if damping > _LARGEST_DAMPING:
                return Optimum(shape, normal, cost, initial, iteration, "no step lowers the cost")
            damping, growth = max(damping * growth, 1e-4), growth * 2.0
        length = float(np.max(np.abs(step / scale) / unit))
        # At the floor steps shrink until they are rounding: the last digit is where they do so no more.
        if at_floor and length > 0.9 * last_step:
            return Optimum(shape, normal, cost, initial, iteration, "cost and step at their rounding")
        if at_floor:
            damping = 0.0
        gain = (cost - trial_cost) / promised if promised > 0.0 else 1.0
        damping = 0.0 if gain > 0.75 or at_floor else damping * max(1 / 3, 1 - (2 * gain - 1) ** 3)
        # Where steps shrink fast, the next one would be this one times what it is to the last.
        shrunk = length / last_step
        left = length * shrunk if 0.0 < shrunk < _FAST else length
        growth, last_step, shape, sums = 2.0, length if damping == 0.0 else np.inf, trial, trial_sums
        if damping == 0.0 and left <= tolerance:
            cost = float(sums[count, count])
            return Optimum(shape, sums[:count, :count], cost, initial, iteration + 1, "step small")
    normal, cost = sums[:count, :count], float(sums[count, count])
    return Optimum(shape, normal, cost, initial, largest_iterations, "too many iterations", converged=False)


def _step(scaled: FloatArray, slope: FloatArray, damping: float) -> tuple[FloatArray, float]:
    """Solution of (scaled + damping I) step = -slope, and by how much it promises to lower the cost."""
    damped = scaled.copy()
    damped.flat[:: len(slope) + 1] += damping
    try:
        step = np.asarray(np.linalg.solve(damped, -slope), dtype=np.float64)
    except np.linalg.LinAlgError:  # a direction without any slope: it takes no step
        step = np.asarray(np.linalg.lstsq(scaled, -slope, rcond=1e-14)[0], dtype=np.float64)
    return step, float(-step @ (2.0 * slope + scaled @ step))


def minima(kind: type[Shape], points_m: FloatArray, weights: FloatArray = NO_WEIGHTS) -> list[Optimum]:
    """Local minima from the starts of a kind of shape, the lowest first; coarse: to 1e-6 of the size."""
    centre = points_m.mean(axis=0)
    centred = points_m - centre
    size = float(np.sqrt(np.mean(centred**2) * 3.0))
    unit = np.ascontiguousarray(centred / size)
    rounding = _EXACT * float(weights @ weights if len(weights) else len(unit))
    found: list[Optimum] = []
    tried = len(unit) > _FEW_POINTS
    for start in best_starts(kind.starts(unit), unit, weights):
        if tried and any(other.converged for other in found):
            cost = float(products(start, unit, weights)[-1, -1])
            if cost > _HOPELESS * min(other.cost for other in found) + rounding:
                continue
        each = minimise(start, unit, weights, 1.0, _COARSE, _COARSE_ITERATIONS)
        if np.isfinite(each.cost):
            found.append(each)
        lowest = min((other.cost for other in found), default=np.inf)
        agreeing = [o for o in found if o.converged and o.cost <= lowest * (1.0 + _SAME) + rounding]
        if len(agreeing) >= _AGREEING and len(points_m) >= _ENOUGH_TO_AGREE:
            break
    found.sort(key=lambda each: each.cost)
    distinct: list[Optimum] = []
    for each in found:
        if distinct and not each.converged:
            continue
        if not distinct or each.cost > distinct[-1].cost * (1.0 + _SAME) + rounding:
            distinct.append(each)
    return [
        replace(each, shape=each.shape.scaled(size, centre), cost=each.cost * size**2) for each in distinct
    ]


def best_starts(starts: Sequence[Shape], points: FloatArray, weights: FloatArray) -> list[Shape]:
    """The starts of least cost; of many points, those of least cost after a few steps from them."""
    settled = [start.settled(np.zeros(3)) for start in starts]
    ordered = _by_cost(settled, [float(products(each, points, weights)[-1, -1]) for each in settled])
    if len(points) <= _FEW_POINTS or len(ordered) <= _POLISHED_STARTS:
        return ordered
    step = max(len(points) // _TRIAL_POINTS, 1)
    points, weights = np.ascontiguousarray(points[::step]), weights[::step]
    tried = [
        minimise(each, points, weights, 1.0, _COARSE, _TRIAL_ITERATIONS) for each in ordered[:_TRIED_STARTS]
    ]
    return _by_cost([each.shape for each in tried], [each.cost for each in tried])[:_POLISHED_STARTS]


def _by_cost(shapes: Sequence[Shape], costs: Sequence[float]) -> list[Shape]:
    order = np.argsort(np.nan_to_num(costs, nan=np.inf), kind="stable")
    return [shapes[i] for i in order]
