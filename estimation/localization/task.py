"""Localization of an object from points on its surfaces: a problem in, a frozen result out, no guess."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief
from estimation.errors import DegenerateGeometry, EstimationError
from estimation.localization.alignment import descent
from estimation.localization.feature_search import search_features
from estimation.localization.points import SharedError, SurfacePoints
from estimation.localization.surface_search import search_surface
from estimation.solver import Update, update
from estimation.surfaces import Feature, feature_table, signed_distance
from estimation.surfaces.feature import freeform
from estimation.surfaces.shape import Shape
from estimation.transform import FloatArray, Transform, log_pose

AMBIGUOUS_RATIO: Final = 10.0  # of the costs of two poses, below which neither is preferred
CONSISTENCY_LEVEL: Final = 1e-3  # probability that honest residuals are called too large
OUTLIER_LEVEL: Final = 1e-3  # probability that an honest batch loses a point
_SEEN: Final = 0.9  # share of the points that a pose must show to the sensor: noise turns a few at an edge
_SAME_SIGMAS: Final = 30.0  # two minima closer than this many standard deviations are one
_LARGEST_M: Final = 20.0  # metres from the base: no cell is as large


class Status(StrEnum):
    """What a result is worth."""

    OK = "ok"
    FLAGGED = "flagged"  # a pose is given, with a reason to look at it
    REFUSED = "refused"  # no pose is given


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Localization:
    """Points that were measured on an object, and what is known of the object.

    Attributes
    ----------
    base_p : (m, 3) points in the frame `base`, metres.
    covariance : (3, 3) or (m, 3, 3) of a point, m^2; the part that is independent of the other points.
    surface : the features of the object, in its frame, any mix of kinds, with `index` (m,) that says which of
        them each point lies on; or one free form (mesh or patch) of which nothing more is known.
    shared : errors that act on all points at once, such as that of the hand-eye calibration.
    form_std_m : by feature name, how far its surface may lie off as a whole along the normal.
    toward_sensor : (m, 3) directions from the points to where they were seen from, in the base; a pose from
        which they would have been seen through the material is none. Planes need it: turned by half about the
        normal of one of three, the others lie in themselves, inside out.
    consider : names of shared errors that are carried but not updated.
    frames : names of the base and of the object.
    """

    base_p: FloatArray
    covariance: FloatArray
    surface: tuple[Feature, ...] | Shape
    index: NDArray[np.intp] | None = None
    shared: tuple[SharedError, ...] = ()
    form_std_m: Mapping[str, float] = field(default_factory=dict)
    toward_sensor: FloatArray | None = None
    consider: tuple[str, ...] = ()
    frames: tuple[str, str] = ("base", "object")

    @property
    def features(self) -> tuple[Feature, ...]:
        """The features, with a deviation for the form of those that have one."""
        given = self.surface if isinstance(self.surface, tuple) else (freeform("surface", self.surface),)
        return tuple(
            replace(each, deviations=("offset",), blocks=(f"form.{each.name}",))
            if self.form_std_m.get(each.name)
            else each
            for each in given
        )


@dataclass(frozen=True, slots=True, eq=False)
class Localized:
    """Where the object is, or why that cannot be said.

    Attributes
    ----------
    reason, remedy : what was seen and what to do; empty when the status is OK.
    estimate : posterior with budget, residuals and diagnostics; its pose block has the object's name.
    alternatives : (k, 4, 4) other poses that the search found, with their cost over that of the best (k,).
    """

    status: Status
    reason: str
    remedy: str
    estimate: Update | None
    alternatives: FloatArray
    cost_ratios: FloatArray
    object: str

    @property
    def base_T_object(self) -> Transform:
        """The pose. Raises EstimationError when the task was refused."""
        return self._update.belief.transform(self.object)

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of right perturbations of `base_T_object` (form A), order (t, phi), m and rad."""
        return self._update.belief.block_covariance(self.object)

    @property
    def _update(self) -> Update:
        if self.estimate is None:
            raise EstimationError(f"The object was not localized: {self.reason}", self.remedy)
        return self.estimate


