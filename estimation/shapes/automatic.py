"""Which kind of surface points lie on: all are tried, and a freedom must pay for itself."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.shapes.checks import checked_points
from estimation.shapes.fit import KINDS, SAMPLE, fit_surface, fit_without_second_thoughts
from estimation.shapes.plane import Plane
from estimation.shapes.refusals import Cause, FitRefused
from estimation.shapes.result import SurfaceFit
from estimation.shapes.sampling import spread
from estimation.shapes.suspicions import RESOLUTION
from estimation.transform import FloatArray

_CLEAR: Final = 10.0  # difference of the criterion: odds of about 150 to 1


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The chosen fit, and why: one sentence for the choice, one for each other kind."""

    fit: SurfaceFit
    reason: str
    others: tuple[str, ...]


def fit_any(points_m: FloatArray, sigma_m: float | None = None, robust: bool = False) -> Choice:
    """The surface of least Bayesian information criterion, n log(rms^2) + p log(n).

    Distances below the resolution of single precision tell nothing about the kind: rounding is no noise, and
    a richer surface would follow it.
    Arguments as of `fit_surface`. Raises FitRefused where no kind fits, or where two kinds fit equally well.
    """
    points = checked_points(points_m, Plane, sigma_known=False).points_m
    sample = points[spread(len(points), SAMPLE)]
    count = len(sample)
    floor_m = RESOLUTION * float(np.abs(sample).max())
    tried: list[tuple[float, str, float]] = []
    others: list[str] = []
    for kind, shape in KINDS.items():
        try:
            fit = fit_without_second_thoughts(kind, sample, robust=robust)
        except FitRefused as refusal:
            others.append(f"{kind}: {refusal.problem}")
            continue
        # A small sample needs more than log(n) for each freedom; both agree for many points.
        criterion = count * np.log(fit.rms_m**2 + floor_m**2) + len(shape.FREEDOMS) * np.log(count)
        tried.append((float(criterion), kind, fit.rms_m))
    if not tried:
        raise FitRefused(
            Cause.WRONG_SURFACE,
            f"No kind of surface fits: {'; '.join(others)}",
            "Separate the surfaces in the file, or name one",
        )
    tried.sort()
    best, kind, rms_m = tried[0]
    if len(tried) > 1 and tried[1][0] - best < _CLEAR and tried[1][2] < 1.5 * rms_m:
        simpler = len(KINDS[kind].FREEDOMS) < len(KINDS[tried[1][1]].FREEDOMS)
        if not simpler:
            raise FitRefused(
                Cause.AMBIGUOUS,
                f"The points fit a {kind} (rms {rms_m * 1e3:.4g} mm) and a {tried[1][1]} "
                f"(rms {tried[1][2] * 1e3:.4g} mm) equally well",
                "Name the surface with --surface, or measure a larger piece of it",
            )
    others += [f"{name}: rms {rms * 1e3:.4g} mm, freedoms that do not pay" for _, name, rms in tried[1:]]
    freedoms = len(KINDS[kind].FREEDOMS)
    reason = f"{kind}: rms {rms_m * 1e3:.4g} mm with {freedoms} freedoms, the least that explains the points"
    return Choice(fit_surface(kind, points, sigma_m, robust), reason, tuple(others))
