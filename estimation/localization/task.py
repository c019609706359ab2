"""Localization of an object from points on its surfaces: a problem in, a frozen result out, no guess."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Belief
from estimation.errors import EstimationError
from estimation.localization.alignment import descent
from estimation.localization.feature_search import search_features
from estimation.localization.points import SharedError, SurfacePoints
from estimation.localization.surface_search import mean_square, search_surface
from estimation.localization.symmetry import check_symmetry
from estimation.surfaces import Feature, feature_table, signed_distance
from estimation.surfaces.feature import freeform
from estimation.surfaces.shape import Shape
from estimation.tasks import checks
from estimation.tasks.explanations import explained
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.mistakes import exchanged, other_units
from estimation.tasks.solve import Ambiguity, Result, agrees, apart, estimated, judged, misfits, refused
from estimation.transform import FloatArray, Transform

_SEEN: Final = 0.9  # share of the points that a pose must show to the sensor: noise turns a few at an edge
_POSE_FREEDOMS: Final = 6
# Nothing but the shape of the surface tells of it: settling errors of an arm, for which other tasks have a
# larger one, cannot look like it.
_RANK_TOLERANCE: Final = 1e-4
_SETTLING: Final = 20_000  # points with which two poses are told apart
_SETTLED: Final = 1e-2  # standard deviations
_ON_A_LINE: Final = 3.0  # standard deviations
_QUICK: Final = 10  # passes, within which points that fit have come near enough
_OUTSIDE: Final = 0.05  # share of the points that may be outliers when the size of all is looked at
# Half the width of the points, as a share of the free form that they lie on: a smaller piece fits at many
# places, and tells nothing of the size.
_PIECE: Final = (0.05, 1.0)
_MOST_PAIRS: Final = 3  # of names to exchange where a free form is among them: each takes seconds
_TOLD_SCALE: Final = 0.1  # relative standard deviation of the size: units differ by 10 or more


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
            self._check_geometry,
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

    def _check_geometry(self) -> list[Finding]:
        """On a line is what is there but for the noise: points on a slender rod determine its pose."""
        across_m2 = np.linalg.eigvalsh(np.cov(self.base_p, rowvar=False))[1]
        thin = across_m2 < _ON_A_LINE**2 * _std(self).max() ** 2
        line = checks.spread(self.base_p, "points") if thin else []
        return line + check_symmetry([self.features[i] for i in np.unique(self.places)])

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

    def explanations(self) -> list[tuple[Finding, "Localization"]]:
        """Points in another unit, and two names of features exchanged."""
        found = [
            (finding, replace(self, base_p=self.base_p / factor))
            for finding, factor in other_units("The points fit when")
        ]
        found = [(finding, other) for finding, other in found if other.fits_in()]
        if self.index is None:
            return found
        pairs = exchanged(self.index, [feature.name for feature in self.features])
        if len(pairs) > _MOST_PAIRS and any(self.features[i].shape for i in np.unique(self.index)):
            return found
        return found + [(finding, replace(self, index=index)) for finding, index in pairs]

    def fits_in(self) -> bool:
        """Whether the points are not wider than the free forms that they lie on, nor next to nothing."""
        smallest, largest = _PIECE
        for place, feature in enumerate(self.features):
            if feature.shape is None or not len(points := self.base_p[self.places == place]):
                continue
            points = points[:: -(-len(points) // _SETTLING)]
            middle = np.median(points, axis=0)
            radius_m = np.quantile(np.linalg.norm(points - middle, axis=1), 1.0 - _OUTSIDE)
            size_m = np.linalg.norm(np.ptp(feature.shape.coarse.vertices_m, axis=0))
            if not smallest * size_m <= radius_m <= largest * size_m:
                return False
        return True

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
    The search over all poses ranks its minima itself; all points refine the best one. Points that fit badly
    are tried again in other units, and with names exchanged: what makes them fit is named.
    """
    sight = problem.check()
    if checks.refusing(sight):
        return refused(problem.task, sight)
    searched = _Searched(problem)
    # A search is slow where points cannot lie on the surface at all.
    result = _located(searched, sight) if problem.fits_in() else None
    if result is None or misfits(result) or _UNSEEN in result.findings:
        mistake = explained(searched, _holds)
        if mistake is not None:
            return refused(problem.task, [*sight, mistake])
    return _located(searched, sight) if result is None else result


