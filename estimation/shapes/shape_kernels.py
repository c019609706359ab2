"""Compiled passes over points: rows of the Jacobian for a block at a time, and their sums of products.

The formulas are those of `local_rows` of each shape, which a test compares with these to 1e-12. A block stays
in the first cache, so memory does not grow with the number of points.
"""

from typing import Final

import numba
import numpy as np

from estimation.transform import FloatArray

BLOCK: Final = 256
_TINY: Final = np.finfo(np.float64).tiny
PLANE, SPHERE, CYLINDER, CONE, TORUS = range(5)
CODES: Final = {"plane": PLANE, "sphere": SPHERE, "cylinder": CYLINDER, "cone": CONE, "torus": TORUS}

# Sums in any order, so that they use the processor's wide registers; not-a-number is still seen.
_FAST: Final = {"reassoc", "contract", "nsz", "arcp"}


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _plane(q: FloatArray, n: int, sizes: FloatArray, rows: FloatArray) -> None:
    for i in range(n):
        rows[0, i] = -1.0
        rows[1, i] = -q[1, i]
        rows[2, i] = q[0, i]
        rows[3, i] = q[2, i]


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _sphere(q: FloatArray, n: int, sizes: FloatArray, rows: FloatArray) -> None:
    radius = sizes[0]
    for i in range(n):
        u, v, w = q[0, i], q[1, i], q[2, i]
        distance = np.sqrt(u * u + v * v + w * w)
        inverse = 1.0 / max(distance, _TINY)
        rows[0, i] = -u * inverse
        rows[1, i] = -v * inverse
        rows[2, i] = -w * inverse
        rows[3, i] = -1.0
        rows[4, i] = distance - radius


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _cylinder(q: FloatArray, n: int, sizes: FloatArray, rows: FloatArray) -> None:
    radius = sizes[0]
    for i in range(n):
        u, v, w = q[0, i], q[1, i], q[2, i]
        rho = np.sqrt(u * u + v * v)
        inverse = 1.0 / max(rho, _TINY)
        nu, nv = u * inverse, v * inverse
        rows[0, i] = -nu
        rows[1, i] = -nv
        rows[2, i] = w * nv
        rows[3, i] = -w * nu
        rows[4, i] = -1.0
        rows[5, i] = rho - radius


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _cone(q: FloatArray, n: int, sizes: FloatArray, rows: FloatArray) -> None:
    gap, cos, sin = sizes[0], np.cos(sizes[1]), np.sin(sizes[1])
    for i in range(n):
        u, v, w = q[0, i], q[1, i], q[2, i]
        rho = np.sqrt(u * u + v * v)
        inverse = 1.0 / max(rho, _TINY)
        cu, cv = u * inverse, v * inverse
        arm = cos * w + sin * rho
        rows[0, i] = -cos * cu
        rows[1, i] = -cos * cv
        rows[2, i] = cv * arm
        rows[3, i] = -cu * arm
        rows[4, i] = -1.0
        rows[5, i] = -sin * rho - cos * w
        rows[6, i] = cos * rho - sin * w - gap


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _torus(q: FloatArray, n: int, sizes: FloatArray, rows: FloatArray) -> None:
    major, minor = sizes[0], sizes[1]
    for i in range(n):
        u, v, w = q[0, i], q[1, i], q[2, i]
        rho = np.sqrt(u * u + v * v)
        inverse = 1.0 / max(rho, _TINY)
        cu, cv = u * inverse, v * inverse
        out = rho - major
        tube = np.sqrt(out * out + w * w)
        inverse = 1.0 / max(tube, _TINY)
        nr, nw = out * inverse, w * inverse
        arm = w * nr - rho * nw
        rows[0, i] = -nr * cu
        rows[1, i] = -nr * cv
        rows[2, i] = -nw
        rows[3, i] = cv * arm
        rows[4, i] = -cu * arm
        rows[5, i] = -nr
        rows[6, i] = -1.0
        rows[7, i] = tube - minor


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def products(
    code: int,
    points: FloatArray,
    weights: FloatArray,
    origin: FloatArray,
    axes: FloatArray,
    sizes: FloatArray,
    size: int,
) -> FloatArray:
    """Sums over points (n, 3) of w^2 r r^T, r being the (size,) derivatives and the distance.

    `weights` (n,) are the w, or (0,) for ones.
    """
    total = np.zeros((size, size))
    q = np.empty((3, BLOCK))
    rows = np.empty((size, BLOCK))
    a00, a01, a02 = axes[0, 0], axes[0, 1], axes[0, 2]
    a10, a11, a12 = axes[1, 0], axes[1, 1], axes[1, 2]
    a20, a21, a22 = axes[2, 0], axes[2, 1], axes[2, 2]
    ox, oy, oz = origin[0], origin[1], origin[2]
    for start in range(0, len(points), BLOCK):
        n = min(BLOCK, len(points) - start)
        for i in range(n):
            x = points[start + i, 0] - ox
            y = points[start + i, 1] - oy
            z = points[start + i, 2] - oz
            q[0, i] = x * a00 + y * a10 + z * a20
            q[1, i] = x * a01 + y * a11 + z * a21
            q[2, i] = x * a02 + y * a12 + z * a22
        if code == PLANE:
            _plane(q, n, sizes, rows)
        elif code == SPHERE:
            _sphere(q, n, sizes, rows)
        elif code == CYLINDER:
            _cylinder(q, n, sizes, rows)
        elif code == CONE:
            _cone(q, n, sizes, rows)
        else:
            _torus(q, n, sizes, rows)
        if len(weights) > 0:
            for j in range(size):
                for i in range(n):
                    rows[j, i] *= weights[start + i]
        for j in range(size):
            for k in range(j + 1):
                sum_ = 0.0
                for i in range(n):
                    sum_ += rows[j, i] * rows[k, i]
                total[j, k] += sum_
    for j in range(size):
        for k in range(j):
            total[k, j] = total[j, k]
    return total


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def moments(points: FloatArray, centre: FloatArray) -> FloatArray:
    """(4, 4) sums over points (n, 3) of p p^T, p being (x, y, z, 1) from `centre`."""
    total = np.zeros((4, 4))
    q = np.empty((4, BLOCK))
    for start in range(0, len(points), BLOCK):
        n = min(BLOCK, len(points) - start)
        for i in range(n):
            q[0, i] = points[start + i, 0] - centre[0]
            q[1, i] = points[start + i, 1] - centre[1]
            q[2, i] = points[start + i, 2] - centre[2]
            q[3, i] = 1.0
        for j in range(4):
            for k in range(j + 1):
                sum_ = 0.0
                for i in range(n):
                    sum_ += q[j, i] * q[k, i]
                total[j, k] += sum_
    for j in range(4):
        for k in range(j):
            total[k, j] = total[j, k]
    return total
