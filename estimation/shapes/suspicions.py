"""What the distances of a finished fit give away: another surface, points far off, points told twice."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc, stdtrit

from estimation.numbered import numbered
from estimation.shapes.optimum import minima, minimise
from estimation.shapes.passes import NO_WEIGHTS
from estimation.shapes.refusals import Cause, Flag
from estimation.shapes.result import SurfaceFit
from estimation.shapes.sampling import distinct, repeated_share, spread, step_of
from estimation.shapes.shape import Shape
from estimation.transform import FloatArray

RESOLUTION: Final = 1.2e-7  # of the largest coordinate: meshes and clouds are stored in single precision
_ALL: Final = 100_000  # points that are looked at one by one
_MANY: Final = 6_000  # of more points, unless these scatter less than all do
_ODD: Final = 1.05
_SAMPLE: Final = 2_000  # points whose neighbours are compared
_FEWER: Final = 1_000  # of very many
_MOST_COMPARED: Final = 300  # points through which other kinds are laid
_FEW: Final = 300  # of which neighbours may tell little: other kinds are tried if the points lie off at all
_OFF: Final = 0.001  # rms over size
_LEAST_DOF: Final = 3  # of another kind: nearly any points lie on a surface with as many freedoms
_LIKELY: Final = 3.0  # standard deviations of the correlation of neighbours that make other kinds worth a try
_SURE: Final = 5.0
_SYSTEMATIC: Final = 0.5  # correlation of neighbours: as much is common as is each point's own
_BETTER: Final = 9.0  # times less variance of the distances
_CHANCE: Final = 1e-6
_COARSE: Final = 0.005  # rms over size: a form error is smaller, another surface is not
_NEAR: Final = 2.5  # times the scale
_PLENTY: Final = 5_000  # points
_PLAIN: Final = 5.0  # times the scale, within which all are honest
_FAR: Final = 10.0  # times the scale of the others
_GROSS: Final = 20.0  # beyond what the tails of any sensor reach
_ENOUGH: Final = 10  # points a freedom from which the median distance is a scale
_MOST_OUTLIERS: Final = 0.10  # more are no outliers, but another scatter
_OUTLIER_CHANCE: Final = 1e-4  # over all points together
_SCALE_OF_MEDIAN: Final = 1.4826
_FACING: Final = 0.5  # of the largest component of the normals: rounding across the surface says nothing


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Points (n, 3), their weights (n,) with a median of 1, and the distance that is only rounding, m."""

    shape: Shape
    points_m: FloatArray
    weights: FloatArray
    floor_m: float

    def at(self, places: NDArray[np.intp]) -> "_Seen":
        return _Seen(self.shape, self.points_m[places], self.weights[places], self.floor_m)

    @property
    def size_m(self) -> float:
        return float(np.sqrt(np.sum(np.var(self.points_m, axis=0))))

    def distance(self, shape: Shape) -> FloatArray:
        """Weighted, (n,)."""
        return np.asarray(self.weights * shape.distance(self.points_m))


def suspicions(
    fit: SurfaceFit, points_m: FloatArray, kinds: Iterable[type[Shape]], robust: bool
) -> tuple[Flag, ...]:
    """What to look at, for a fit to points (n, 3), m, whose other possible surfaces are `kinds`.

    None of it needs a stated standard deviation, which could be compared with the scatter. Distances below
    the step of the coordinates, or the resolution of single precision, are rounding and say nothing.
    """
    flags = _repeated(points_m, len(fit.shape.FREEDOMS))
    if fit.redundancy <= 0:
        return tuple(flags)
    places = spread(len(points_m), len(points_m) if len(points_m) <= _ALL else _MANY)
    seen = _seen(fit, points_m, places)
    if len(places) < len(points_m) and fit.rms_m > _ODD * _rms(fit.shape.distance(seen.points_m)):
        places = np.arange(len(points_m))
        seen = _seen(fit, points_m, places)
    if fit.rms_m > seen.floor_m:
        if not robust:
            flags += _outliers(seen, _kept(places, fit))
        if not flags:
            flags += _other_surface(
                fit, seen.at(spread(len(seen.points_m), _SAMPLE if len(points_m) <= _ALL else _FEWER)), kinds
            )
    return tuple(flags)


