"""A bicubic patch through a grid of measured points, with the covariance of its control points."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from estimation.errors import EstimationError
from estimation.surfaces.bspline import BSplinePatch
from estimation.surfaces.bspline_cells import DEGREE
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FittedPatch:
    """A patch through a grid of measured points.

    `covariance_m2` (n k, n k) is of the control points, row by row, alike for x, y and z and independent
    between them: it is what `freeform` takes, three times.
    """

    patch: BSplinePatch
    covariance_m2: FloatArray


def fit_patch(grid_p: FloatArray, std_m: float) -> FittedPatch:
    """The bicubic patch through a grid of points (n, k, 3), knots by the mean length between the points.

    std_m : of each coordinate of each point, independent.

    Raises EstimationError for a grid of less than 4 by 4 points, or with points that coincide.

    Source: Sallinen (2003), section on free-form surfaces; interpolation with not-a-knot ends.
    """
    grid = np.asarray(grid_p, dtype=np.float64)
    if grid.ndim != 3 or grid.shape[2] != 3 or min(grid.shape[:2]) < DEGREE + 1:
        raise EstimationError(f"Patch from a grid {grid.shape}", "Measure at least 4 by 4 points, (n, k, 3)")
    knots, inverse = [], []
    for axis in (0, 1):
        steps = np.linalg.norm(np.diff(grid, axis=axis), axis=2).mean(axis=1 - axis)
        if not (steps > 0.0).all() or not np.isfinite(steps).all():
            raise EstimationError("Rows of the grid coincide, or a point is not finite", "Measure them apart")
        place = np.append(0.0, np.cumsum(steps)) / steps.sum()
        spline = make_interp_spline(place, np.eye(len(place)), k=DEGREE)
        knots.append(spline.t)
        inverse.append(spline.c)  # control points from points
    control = np.einsum("ia,jb,abk->ijk", inverse[0], inverse[1], grid, optimize=True)
    both = np.kron(inverse[0], inverse[1])
    return FittedPatch(BSplinePatch(knots[0], knots[1], control), std_m**2 * both @ both.T)
