"""Compiled parts of the grid over a mesh: which triangles reach into which cell, what is clear above them."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

IntArray = NDArray[np.int32]


@numba.njit(cache=True, inline="always")
def cell_of(value: float, origin: float, per_m: float, count: int) -> int:
    return min(max(math.floor((value - origin) * per_m), 0), count - 1)


@numba.njit(cache=True)
def fill_cells(
    corners: FloatArray,
    planes: FloatArray,
    origin: FloatArray,
    size_m: float,
    counts: NDArray[np.int64],
    start: IntArray,
    members: IntArray,
) -> None:
    """Counts the triangles of each cell into `start` (when `members` is empty), or lists them.

    For the list, `start` holds where each cell ends when it is called, and where it begins afterwards.
    """
    per_m, half = 1.0 / size_m, 0.5 * size_m
    for f in range(len(corners)):
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for k in range(3):
            a, b, c = corners[f, 0, k], corners[f, 1, k], corners[f, 2, k]
            low[k] = cell_of(min(a, b, c), origin[k], per_m, counts[k])
            high[k] = cell_of(max(a, b, c), origin[k], per_m, counts[k])
        reach = half * (abs(planes[f, 0]) + abs(planes[f, 1]) + abs(planes[f, 2])) * (1.0 + 1e-6)
        height = (
            planes[f, 0] * corners[f, 0, 0]
            + planes[f, 1] * corners[f, 0, 1]
            + planes[f, 2] * corners[f, 0, 2]
        )
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    middle = (
                        planes[f, 0] * (origin[0] + i * size_m + half)
                        + planes[f, 1] * (origin[1] + j * size_m + half)
                        + planes[f, 2] * (origin[2] + k * size_m + half)
                    )
                    if abs(middle - height) <= reach:
                        cell = (i * counts[1] + j) * counts[2] + k
                        if len(members) == 0:
                            start[cell] += 1
                        else:
                            start[cell] -= 1
                            members[start[cell]] = f


@numba.njit(cache=True, error_model="numpy")
def clearance(
    origin: FloatArray,
    size_m: float,
    counts: NDArray[np.int64],
    start: IntArray,
    members: IntArray,
    corners: FloatArray,
    planes: FloatArray,
) -> FloatArray:
    """(f,) half the height up to which no other triangle is in the prism over either side of a triangle.

    Heights are looked at up to half a cell. A point whose ball, up to its foot inside the triangle, stays in
    the prism has its nearest triangle there.
    """
    per_m, height = 1.0 / size_m, 0.5 * size_m
    clear = np.empty(len(corners))
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for f in range(len(corners)):
        for k in range(3):
            a, b, c = corners[f, 0, k], corners[f, 1, k], corners[f, 2, k]
            reach = height * abs(planes[f, k])
            low[k] = cell_of(min(a, b, c) - reach, origin[k], per_m, counts[k])
            high[k] = cell_of(max(a, b, c) + reach, origin[k], per_m, counts[k])
        free = height
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                first = (i * counts[1] + j) * counts[2]
                for m in range(start[first + low[2]], start[first + high[2] + 1]):
                    if members[m] != f:
                        free = min(free, _intrusion(f, members[m], corners, planes))
        clear[f] = 0.5 * free
    return clear


@numba.njit(cache=True, error_model="numpy")
def _intrusion(f: int, g: int, corners: FloatArray, planes: FloatArray) -> float:
    """A height over triangle f, either way, below which triangle g is not in the prism over f."""
    for k in range(1, 4):
        outside = True
        for c in range(3):
            x, y, z = corners[g, c, 0], corners[g, c, 1], corners[g, c, 2]
            aside = planes[f, 4 * k] * x + planes[f, 4 * k + 1] * y + planes[f, 4 * k + 2] * z
            outside &= aside - planes[f, 4 * k + 3] <= 1e-12  # metres: shared corners are on the side
        if outside:
            return np.inf
    nx, ny, nz = planes[f, 0], planes[f, 1], planes[f, 2]
    for k in range(3):  # lines along the sides of g, seen along the prism
        n = k + 1 if k < 2 else 0
        last = n + 1 if n < 2 else 0
        ax, ay, az = corners[g, k, 0], corners[g, k, 1], corners[g, k, 2]
        ux, uy, uz = corners[g, n, 0] - ax, corners[g, n, 1] - ay, corners[g, n, 2] - az
        mx, my, mz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        slack = 1e-12 * math.sqrt(mx * mx + my * my + mz * mz)
        own = (corners[g, last, 0] - ax) * mx + (corners[g, last, 1] - ay) * my
        own += (corners[g, last, 2] - az) * mz
        side = 1.0 if own >= 0.0 else -1.0
        apart = True
        for c in range(3):
            aside = (corners[f, c, 0] - ax) * mx + (corners[f, c, 1] - ay) * my
            apart &= side * (aside + (corners[f, c, 2] - az) * mz) <= slack
        if apart:
            return np.inf
    least, most = np.inf, -np.inf
    for c in range(3):
        x, y, z = corners[g, c, 0], corners[g, c, 1], corners[g, c, 2]
        height = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3]
        least, most = min(least, height), max(most, height)
    return max(least, -most, 0.0)


@numba.njit(cache=True, error_model="numpy")
def cell_order(
    base_p: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    origin: FloatArray,
    size_m: float,
    counts: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Order (m,) of points by the cell in which they lie, by counting; `counts` as for the grid."""
    per_m = 1.0 / size_m
    keys = np.empty(len(base_p), np.int32)
    ends = np.zeros(counts[0] * counts[1] * counts[2] + 1, np.int64)
    for i in range(len(base_p)):
        a, b, c = base_p[i, 0] - shift[0], base_p[i, 1] - shift[1], base_p[i, 2] - shift[2]
        x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
        y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
        z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
        cell = cell_of(x, origin[0], per_m, counts[0])
        cell = cell * counts[1] + cell_of(y, origin[1], per_m, counts[1])
        keys[i] = cell * counts[2] + cell_of(z, origin[2], per_m, counts[2])
        ends[keys[i] + 1] += 1
    for cell in range(len(ends) - 1):
        ends[cell + 1] += ends[cell]
    order = np.empty(len(base_p), np.int64)
    for i in range(len(base_p)):
        order[ends[keys[i]]] = i
        ends[keys[i]] += 1
    return order