def _kept(places: NDArray[np.intp], fit: SurfaceFit) -> NDArray[np.intp]:
    return np.setdiff1d(places, fit.rejected, assume_unique=True) if len(fit.rejected) else places


def _seen(fit: SurfaceFit, points_m: FloatArray, places: NDArray[np.intp]) -> _Seen:
    places = _kept(places, fit)
    points, given = points_m[places], fit.weights
    weights = np.ones(len(places)) if not len(given) else given[places] / np.median(given[places])
    some = points[spread(len(points), _FEWER)]
    facing = np.sqrt(np.mean(fit.shape.normals(some) ** 2, axis=0))
    steps = [step_of(some[:, axis]) for axis in np.flatnonzero(facing > _FACING * facing.max())]
    return _Seen(fit.shape, points, weights, max(RESOLUTION * float(np.abs(some).max()), min(steps)))


def _repeated(points_m: FloatArray, freedoms: int) -> list[Flag]:
    count = len(points_m)
    if count > _ALL:
        share = repeated_share(points_m, spread(count, _FEWER))
        if share < 0.1:
            return []
        text = (
            f"{share:.0%} of the points that were looked at come again, and each is taken for a measurement"
        )
        return [Flag(Cause.DUPLICATED_POINTS, text, spoils=share > 0.4)]
    different = distinct(points_m)
    if different > 0.9 * count:
        return []
    text = f"Only {different} of {count} points are distinct, and each is taken for a measurement"
    return [Flag(Cause.DUPLICATED_POINTS, text, spoils=different <= max(0.5 * count, freedoms))]


def _outliers(seen: _Seen, places: NDArray[np.intp]) -> list[Flag]:
    """Points far from the others' scatter; `places` are theirs among all points.

    Each residual is compared with the scatter without it (externally studentised, Bonferroni), which one
    outlier cannot hide from. Several hide behind each other there, and pull the surface: they are looked for
    from a surface through the points near the first one, by the median distance. Distances with long tails
    are flagged too, but only gross ones spoil the result.
    """
    rows = seen.shape.rows(seen.points_m) * seen.weights
    residual, count, freedoms = rows[-1], len(seen.points_m), len(rows) - 1
    if count > _PLENTY and (np.abs(residual) <= _PLAIN * (_scale(residual) + seen.floor_m)).all():
        return []  # at once: no single one of so many points has leverage
    leverage = np.einsum("in,in->n", rows[:-1], np.linalg.pinv(rows[:-1] @ rows[:-1].T) @ rows[:-1])
    own = np.maximum(1.0 - leverage, 1e-9)
    dof = count - freedoms - 1
    far = np.zeros(count, dtype=bool)
    if dof > 0:
        without = np.maximum(float(residual @ residual) - residual**2 / own, 0.0) / dof
        limit = stdtrit(dof, 1.0 - _OUTLIER_CHANCE / (2.0 * count))
        far = residual**2 / own > limit**2 * (without + seen.floor_m**2)
    many = count >= _ENOUGH * freedoms
    near = np.abs(residual) <= _NEAR * (_scale(residual) + seen.floor_m) if many else ~far
    if near.all():
        return []
    inner = minimise(seen.shape, seen.points_m[near], seen.weights[near], size_m=seen.size_m, tolerance=1e-6)
    distance = seen.distance(inner.shape)
    scale = _scale(distance) if many else float(np.sqrt(np.sum(distance[near] ** 2) / max(dof, 1)))
    gross = np.abs(distance) > _FAR * (scale + seen.floor_m)
    if np.count_nonzero(gross) > _MOST_OUTLIERS * count and many:
        gross[:] = False
    far |= gross
    if not far.any() or far.all():
        return []
    others, most = _rms(distance[~far]), float(np.abs(distance[far]).max())
    count_far = np.count_nonzero(far)
    who = numbered(places[far])
    what = f"Point {who} lies" if count_far == 1 else f"{count_far} points ({who}) lie up to"
    text = f"{what} {most * 1e3:.3g} mm off, the others {others * 1e3:.3g} mm (rms)"
    remedy = "fit robustly (--robust), or remove what is not this surface"
    return [Flag(Cause.OUTLIERS, f"{text}: {remedy}", spoils=most > _GROSS * (scale + seen.floor_m))]