def localize(problem: Localization) -> Localized:
    """The pose of an object, with everything needed to judge it.

    Never raises for bad data: they come back refused, with the reason. Refused are points that leave a
    freedom open, two poses that fit (costs within a factor of ten), more contradictions than outliers can
    explain, and residuals ten times what was declared; flagged are single outliers and residuals that are
    too large or too small.
    """
    try:
        _check(problem)
        poses, square = _search(problem)
        return _estimated(problem, poses, square)
    except EstimationError as error:
        return _refused(problem, error)


def _check(problem: Localization) -> None:
    points, covariance = np.asarray(problem.base_p), np.asarray(problem.covariance)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 6:
        raise EstimationError(f"Points {points.shape} for 6 freedoms", "Measure at least 6 points, (m, 3)")
    if not np.isfinite(points).all():
        raise EstimationError("A point is not a finite number", "Take it out, or measure it again")
    if np.abs(points).max() > _LARGEST_M:
        raise EstimationError(
            f"A point {np.abs(points).max():.4g} m from the base, limit {_LARGEST_M:g} m", "Give metres"
        )
    if covariance.shape not in ((3, 3), (len(points), 3, 3)) or not np.isfinite(covariance).all():
        raise EstimationError(
            f"Covariance {covariance.shape} of {len(points)} points", "Give (3, 3) or (m, 3, 3)"
        )
    if (
        not np.linalg.eigvalsh(covariance).min() >= 0.0
        or not np.trace(covariance, axis1=-2, axis2=-1).min() > 0
    ):
        raise EstimationError("A point without noise, or with a negative variance", "Declare its noise")
    if problem.index is None:
        if isinstance(problem.surface, tuple) and len(problem.surface) != 1:
            raise EstimationError(
                f"{len(problem.surface)} features, and no point says which it lies on",
                "Name them, or give one mesh of the whole object",
            )
    elif len(problem.index) != len(points) or not 0 <= np.min(problem.index) <= np.max(problem.index) < len(
        problem.features
    ):
        raise EstimationError("The index does not name a feature for each point", "Count from 0")


def _index(problem: Localization) -> NDArray[np.intp]:
    return np.zeros(len(problem.base_p), dtype=np.intp) if problem.index is None else problem.index


def _search(problem: Localization) -> tuple[FloatArray, FloatArray]:
    """Distinct poses (k, 4, 4), best first, and their mean square distances (k,)."""
    features, index = problem.features, _index(problem)
    if len(features) == 1 and features[0].shape is not None:
        poses, square = search_surface(features[0].shape, problem.base_p)
    else:
        poses, square = search_features(features, index, problem.base_p)
    if problem.toward_sensor is None:
        return poses, square
    seen = []
    for pose in poses:
        object_p = (problem.base_p - pose[:3, 3]) @ pose[:3, :3]
        outward = signed_distance(features, index, object_p).gradient @ pose[:3, :3].T
        seen.append(np.mean(np.einsum("mi,mi->m", outward, problem.toward_sensor) > 0.0) >= _SEEN)
    if not any(seen):
        raise EstimationError(
            "In no pose that fits would the points have been seen from outside the material",
            "Check the directions to the sensor, and the sides of the features",
        )
    return poses[seen], square[seen]


