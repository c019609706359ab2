"""Localization of an object from points on its surfaces: a problem in, a frozen result out, no guess."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief
from estimation.errors import EstimationError
from estimation.localization.alignment import descent
from estimation.localization.feature_search import search_features
from estimation.localization.points import SharedError, SurfacePoints
from estimation.localization.surface_search import mean_square, search_surface
from estimation.surfaces import Feature, feature_table, signed_distance
from estimation.surfaces.feature import freeform
from estimation.surfaces.shape import Shape
from estimation.tasks import checks
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.solve import Ambiguity, Result, apart, estimated, judged, refused
from estimation.transform import FloatArray, Transform

_SEEN: Final = 0.9  # share of the points that a pose must show to the sensor: noise turns a few at an edge
_POSE_FREEDOMS: Final = 6
# Nothing but the shape of the surface tells of it: settling errors of an arm, for which other tasks have a
# larger one, cannot look like it.
_RANK_TOLERANCE: Final = 1e-4
_SETTLING: Final = 20_000  # points with which two poses are told apart
_SETTLED: Final = 1e-2  # standard deviations


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

    task: ClassVar[str] = "localization"

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

    @property
    def places(self) -> NDArray[np.intp]:
        """(m,) the feature of each point; of a single one all points are."""
        return np.zeros(len(self.base_p), dtype=np.intp) if self.index is None else self.index

    def check(self) -> Sequence[Finding]:
        """Everything wrong at sight; an empty list for sound data."""
        return checks.first_of(
            lambda: checks.numbers(self._arrays()),
            self._check_noise,
            self._check_names,
            lambda: checks.lengths({"base_p": self.base_p}),
            lambda: checks.repeated(np.column_stack([self.base_p, self.places]), _POSE_FREEDOMS),
            lambda: checks.count(len(self.base_p), _POSE_FREEDOMS),
        )

    def _arrays(self) -> dict[str, tuple[Any, checks.Shape]]:
        count = checks.rows_of(self.base_p)
        arrays: dict[str, tuple[Any, checks.Shape]] = {"base_p": (self.base_p, (None, 3))}
        if self.index is not None:
            arrays["index"] = (self.index, (count,))
        if self.toward_sensor is not None:
            arrays["toward_sensor"] = (self.toward_sensor, (count, 3))
        if np.shape(self.covariance) != (3, 3):
            arrays["covariance"] = (self.covariance, (count, 3, 3))
        return arrays

    def _check_noise(self) -> list[Finding]:
        if not np.isfinite(self.covariance).all():
            return checks.deviations({"covariance": np.nan})
        found = checks.deviations({"variance of points": np.linalg.eigvalsh(self.covariance)})
        if found or np.trace(self.covariance, axis1=-2, axis2=-1).min() > 0.0:
            return found
        return [Finding(Cause.NOISE, "A point has no noise", "Give the covariance of each point")]

    def _check_names(self) -> list[Finding]:
        if self.index is not None:
            return checks.indices({"index": (self.index, len(self.features))})
        if len(self.features) == 1:
            return []
        return [
            Finding(
                Cause.WRONG_SURFACE,
                f"{len(self.features)} features, and no point says which it lies on",
                "Name them, or give one mesh of the whole object",
            )
        ]

    def belief(self) -> Belief:
        """The pose, flat, and the priors of shared errors and form."""
        belief = Belief()
        for shared in self.shared:
            belief = belief.with_block(
                shared.name,
                np.zeros(len(shared.covariance)),
                covariance=shared.covariance,
                freedoms=shared.freedoms,
            )
        for block, size in feature_table(self.features).blocks:
            std = self.form_std_m[block.removeprefix("form.")]
            belief = belief.with_block(block, np.zeros(size), std=std, freedoms=("offset",), source="form")
        return belief.with_block(self.frames[1], Transform(*self.frames, np.eye(4)), std=np.inf)

    def model(self) -> SurfacePoints:
        """The points as measurements."""
        covariance = np.broadcast_to(self.covariance, (len(self.base_p), 3, 3))
        return SurfacePoints(self.base_p, covariance, self.features, self.places, self.shared, self.frames[1])


def localize(problem: Localization) -> Result:
    """The pose of an object as block "object" (or as `frames` name it), with everything needed to judge it.

    Never raises for bad data: as of every task, they come back refused or flagged, each with its cause.
    The search over all poses ranks its minima itself; all points refine the best one.
    """
    sight = problem.check()
    if checks.refusing(sight):
        return refused(problem.task, sight)
    try:
        poses, square = _search(problem)
        if not len(poses):
            return refused(problem.task, [*sight, _UNSEEN])
        return _estimated(problem, sight, poses, square)
    except EstimationError as error:
        return refused(problem.task, sight, error)


_UNSEEN: Final = Finding(
    Cause.WRONG_SURFACE,
    "In no pose that fits would the points have been seen from outside the material",
    "Check the directions to the sensor, and names and sides of the features",
)


def _search(problem: Localization) -> tuple[FloatArray, FloatArray]:
    """Distinct poses (k, 4, 4), best first, and their mean square distances (k,)."""
    features, index = problem.features, problem.places
    if len(features) == 1 and features[0].shape is not None:
        poses, square = _settled(
            problem, features[0].shape, search_surface(features[0].shape, problem.base_p)[0]
        )
    else:
        poses, square = search_features(features, index, problem.base_p)
    if problem.toward_sensor is None:
        return poses, square
    seen = np.zeros(len(poses), dtype=np.bool_)
    for i, pose in enumerate(poses):
        object_p = (problem.base_p - pose[:3, 3]) @ pose[:3, :3]
        outward = signed_distance(features, index, object_p).gradient @ pose[:3, :3].T
        seen[i] = np.mean(np.einsum("mi,mi->m", outward, problem.toward_sensor) > 0.0) >= _SEEN
    return poses[seen], square[seen]


def _settled(problem: Localization, shape: Shape, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the points roll to from each pose of the search, best first, and the mean squares there.

    The search takes few points and few steps: along a direction that they hardly determine, it leaves several
    poses on the way to one minimum.
    """
    order = np.random.default_rng(0).permutation(len(problem.base_p))[:_SETTLING]
    points = np.ascontiguousarray(problem.base_p[order])
    weight = 1.0 / _std(problem)[order]
    reached = np.stack([descent(shape, points, weight, pose, tolerance=_SETTLED).pose for pose in poses])
    square = np.array([mean_square(shape, points, pose) for pose in reached])
    best = np.argsort(square, kind="stable")
    return reached[best], square[best]


