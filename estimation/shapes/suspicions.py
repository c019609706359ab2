"""What the distances of a finished fit give away: another surface, points far off, points told twice."""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc, stdtrit

from estimation.shapes.optimum import minima, minimise
from estimation.shapes.refusals import Cause, Flag
from estimation.shapes.result import SurfaceFit
from estimation.shapes.shape import Shape
from estimation.transform import FloatArray

RESOLUTION: Final = 1.2e-7  # of the largest coordinate: meshes and clouds are stored in single precision
_ALL: Final = 100_000  # of more points one far off has no weight, and many show in a sample
_SAMPLE: Final = 5_000
_MOST_COMPARED: Final = 300  # points through which other kinds are laid
_FEW: Final = 60  # of which neighbours tell little: other kinds are tried if the points lie off at all
_OFF: Final = 0.001  # rms over size
_LEAST_DOF: Final = 3  # of another kind: nearly any points lie on a surface with as many freedoms
_LIKELY: Final = 3.0  # standard deviations of the correlation of neighbours that make other kinds worth a try
_SURE: Final = 5.0
_SYSTEMATIC: Final = 0.5  # correlation of neighbours: as much is common as is each point's own
_BETTER: Final = 9.0  # times less variance of the distances
_CHANCE: Final = 1e-6
_COARSE: Final = 0.005  # rms over size: a form error is smaller, another surface is not
_NEAR: Final = 2.5  # times the scale
_FAR: Final = 10.0  # times the scale of the others
_ENOUGH: Final = 10  # points a freedom from which the median distance is a scale
_OUTLIER_CHANCE: Final = 1e-4  # over all points together
_NAMED: Final = 5  # points by their number
_SCALE_OF_MEDIAN: Final = 1.4826