def _estimated(problem: Localization, poses: FloatArray, square: FloatArray) -> Localized:
    features, name = problem.features, problem.frames[1]
    belief = Belief()
    for shared in problem.shared:
        belief = belief.with_block(
            shared.name,
            np.zeros(len(shared.covariance)),
            covariance=shared.covariance,
            freedoms=shared.freedoms,
        )
    for block, size in feature_table(features).blocks:
        std = problem.form_std_m[block.removeprefix("form.")]
        belief = belief.with_block(block, np.zeros(size), std=std, freedoms=("offset",), source="form")
    starts = [Transform(*problem.frames, pose) for pose in poses]
    belief = belief.with_block(name, starts[0], std=np.inf)
    model = SurfacePoints(
        problem.base_p,
        np.broadcast_to(problem.covariance, (len(problem.base_p), 3, 3)),
        features,
        _index(problem),
        problem.shared,
        name,
    )
    variance = float(np.trace(problem.covariance, axis1=-2, axis2=-1).mean() / 3.0)
    ratios = (square + variance) / (square[0] + variance)
    best = _exact(problem, starts[0])
    found = update(
        belief.started({name: best}),
        model,
        targets=(name,),
        consider=problem.consider,
        robust="cauchy",
        reject_level=OUTLIER_LEVEL,
        tolerance=1e-6,
    )
    other = np.array([_apart(found, name, pose) for pose in poses[1:]], dtype=np.bool_)
    poses, ratios = poses[1:][other], ratios[1:][other]
    status, reason, remedy = _judged(found, ratios)
    return Localized(status, reason, remedy, None if status is Status.REFUSED else found, poses, ratios, name)


def _exact(problem: Localization, start: Transform) -> Transform:
    """A start that all points have agreed on, where the search took only some of them."""
    features = problem.features
    if len(features) > 1 or features[0].shape is None:
        return start
    std = np.sqrt(
        np.trace(np.broadcast_to(problem.covariance, (len(problem.base_p), 3, 3)), axis1=1, axis2=2) / 3
    )
    points = np.ascontiguousarray(problem.base_p)
    pose = descent(features[0].shape, points, 1.0 / std, start.matrix).pose
    return Transform(start.target, start.source, pose)


def _apart(found: Update, name: str, pose: FloatArray) -> bool:
    """Whether another minimum is another solution, and not the same one found with fewer points."""
    gap = log_pose(found.belief.transform(name).inverse().matrix @ pose)
    return bool(np.max(np.abs(gap) / found.belief.std(name)) > _SAME_SIGMAS)


def _judged(found: Update, ratios: FloatArray) -> tuple[Status, str, str]:
    if len(ratios) and ratios[0] < AMBIGUOUS_RATIO:
        return (
            Status.REFUSED,
            f"Two poses fit: the second has {ratios[0]:.3g} times the cost of the first, limit "
            f"{AMBIGUOUS_RATIO:g}",
            "Measure where the two differ, or say from where the points were seen",
        )
    if found.dof < 1:
        return Status.FLAGGED, "As many points as unknowns: nothing checks them", "Measure more points"
    test = found.consistency(CONSISTENCY_LEVEL)
    if found.variance_factor > 10.0:
        return (
            Status.REFUSED,
            f"The points do not fit the object: residuals have {found.variance_factor:.3g} times the "
            "variance declared, limit 10",
            "Check the object, the units and the names of the features, then measure again",
        )
    if not test.passed:
        side = "larger" if found.chi2 > test.upper else "smaller"
        return (
            Status.FLAGGED,
            f"Residuals are {side} than declared: chi-square {found.chi2:.4g}, honest data keep "
            f"{test.lower:.4g} to {test.upper:.4g}",
            "Check the declared noise",
        )
    if found.rejected.any():
        return (
            Status.FLAGGED,
            f"{int(found.rejected.sum())} of {len(found.rejected)} points contradict the others; left out",
            "Look at these points, measure them again",
        )
    return Status.OK, "", ""


def _refused(problem: Localization, error: EstimationError) -> Localized:
    reason = error.problem
    if isinstance(error, DegenerateGeometry):
        reason = f"The points do not hold the object: {reason}"
    nothing = np.empty((0, 4, 4))
    return Localized(Status.REFUSED, reason, error.remedy, None, nothing, np.empty(0), problem.frames[1])