def _scale(residual: FloatArray) -> float:
    return _SCALE_OF_MEDIAN * float(np.median(np.abs(residual)))


def _rms(residual: FloatArray) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def _other_surface(fit: SurfaceFit, seen: _Seen, kinds: Iterable[type[Shape]]) -> list[Flag]:
    """Distances that are systematic, and the kind of surface that has none of them."""
    correlation = _of_neighbours(seen)
    sure = correlation * np.sqrt(len(seen.points_m))
    off = len(seen.points_m) < _FEW and fit.rms_m > _OFF * seen.size_m
    if sure < _LIKELY and not off:
        return []
    better = _better(seen.at(spread(len(seen.points_m), _MOST_COMPARED)), kinds)
    if better is not None:
        kind, rms_m = better
        text = (
            f"The points lie {fit.rms_m * 1e3:.3g} mm (rms) off this {fit.surface} and {rms_m * 1e3:.3g} mm "
            f"off a {kind}"
        )
        return [Flag(Cause.WRONG_SURFACE, text, spoils=fit.rms_m > _COARSE * seen.size_m)]
    if sure > _SURE and correlation > _SYSTEMATIC:
        text = (
            f"Neighbouring points lie off the {fit.surface} the same way (correlation {correlation:.2f}): "
            "a form error, which more points do not average out as the uncertainty assumes"
        )
        return [Flag(Cause.FORM_ERROR, text)]
    return []


def _of_neighbours(seen: _Seen) -> float:
    """Correlation of the distance of a point with that of the point nearest to it along the surface."""
    across = seen.shape.distance(seen.points_m)[:, None] * seen.shape.normals(seen.points_m)
    foot = seen.points_m - across  # else the noise itself would choose the neighbour
    nearest = np.asarray(cKDTree(foot).query(foot, k=2)[1])[:, 1]
    residual = seen.distance(seen.shape)
    return float(residual @ residual[nearest]) / float(residual @ residual)


def _better(seen: _Seen, kinds: Iterable[type[Shape]]) -> tuple[str, float] | None:
    """The simplest other kind from which the points scatter far less, and its rms (m)."""
    count = len(seen.points_m)
    weights = NO_WEIGHTS if (seen.weights == 1.0).all() else seen.weights
    own = _variance(seen, seen.shape)
    found: list[tuple[float, type[Shape]]] = []
    for kind in kinds:
        dof = count - len(kind.FREEDOMS)
        if kind is type(seen.shape) or dof < _LEAST_DOF:
            continue
        lowest = minima(kind, seen.points_m, weights)
        if not lowest:
            continue
        variance = _variance(seen, lowest[0].shape)
        ratio = own / variance
        if ratio > _BETTER and fdtrc(count - len(seen.shape.FREEDOMS), dof, ratio) < _CHANCE:
            found.append((variance, kind))
    if not found:
        return None
    least = min(variance for variance, _ in found)
    variance, kind = min(
        ((v, k) for v, k in found if v < 2.0 * least), key=lambda pair: len(pair[1].FREEDOMS)
    )
    return kind.KIND, float(np.sqrt(variance))


def _variance(seen: _Seen, shape: Shape) -> float:
    residual = seen.distance(shape)
    return float(residual @ residual) / max(len(residual) - len(shape.FREEDOMS), 1) + seen.floor_m**2
