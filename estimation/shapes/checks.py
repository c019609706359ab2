"""What points must fulfil before and after a fit, and one sentence for each way in which they do not."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimation.numbered import numbered
from estimation.shapes.passes import moments
from estimation.shapes.refusals import Cause, FitRefused, Flag
from estimation.shapes.result import SurfaceFit
from estimation.shapes.sampling import distinct
from estimation.shapes.shape import Shape
from estimation.transform import FloatArray

_LINE: Final = 1e-6  # second over first standard deviation of points on one line
_FLAT: Final = 1e-7  # third over first, of points in one plane
_SINGULAR: Final = 1e-14  # least eigenvalue of the scaled information that rounding leaves meaningful
_LARGEST_TILT_RAD: Final = 0.1  # standard deviations beyond these: the linear covariance means nothing
_LARGEST_SHARE: Final = 0.2  # of a radius
_LARGEST_RMS: Final = 0.05  # of the size: no measurement of this surface is so rough
_FEW: Final = 10_000  # points up to which duplicates are counted
_UNLIKELY: Final = 1e-3
_AMBIGUOUS_RATIO: Final = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points (n, 3) that may be fitted, their centroid, and their root-mean-square distance from it."""

    points_m: FloatArray
    centroid_m: FloatArray
    size_m: float


def checked_points(points_m: FloatArray, kind: type[Shape], sigma_known: bool) -> Points:
    """The points as float64.

    Raises FitRefused: wrong shape, not finite, too few, duplicated, on a line, or flat.
    """
    points = np.ascontiguousarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise FitRefused(
            Cause.WRONG_SHAPE,
            f"Points come as an array {points.shape}",
            "Give one row of x, y, z for each point",
        )
    needed = len(kind.FREEDOMS) + (0 if sigma_known else 1)
    if len(points) < needed:
        raise FitRefused(
            Cause.TOO_FEW_POINTS if len(points) < len(kind.FREEDOMS) else Cause.NO_REDUNDANCY,
            f"A {kind.KIND} with its uncertainty needs {needed} points, there are {len(points)}",
            "Measure more" if sigma_known else "Measure more, or state their standard deviation",
        )
    sums = moments(points, points[0])  # one pass for all that follows: finite, centroid, spread
    if not np.isfinite(sums).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise FitRefused(
            Cause.NOT_FINITE,
            f"Point {row + 1} is {points[row].tolist()}, not three numbers",
            "Remove or mend it",
        )
    if len(points) <= _FEW and (different := distinct(points)) < needed:
        raise FitRefused(
            Cause.DUPLICATED_POINTS,
            f"Only {different} of {len(points)} points are distinct, a {kind.KIND} needs {needed}",
            "Measure at different places",
        )
    mean = sums[:3, 3] / len(points)
    centre = points[0] + mean
    variances = np.linalg.eigvalsh(sums[:3, :3] / len(points) - np.outer(mean, mean))
    spread = np.sqrt(np.maximum(variances, 0.0))
    # A sum of squares has lost half of the digits: what is small is measured again along its own direction.
    if spread[0] < 1e-5 * spread[2]:
        spread = np.linalg.svd(points - centre, compute_uv=False)[::-1] / np.sqrt(len(points))
    if spread[1] <= _LINE * spread[2]:
        raise FitRefused(
            Cause.POINTS_ON_A_LINE, "All points lie on one line", f"Spread them over the {kind.KIND}"
        )
    if kind.KIND != "plane" and spread[0] <= _FLAT * spread[2]:
        raise FitRefused(
            Cause.NEARLY_FLAT,
            f"All points lie in one plane, which leaves a {kind.KIND} open",
            "Measure at other heights too, or fit a plane",
        )
    return Points(points, centre, float(np.linalg.norm(spread)))


def checked_sigma(sigma_m: float | FloatArray | None, count: int) -> FloatArray | None:
    """Standard deviations () or (n,). Raises FitRefused for others than positive numbers."""
    if sigma_m is None:
        return None
    sigma = np.asarray(sigma_m, dtype=np.float64)
    if sigma.shape not in ((), (count,)):
        raise FitRefused(
            Cause.BAD_SIGMA,
            f"{sigma.shape} standard deviations for {count} points",
            "Give one, or one per point",
        )
    if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        raise FitRefused(
            Cause.BAD_SIGMA,
            "A standard deviation of the points is not a positive number",
            "State it in metres",
        )
    return sigma


