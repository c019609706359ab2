"""How good any choice could be: a lower bound from the relaxed problem, with its own proof."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.design.criteria import WORST, Criterion
from estimation.design.problem import DesignProblem
from estimation.transform import FloatArray

GAP: Final = 2e-3  # relative, at which the bound is near enough to the relaxed optimum
ROUNDS: Final = 400
_SHARPEST: Final = 64.0
_CERTIFY_EVERY: Final = 10


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """No choice of `count` candidates, each once, has a smaller value than this.

    `weights` (m,) in 0..1 are the relaxed design that proves it; `relaxed` is its value, so that the distance
    of `value` to `relaxed` is what more rounds could still gain.
    """

    value: float
    relaxed: float
    weights: FloatArray


def lower_bound(
    problem: DesignProblem,
    count: int,
    criterion: Criterion = WORST,
    gap: float = GAP,
    rounds: int = ROUNDS,
) -> Bound:
    """Lower bound on the criterion over all choices of `count` of the m candidates.

    The choice is relaxed to weights w, 0 <= w <= 1 with sum `count`. There the criterion is convex, so at any
    w it lies above its tangent: value + min over v of gradient (v - w), which is solved by the `count`
    candidates of the steepest gradient. The weights come from a multiplicative iteration; however far it got,
    the bound holds.

    Source: Pukelsheim (2006), Optimal Design of Experiments (tangent bound); Silvey, Titterington and Torsney
    (1978) for the iteration, here with the cap of one use for each candidate.
    """
    count = min(count, len(problem))
    rows = problem.white_rows
    weights = np.full(len(problem), count / max(len(problem), 1))
    best, relaxed, kept = 0.0, np.inf, weights
    sharpness, power = 2.0, 1.0 if criterion.logarithmic else 0.5
    for turn in range(rounds):
        white = problem.white_covariance(weights)
        judged = problem.judged(white)
        values, axes = criterion.weight(judged, sharpness)
        used = values > 1e-12 * values.max()
        factor = (axes.swapaxes(-1, -2) @ (problem.white_targets @ white))[used]
        along = rows @ (factor * np.sqrt(values[used])[:, None]).T
        slope = np.einsum("mk,mk->m", along, along)  # minus the gradient
        value = criterion.value(judged)
        # Most that a step within the constraints could take off, by the tangent.
        most = np.partition(slope, len(slope) - count)[len(slope) - count :].sum()
        fall = float(most - slope @ weights)
        along_axes = np.einsum("gij,gji->gi", axes.swapaxes(-1, -2) @ judged, axes)
        held = float(np.sum(values * along_axes))  # trace(W Z): never above the value
        proven = value * np.exp(-fall) if criterion.logarithmic else held - fall
        if proven > best:
            best = float(proven)
        if value < relaxed:
            relaxed, kept = value, weights
        if best >= relaxed * (1.0 - gap):
            break
        weights = _capped(weights * (slope / max(slope.max(), 1e-300)) ** power, count)
        if turn % _CERTIFY_EVERY == _CERTIFY_EVERY - 1:
            sharpness = min(sharpness * 1.2, _SHARPEST)
    return Bound(best, float(relaxed), kept)


def _capped(weights: FloatArray, total: int) -> FloatArray:
    """Proportional to the weights, none above 1, with the given sum."""
    capped = np.zeros(len(weights), dtype=np.bool_)
    scaled = weights
    for _ in range(len(weights)):
        free = total - int(capped.sum())
        mass = float(weights[~capped].sum())
        if free <= 0 or mass <= 0.0:
            break
        scaled = np.where(capped, 1.0, weights * (free / mass))
        over = ~capped & (scaled > 1.0)
        if not over.any():
            break
        capped |= over
    return np.minimum(scaled, 1.0)
