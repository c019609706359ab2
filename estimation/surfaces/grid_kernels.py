"""Compiled parts of the grid over a mesh: which triangles reach into which cell, what is clear above them."""

import math
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

IntArray = NDArray[np.int32]
SLACK: Final = 0.01  # cells


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
    across: IntArray,
) -> FloatArray:
    """(f, 4) half the heights up to which a triangle is alone, then with the one across each of its sides.

    Alone: no other triangle is in the prism over either side of it. Alone with one across: no third triangle
    is between the other two sides of either, but for `SLACK`, and so near to the first. Heights are looked at
    up to half a cell. A point whose ball, down to its foot, stays between those sides has its nearest
    triangle there.
    """
    per_m, height = 1.0 / size_m, 0.5 * size_m
    clear = np.zeros((len(corners), 4))
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    side = np.empty(3, np.int64)  # of the triangle across, where the two meet
    seen = np.full(len(corners), -1, np.int32)  # by which triangle each was looked at last
    for f in range(len(corners)):
        for k in range(3):
            a, b, c = corners[f, 0, k], corners[f, 1, k], corners[f, 2, k]
            low[k] = cell_of(min(a, b, c) - height, origin[k], per_m, counts[k])
            high[k] = cell_of(max(a, b, c) + height, origin[k], per_m, counts[k])
            side[k] = -1
            for j in range(3):
                if across[f, k] >= 0 and across[across[f, k], j] == f:
                    side[k] = j if side[k] == -1 else -2  # of one listed twice: nothing is proven there
            clear[f, k + 1] = 0.5 * height if side[k] >= 0 else 0.0
        clear[f, 0] = 0.5 * height
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                first = (i * counts[1] + j) * counts[2]
                for m in range(start[first + low[2]], start[first + high[2] + 1]):
                    g = members[m]
                    if g == f or seen[g] == f:
                        continue
                    seen[g] = f
                    clear[f, 0] = min(clear[f, 0], 0.5 * _intrusion(f, g, corners, planes))
                    for k in range(3):
                        if side[k] >= 0 and g != across[f, k]:
                            between = _between(
                                f, k, across[f, k], side[k], g, SLACK * size_m, corners, planes
                            )
                            clear[f, k + 1] = min(clear[f, k + 1], 0.5 * between)
    return clear


@numba.njit(cache=True, error_model="numpy")
def _between(
    f: int, k: int, g: int, n: int, t: int, slack_m: float, corners: FloatArray, planes: FloatArray
) -> float:
    """A distance from triangle f below which t is not between the sides of f and g but for k of f, n of g.

    By `slack_m` it may reach in: where sides of several triangles lie on one line, surfaces that bend do.
    """
    for side in range(3):
        if side != k and _highest(f, side + 1, t, corners, planes) <= slack_m:
            return np.inf
        if side != n and _highest(g, side + 1, t, corners, planes) <= slack_m:
            return np.inf
    beyond = -_highest(f, k + 1, t, corners, planes)
    return max(_off(f, t, corners, planes), beyond)


@numba.njit(cache=True, error_model="numpy")
def _highest(f: int, plane: int, t: int, corners: FloatArray, planes: FloatArray) -> float:
    """The largest height of the corners of t over one of the planes of f."""
    most = -np.inf
    for c in range(3):
        height = planes[f, 4 * plane] * corners[t, c, 0] + planes[f, 4 * plane + 1] * corners[t, c, 1]
        most = max(most, height + planes[f, 4 * plane + 2] * corners[t, c, 2] - planes[f, 4 * plane + 3])
    return most


@numba.njit(cache=True, error_model="numpy")
def _off(f: int, t: int, corners: FloatArray, planes: FloatArray) -> float:
    """How far t is off the plane of f, on either side of it; 0 where it crosses."""
    least, most = np.inf, -np.inf
    for c in range(3):
        x, y, z = corners[t, c, 0], corners[t, c, 1], corners[t, c, 2]
        height = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3]
        least, most = min(least, height), max(most, height)
    return max(least, -most, 0.0)


@numba.njit(cache=True, error_model="numpy")
def _intrusion(f: int, g: int, corners: FloatArray, planes: FloatArray) -> float:
    """A height over triangle f, either way, below which triangle g is not in the prism over f."""
    for k in range(1, 4):
        if _highest(f, k, g, corners, planes) <= 1e-12:  # metres: shared corners are on the side
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
    return _off(f, g, corners, planes)


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
