"""One pass over all points: sums of products of Jacobian rows, compiled where numba is installed."""

from typing import Final

import numpy as np

from estimation.shapes.shape import Shape
from estimation.transform import FloatArray

try:
    from estimation.shapes import shape_kernels as kernels
except ImportError:  # numba is optional: numpy gives the same numbers, in a few times the time
    kernels = None  # type: ignore[assignment]

COMPILED = kernels is not None
_BLOCK: Final = 8192  # points at a time, so that memory does not grow with their number
NO_WEIGHTS: Final = np.empty(0)


def products(shape: Shape, points_m: FloatArray, weights: FloatArray = NO_WEIGHTS) -> FloatArray:
    """Sums (p + 1, p + 1) over points (n, 3) of w^2 r r^T, r being the rows of `Shape.rows`.

    `weights` (n,) are the w; none means ones.
    """
    size = len(shape.FREEDOMS) + 1
    if COMPILED:
        code = kernels.CODES[shape.KIND]
        return kernels.products(
            code, points_m, weights, shape.origin_m, np.ascontiguousarray(shape.axes), shape.sizes, size
        )
    total = np.zeros((size, size))
    for start in range(0, len(points_m), _BLOCK):
        rows = shape.rows(points_m[start : start + _BLOCK])
        if len(weights):
            rows *= weights[start : start + _BLOCK]
        total += rows @ rows.T
    return total


def moments(points_m: FloatArray, centre_m: FloatArray) -> FloatArray:
    """Sums (4, 4) over points (n, 3) of p p^T, p being (x, y, z, 1) from the centre."""
    if COMPILED:
        return kernels.moments(points_m, centre_m)
    total = np.zeros((4, 4))
    for start in range(0, len(points_m), _BLOCK):
        block = points_m[start : start + _BLOCK] - centre_m
        rows = np.vstack([block.T, np.ones(len(block))])
        total += rows @ rows.T
    return total