def _settled_count(problem: Localization) -> int:
    """Points with which the poses were told apart to the last; none where features are named."""
    return 0 if isinstance(problem.surface, tuple) else min(len(problem.base_p), _SETTLING)


def _std(problem: Localization) -> FloatArray:
    """Standard deviation (m,) of each point along an axis, the mean over all of them."""
    covariance = np.broadcast_to(problem.covariance, (len(problem.base_p), 3, 3))
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0))


def _estimated(
    problem: Localization, sight: Sequence[Finding], poses: FloatArray, square: FloatArray
) -> Result:
    belief, name = problem.belief(), problem.frames[1]
    starts: list[dict[str, Transform]] = [{name: Transform(*problem.frames, pose)} for pose in poses]
    best = {name: _exact(problem, starts[0][name])}
    found = estimated(belief.started(best), problem.model(), problem.consider, _RANK_TOLERANCE)
    variance = float(np.trace(problem.covariance, axis1=-2, axis2=-1).mean() / 3.0)
    ratios = (square + variance) / (square[0] + variance)
    gaps = _settled_count(problem) * (square - square[0]) / variance
    ambiguity = None
    for start, ratio, gap in zip(starts[1:], ratios[1:], gaps[1:], strict=True):
        if apart(found.belief, {name: found.belief.transform(name)}, start):
            ambiguity = Ambiguity(float(ratio), start, float(gap))
            break
    return judged(problem.task, found, belief, sight, found.belief.names, ambiguity)


def _exact(problem: Localization, start: Transform) -> Transform:
    """A start that all points have agreed on, where the search took only some of them."""
    features = problem.features
    if len(features) > 1 or features[0].shape is None:
        return start
    points = np.ascontiguousarray(problem.base_p)
    pose = descent(features[0].shape, points, 1.0 / _std(problem), start.matrix).pose
    return Transform(start.target, start.source, pose)