def refuse_undetermined(shape: Shape, information: FloatArray, sigma_m: float | None, size_m: float) -> None:
    """Raises FitRefused where a freedom is open, or so uncertain that its linear covariance means nothing."""
    scale = np.sqrt(np.diag(information))
    names = list(shape.FREEDOMS)
    if (scale <= 0.0).any() or not np.isfinite(information).all():
        raise _undetermined(shape, [names[int(np.argmin(scale))]])
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] <= _SINGULAR:
        part = np.abs(vectors[:, 0])
        raise _undetermined(shape, [names[i] for i in np.flatnonzero(part > 0.3 * part.max())])
    deviations = (sigma_m or 0.0) * np.sqrt(np.diag(np.linalg.inv(information)))
    places = len(names) - len(shape.sizes)
    limits = np.array([_LARGEST_TILT_RAD if shape.is_angle(name) else np.inf for name in names])
    for place, value in enumerate(shape.sizes, start=places):
        if names[place].endswith("radius"):
            limits[place] = _LARGEST_SHARE * abs(value)
    if (over := np.flatnonzero(deviations > limits)).size:
        raise _undetermined(shape, [names[i] for i in over])
    _refuse_simpler(shape, max(3.0 * deviations[-1], 1e-7), 1e4 * size_m)


def _refuse_simpler(shape: Shape, margin_rad: float, largest_m: float) -> None:
    """Raises FitRefused for a cone within `margin_rad` of cylinder or plane, or radii above `largest_m`."""
    names = shape.FREEDOMS[len(shape.FREEDOMS) - len(shape.sizes) :]
    if any(
        not shape.is_angle(n) and abs(size) > largest_m for n, size in zip(names, shape.sizes, strict=True)
    ):
        raise FitRefused(
            Cause.SIMPLER_SURFACE, f"The {shape.KIND} is as good as flat where the points are", "Fit a plane"
        )
    if shape.KIND != "cone":
        return
    angle = float(shape.sizes[1])
    for limit_rad, words, simpler in ((0.0, "zero", "cylinder"), (np.pi / 2.0, "90 deg", "plane")):
        if abs(angle - limit_rad) < margin_rad:
            raise FitRefused(
                Cause.SIMPLER_SURFACE,
                f"The half angle of the cone, {np.degrees(angle):.4f} deg, cannot be told from {words}",
                f"Fit a {simpler}",
            )


def _undetermined(shape: Shape, names: list[str]) -> FitRefused:
    words = [shape.WORDS[name] for name in names]
    return FitRefused(
        Cause.UNDETERMINED,
        f"The points do not determine {' and '.join(words)} of the {shape.KIND}",
        "Measure a larger piece of the surface, or fit a simpler one",
    )


def refuse_other_surface(shape: Shape, rms_m: float, size_m: float) -> None:
    """Raises FitRefused where the points are far from the surface for their extent."""
    if rms_m > _LARGEST_RMS * size_m:
        raise FitRefused(
            Cause.WRONG_SURFACE,
            f"The points lie {rms_m * 1e3:.3g} mm (rms) off the best {shape.KIND}, over 5 % of their size",
            "Name another surface, or separate the surfaces in the file",
        )


def flags_of(fit: SurfaceFit) -> SurfaceFit:
    """The fit with what the user should look at."""
    flags = []
    if fit.p_value is not None and fit.p_value < _UNLIKELY and fit.variance_factor is not None:
        ratio = float(np.sqrt(fit.variance_factor))
        flags.append(
            Flag(
                Cause.SCATTER_NOT_AS_STATED,
                f"The points scatter {ratio:.3g} times as far as stated: "
                "sigma, its unit, or the surface is wrong",
                spoils=ratio > 1.0,
            )
        )
    if fit.alternative_ratio < _AMBIGUOUS_RATIO:
        flags.append(
            Flag(
                Cause.AMBIGUOUS,
                f"Another {fit.surface} has only {fit.alternative_ratio:.3g} times the squared distances: "
                "measure a larger piece to tell them apart",
            )
        )
    if len(fit.rejected):
        farthest_mm = float(np.abs(fit.residuals()[fit.rejected]).max()) * 1e3
        count = "" if len(fit.rejected) == 1 else f"{len(fit.rejected)} points, "
        text = f"Left out as outliers: {count}number {numbered(fit.rejected)}, up to {farthest_mm:.3g} mm off"
        flags.append(Flag(Cause.OUTLIERS, text))
    if any(quantity.expanded is None for quantity in fit.quantities.values()):
        text = (
            f"{fit.redundancy} degrees of freedom are too few for a 95 % region of every parameter: "
            "state sigma, or measure more"
        )
        flags.append(Flag(Cause.NO_REDUNDANCY, text))
    elif fit.redundancy == 0:
        flags.append(Flag(Cause.NO_REDUNDANCY, "No point is left over to check the stated sigma with"))
    return replace(fit, flags=tuple(flags))