def suspicions(
    fit: SurfaceFit, points_m: FloatArray, kinds: Iterable[type[Shape]], robust: bool
) -> tuple[Flag, ...]:
    """What to look at, for a fit to points (n, 3), m, whose other possible surfaces are `kinds`.

    None of it needs a stated standard deviation, which could be compared with the scatter. Distances below
    the resolution of single precision are rounding and say nothing.
    """
    places = np.arange(0, len(points_m), 1 if len(points_m) <= _ALL else -(-len(points_m) // _SAMPLE))
    places = np.setdiff1d(places, fit.rejected, assume_unique=True)
    points = points_m[places]
    sample = points[:: -(-len(points) // _SAMPLE)]
    floor_m = RESOLUTION * float(np.abs(sample).max())
    flags = _repeated(sample, len(fit.shape.FREEDOMS))
    if fit.rms_m > floor_m and fit.redundancy > 0:
        if not robust:
            flags += _outliers(fit, points, places, floor_m)
        if not flags:
            flags += _other_surface(fit, sample, kinds, floor_m)
    return tuple(flags)


def _repeated(points_m: FloatArray, freedoms: int) -> list[Flag]:
    distinct = len(np.unique(points_m, axis=0))
    if distinct > 0.9 * len(points_m):
        return []
    text = f"Only {distinct} of {len(points_m)} points are distinct, and each is taken for a measurement"
    return [Flag(Cause.DUPLICATED_POINTS, text, spoils=distinct <= max(0.5 * len(points_m), freedoms))]


def _outliers(fit: SurfaceFit, points_m: FloatArray, places: NDArray[np.intp], floor_m: float) -> list[Flag]:
    """Points far from the others' scatter; `places` are theirs among all points.

    Each residual is compared with the scatter without it (externally studentised, Bonferroni), which one
    outlier cannot hide from. Several hide behind each other there, and pull the surface: they are looked for
    from a surface through the points near the first one, by the median distance.
    """
    rows = fit.shape.rows(points_m)
    residual, count, freedoms = rows[-1], len(points_m), len(rows) - 1
    # The information of a weighted fit has other units; that of the looked-at points is as good for leverage.
    leverage = np.einsum("in,in->n", rows[:-1], np.linalg.pinv(rows[:-1] @ rows[:-1].T) @ rows[:-1])
    own = np.maximum(1.0 - leverage, 1e-9)
    dof = count - freedoms - 1
    far = np.zeros(count, dtype=bool)
    if dof > 0:
        without = np.maximum(float(residual @ residual) - residual**2 / own, 0.0) / dof
        limit = stdtrit(dof, 1.0 - _OUTLIER_CHANCE / (2.0 * count))
        far |= residual**2 / own > limit**2 * (without + floor_m**2)
    if count >= _ENOUGH * freedoms and not far.any():
        near = np.abs(residual) <= _NEAR * _scale(residual)
        inner = minimise(fit.shape, points_m[near], size_m=_size(points_m), tolerance=1e-6)
        distance = inner.shape.distance(points_m)
        beyond = np.abs(distance) > _FAR * (_scale(distance) + floor_m)
        if beyond.any():
            far, residual = beyond, distance
    if not far.any():
        return []
    others = float(np.sqrt(np.mean(residual[~far] ** 2))) if not far.all() else 0.0
    numbers = [str(place + 1) for place in places[far]]
    more = ", .." if len(numbers) > _NAMED else ""
    what = (
        f"Point {numbers[0]} lies"
        if len(numbers) == 1
        else f"{len(numbers)} points ({', '.join(numbers[:_NAMED])}{more}) lie up to"
    )
    text = f"{what} {np.abs(residual[far]).max() * 1e3:.3g} mm off, the others {others * 1e3:.3g} mm (rms)"
    remedy = "fit robustly (--robust), or remove what is not this surface"
    return [Flag(Cause.OUTLIERS, f"{text}: {remedy}", spoils=True)]


def _scale(residual: FloatArray) -> float:
    return _SCALE_OF_MEDIAN * float(np.median(np.abs(residual)))


def _other_surface(
    fit: SurfaceFit, points_m: FloatArray, kinds: Iterable[type[Shape]], floor_m: float
) -> list[Flag]:
    """Distances that are systematic, and the kind of surface that has none of them."""
    residual = fit.shape.distance(points_m)
    correlation = _of_neighbours(points_m, residual)
    sure = correlation * np.sqrt(len(points_m))
    off = len(points_m) < _FEW and fit.rms_m > _OFF * _size(points_m)
    if sure < _LIKELY and not off:
        return []
    better = _better(fit, points_m, kinds, floor_m)
    if better is not None:
        kind, rms_m = better
        coarse = fit.rms_m > _COARSE * _size(points_m)
        text = (
            f"The points lie {fit.rms_m * 1e3:.3g} mm (rms) off this {fit.surface} and {rms_m * 1e3:.3g} mm "
            f"off a {kind}"
        )
        return [Flag(Cause.WRONG_SURFACE, text, spoils=coarse)]
    if sure > _SURE and correlation > _SYSTEMATIC:
        text = (
            f"Neighbouring points lie off the {fit.surface} the same way (correlation {correlation:.2f}): "
            "a form error, which more points do not average out as the uncertainty assumes"
        )
        return [Flag(Cause.FORM_ERROR, text)]
    return []


def _of_neighbours(points_m: FloatArray, residual: FloatArray) -> float:
    """Correlation of the distance of a point with that of the point nearest to it; 0 without scatter."""
    nearest = np.asarray(cKDTree(points_m).query(points_m, k=2)[1])[:, 1]
    square = float(residual @ residual)
    return float(residual @ residual[nearest]) / square if square > 0.0 else 0.0


def _better(
    fit: SurfaceFit, points_m: FloatArray, kinds: Iterable[type[Shape]], floor_m: float
) -> tuple[str, float] | None:
    """The simplest other kind from which the points scatter far less, and its rms (m)."""
    sample = points_m[:: -(-len(points_m) // _MOST_COMPARED)]
    count = len(sample)
    own = _variance(fit.shape.distance(sample), len(fit.shape.FREEDOMS), floor_m)
    found: list[tuple[float, type[Shape]]] = []
    for kind in kinds:
        dof = count - len(kind.FREEDOMS)
        if kind is type(fit.shape) or dof < _LEAST_DOF:
            continue
        lowest = minima(kind, sample)
        if not lowest:
            continue
        variance = _variance(lowest[0].shape.distance(sample), len(kind.FREEDOMS), floor_m)
        ratio = own / variance
        if ratio > _BETTER and fdtrc(count - len(fit.shape.FREEDOMS), dof, ratio) < _CHANCE:
            found.append((variance, kind))
    if not found:
        return None
    least = min(variance for variance, _ in found)
    variance, kind = min(
        ((v, k) for v, k in found if v < 2.0 * least), key=lambda pair: len(pair[1].FREEDOMS)
    )
    return kind.KIND, float(np.sqrt(variance))


def _variance(residual: FloatArray, freedoms: int, floor_m: float) -> float:
    return float(residual @ residual) / max(len(residual) - freedoms, 1) + floor_m**2


def _size(points_m: FloatArray) -> float:
    return float(np.sqrt(np.sum(np.var(points_m, axis=0))))
