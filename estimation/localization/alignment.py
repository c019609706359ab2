"""Pose of a free form from points measured on it: exact nearest points, Gauss-Newton, few points first."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from estimation.belief import Belief
from estimation.errors import EstimationError
from estimation.observability import require_determined
from estimation.surfaces.shape import Shape, Sums
from estimation.transform import FloatArray, Transform

_COARSE: Final = (120, 1_000, 8_000)  # points that prepare the next level
_KINKS: Final = 0.15  # of a step near the minimum on facets: the next one, 0.14 and 0.16 on a blade
_UNSORTED: Final = 1_000  # points up to which sorting all of them does not pay
_COARSE_TOLERANCE: Final = 0.03  # standard deviations, of the level
LARGEST_ITERATIONS: Final = 60
# A step of so many standard deviations that does not lower the cost is within the roughness that the edges
# between facets give it: 0.02 to 0.25 on meshes of 10,000 to 80,000 triangles.
_ROUGH: Final = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A pose with what is needed to judge it.

    Attributes
    ----------
    covariance : (6, 6) of right perturbations of base_T_object (form A), order (t, phi), m and rad; from
        the declared standard deviations, which are taken as independent.
    cost, dof : sum of squared weighted distances (of the loss, if robust), and points less 6.
    iterations : passes over points at each level, few points first.
    converged, stop_reason : whether the error that is left is small. On a mesh it is often the roughness
        of the cost that ends the descent, at a tenth of a standard deviation: no minimum is better there.
    """

    base_T_object: Transform
    covariance: FloatArray
    cost: float
    dof: int
    iterations: tuple[int, ...]
    converged: bool
    stop_reason: str

    @property
    def variance_factor(self) -> float:
        """cost / dof: near 1 when the standard deviations are honest."""
        return self.cost / self.dof if self.dof else 1.0


def align(
    shape: Shape,
    base_p: FloatArray,
    std_m: ArrayLike,
    start: Transform,
    *,
    huber: float = np.inf,
    tolerance: float = 5e-4,
) -> Alignment:
    """The pose at which points are nearest to a surface, from a start that is near enough.

    Parameters
    ----------
    base_p : (m, 3), metres, frame of the base; of them no other correspondence is known.
    std_m : of each point along the surface's normal; one number or (m,).
    start : base_T_object to begin with.
    huber : residuals over so many standard deviations weigh less.
    tolerance : error that is left of the iteration, in posterior standard deviations.

    Raises
    ------
    EstimationError
        Less than 6 points, or points or standard deviations that are not finite and positive.
    DegenerateGeometry
        The points leave a direction open, which is named.

    Notes
    -----
    The distance is point to plane at the exact nearest point: Sallinen (2003), eq. (46-47), (51). Levels
    of a few points come first, because a pass over all of them costs as much for a bad pose as for a good.
    """
    points = np.ascontiguousarray(base_p, dtype=np.float64)
    weight = _weights(points, std_m)
    rng = np.random.default_rng(0)  # any points will do; the same ones for the same data
    pose, iterations = start.matrix, []
    sorted_ = False
    for count in (level for level in _COARSE if 4 * level <= len(points)):
        if count > _UNSORTED and not sorted_:
            points, weight, sorted_ = *_sorted(shape, points, weight, pose), True
        step = len(points) // count
        chosen = slice(None, step * count, step) if sorted_ else rng.integers(0, len(points), count)
        some, own = (np.ascontiguousarray(each[chosen]) for each in (points, weight))
        few = descent(shape, some, own, pose, huber, _COARSE_TOLERANCE)
        pose = few.pose
        iterations.append(few.passes)
    if not sorted_:
        points, weight = _sorted(shape, points, weight, pose)
    last = descent(shape, points, weight, pose, huber, tolerance)
    _require_determined(last.sums, start)
    return Alignment(
        base_T_object=Transform(start.target, start.source, last.pose),
        covariance=np.asarray(np.linalg.inv(last.sums.information)),
        cost=last.sums.cost,
        dof=len(points) - 6,
        iterations=(*iterations, last.passes),
        converged=last.converged,
        stop_reason=last.stop_reason,
    )


def _sorted(
    shape: Shape, points: FloatArray, weight: FloatArray, pose: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The points and their weights with neighbours next to each other."""
    order = shape.order(points, pose)
    same = weight.min() == weight.max()  # as mostly
    return np.take(points, order, axis=0), weight if same else np.take(weight, order)


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """Where a descent ended: pose (4, 4), and the sums of a pass so near to it that they hold there."""

    pose: FloatArray
    sums: Sums
    passes: int
    converged: bool
    stop_reason: str


def descent(
    shape: Shape,
    points: FloatArray,
    weight: FloatArray,
    pose: FloatArray,
    huber: float = np.inf,
    tolerance: float = 1e-2,
    most: int = LARGEST_ITERATIONS,
) -> Descent:
    """Levenberg-Marquardt from a pose (4, 4) with all of some points (m, 3), weights (m,) in 1/m.

    It ends unconverged before pass number `most`.
    """
    hints = shape.new_hints(len(points))
    sums, damping, before = shape.sums(points, weight, pose, hints, huber), 0.0, 0.0
    for passes in range(1, most):
        step = _step(sums, damping)
        length = float(np.sqrt(step @ sums.information @ step))
        trial = Transform("", "", pose).perturbed(step).matrix
        # Near the minimum steps shrink by the same factor each time, and so does the error; but not as fast
        # any more where what is left is a matter of points that change their facet.
        left = length * max(length / max(before, length, np.finfo(float).tiny), _KINKS * shape.kinked)
        if left < tolerance and damping == 0.0:
            return Descent(trial, sums, passes, True, "step small")
        found = shape.sums(points, weight, trial, hints, huber)
        if found.cost <= sums.cost:
            pose, sums, before = trial, found, length
            damping = 0.0 if damping < 1e-2 else 0.1 * damping
        elif length < _ROUGH and damping == 0.0:
            return Descent(pose, sums, passes + 1, True, "cost at the roughness of the facets")
        else:
            damping, before = max(10.0 * damping, 1e-2), 0.0
    return Descent(pose, sums, passes, False, f"step not small after {passes} passes")


def _step(sums: Sums, damping: float) -> FloatArray:
    diagonal = np.maximum(np.diag(sums.information), np.finfo(float).tiny)
    scale = 1.0 / np.sqrt(diagonal)
    scaled = sums.information * np.outer(scale, scale) + max(damping, 1e-12) * np.eye(6)
    return np.asarray(-scale * np.linalg.solve(scaled, scale * sums.vector))


def _weights(points: FloatArray, std_m: ArrayLike) -> FloatArray:
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 6:
        raise EstimationError(f"Pose from points {points.shape}", "Measure at least 6 points, (m, 3)")
    std = np.asarray(std_m, dtype=np.float64)
    if not np.isfinite(points).all() or not (np.isfinite(std).all() and np.all(std > 0.0)):
        raise EstimationError(
            "A point is not finite, or a standard deviation not positive", "Take out these measurements"
        )
    return np.ascontiguousarray(np.broadcast_to(1.0 / std, len(points)))


def _require_determined(sums: Sums, frames: Transform) -> None:
    belief = Belief().with_block(frames.source, frames, std=np.inf)
    values, vectors = np.linalg.eigh(sums.information)
    rows = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    require_determined(belief, rows, np.ones(6))