@dataclass(frozen=True, eq=False)
class _Searched:
    """A problem with where its points can be: what costs most, and is needed more than once."""

    problem: Localization
    undone: Finding | None = None

    @cached_property
    def minima(self) -> tuple[FloatArray, FloatArray]:
        """Distinct poses (k, 4, 4), best first, and their mean square distances (k,)."""
        return _search(self.problem, quick=self.undone is not None)

    def check(self) -> Sequence[Finding]:
        return self.problem.check()

    def rough(self) -> Belief:
        return self.problem.belief()

    def model(self) -> SurfacePoints:
        return self.problem.model()

    def starts(self) -> list[dict[str, Transform]]:
        name, frames = self.problem.frames[1], self.problem.frames
        return [{name: Transform(*frames, pose)} for pose in self.minima[0]]

    def explanations(self) -> list[tuple[Finding, "_Searched"]]:
        return [(finding, _Searched(other, finding)) for finding, other in self.problem.explanations()]


def _located(searched: _Searched, sight: Sequence[Finding]) -> Result:
    task = searched.problem.task
    try:
        if not len(searched.minima[0]):
            return refused(task, [*sight, _UNSEEN])
        return _estimated(searched, sight)
    except EstimationError as error:
        return refused(task, sight, error)


def _holds(searched: _Searched) -> bool:
    """Whether nearly all points agree; of those in another unit, whether they would in no other as well."""
    result, undone = _located(searched, ()), searched.undone
    rescaled = undone is not None and undone.cause is Cause.WRONG_UNITS
    return agrees(result) and (not rescaled or _tells_scale(searched.problem, result))


def _tells_scale(problem: Localization, result: Result) -> bool:
    """Whether points of another size would not fit: a corner of three planes looks the same in any size.

    There, noise that was declared too small must not pass for another unit.
    """
    name, middle = problem.frames[1], problem.base_p.mean(axis=0)
    scale = SharedError("scale of points", np.eye(1), (problem.base_p - middle)[:, :, None], ("scale",))
    scaled = replace(problem, shared=(*problem.shared, scale))
    start = scaled.belief().started({name: result.belief.transform(name)})
    try:
        found = estimated(start, scaled.model(), scaled.consider, _RANK_TOLERANCE)
    except EstimationError:
        return False
    return bool(found.belief.std(scale.name)[0] < _TOLD_SCALE)


_UNSEEN: Final = Finding(
    Cause.WRONG_SURFACE,
    "In no pose that fits would the points have been seen from outside the material",
    "Check the directions to the sensor, and names and sides of the features",
)


def _search(problem: Localization, quick: bool) -> tuple[FloatArray, FloatArray]:
    """Distinct poses (k, 4, 4), best first, and their mean square distances (k,).

    quick : only whether there is a pose that fits is of interest.
    """
    features, index = problem.features, problem.places
    shape = features[0].shape if len(features) == 1 else None
    if shape is not None and quick:
        poses, square = search_surface(shape, problem.base_p, count=1, most=_QUICK)
    elif shape is not None:
        poses, square = _settled(problem, shape, search_surface(shape, problem.base_p)[0])
    else:
        poses, square = search_features(features, index, problem.base_p, quick=quick)
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


def _estimated(searched: _Searched, sight: Sequence[Finding]) -> Result:
    problem, square, starts = searched.problem, searched.minima[1], searched.starts()
    belief, name = problem.belief(), problem.frames[1]
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
