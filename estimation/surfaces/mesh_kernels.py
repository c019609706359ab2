"""Compiled search for the nearest triangle of a mesh, exact at any distance, and sums over all points.

Triangles are listed in the cells of a regular grid. The first occupied shell of cells around a point gives an
upper bound; the cells that a ball of that radius meets hold the nearest triangle. Points that come sorted by
cell find the data of their neighbours still in the cache.
"""

import math
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.surfaces.shape import CHUNK, SUMS
from estimation.surfaces.sums_kernels import add_point
from estimation.transform import FloatArray

IntArray = NDArray[np.int32]
INSIDE: Final = 0  # regions of a foot: 0 inside, 1-3 on the side from corner k - 1, 4-6 at corner k - 4


@numba.njit(cache=True, inline="always")
def _cell(value: float, origin: float, per_m: float, count: int) -> int:
    return min(max(math.floor((value - origin) * per_m), 0), count - 1)


@numba.njit(cache=True)
def fill_cells(
    corners: FloatArray,
    normal: FloatArray,
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
            low[k] = _cell(min(a, b, c), origin[k], per_m, counts[k])
            high[k] = _cell(max(a, b, c), origin[k], per_m, counts[k])
        reach = half * (abs(normal[f, 0]) + abs(normal[f, 1]) + abs(normal[f, 2])) * (1.0 + 1e-6)
        height = (
            normal[f, 0] * corners[f, 0, 0]
            + normal[f, 1] * corners[f, 0, 1]
            + normal[f, 2] * corners[f, 0, 2]
        )
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    middle = (
                        normal[f, 0] * (origin[0] + i * size_m + half)
                        + normal[f, 1] * (origin[1] + j * size_m + half)
                        + normal[f, 2] * (origin[2] + k * size_m + half)
                    )
                    if abs(middle - height) <= reach:
                        cell = (i * counts[1] + j) * counts[2] + k
                        if len(members) == 0:
                            start[cell] += 1
                        else:
                            start[cell] -= 1
                            members[start[cell]] = f


@numba.njit(cache=True, error_model="numpy")
def _try(
    x: float, y: float, z: float, f: int, best: float, corners: FloatArray, planes: FloatArray
) -> tuple[float, int, float, float, float]:
    """Squared distance of a point to triangle f, region and foot; region -1 when it is not below `best`.

    `planes[f]` holds the normal and height of the triangle's plane, and the inward normals and heights of
    the three planes through its sides.
    """
    # Elements, never rows: a view of a row would be counted, which costs more than the arithmetic.
    height = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3]
    if height * height >= best:
        return best, -1, 0.0, 0.0, 0.0
    s0 = planes[f, 4] * x + planes[f, 5] * y + planes[f, 6] * z - planes[f, 7]
    s1 = planes[f, 8] * x + planes[f, 9] * y + planes[f, 10] * z - planes[f, 11]
    s2 = planes[f, 12] * x + planes[f, 13] * y + planes[f, 14] * z - planes[f, 15]
    least = min(s0, s1, s2)
    squared = height * height
    if least < 0.0:
        squared += least * least
    if squared >= best:
        return best, -1, 0.0, 0.0, 0.0
    if least >= 0.0:
        return squared, 0, x - height * planes[f, 0], y - height * planes[f, 1], z - height * planes[f, 2]
    nearest, region = best, -1
    fx, fy, fz = 0.0, 0.0, 0.0
    for k in range(3):
        if (k == 0 and s0 >= 0.0) or (k == 1 and s1 >= 0.0) or (k == 2 and s2 >= 0.0):
            continue
        n = k + 1 if k < 2 else 0
        ax, ay, az = corners[f, k, 0], corners[f, k, 1], corners[f, k, 2]
        ux, uy, uz = corners[f, n, 0] - ax, corners[f, n, 1] - ay, corners[f, n, 2] - az
        share = ((x - ax) * ux + (y - ay) * uy + (z - az) * uz) / (ux * ux + uy * uy + uz * uz)
        where = k + 1
        if share <= 0.0:
            share, where = 0.0, k + 4
        elif share >= 1.0:
            share, where = 1.0, n + 4
        gx, gy, gz = ax + share * ux, ay + share * uy, az + share * uz
        squared = (x - gx) ** 2 + (y - gy) ** 2 + (z - gz) ** 2
        if squared < nearest:
            nearest, region, fx, fy, fz = squared, where, gx, gy, gz
    return nearest, region, fx, fy, fz


@numba.njit(cache=True, error_model="numpy")
def _search(
    x: float,
    y: float,
    z: float,
    hint: int,
    origin: FloatArray,
    size_m: float,
    counts: NDArray[np.int64],
    start: IntArray,
    members: IntArray,
    gap: IntArray,
    corners: FloatArray,
    planes: FloatArray,
) -> tuple[int, int, float, float, float]:
    """Nearest triangle, region and foot; `hint` is a triangle that may be near, or -1."""
    per_m = 1.0 / size_m
    ny, nz = counts[1], counts[2]
    ci = _cell(x, origin[0], per_m, counts[0])
    cj = _cell(y, origin[1], per_m, ny)
    ck = _cell(z, origin[2], per_m, nz)
    best, facet, region = np.inf, -1, -1
    fx, fy, fz = 0.0, 0.0, 0.0
    shell = -1
    if hint >= 0:
        best, region, fx, fy, fz = _try(x, y, z, hint, np.inf, corners, planes)
        facet = hint
    else:
        shell = gap[(ci * ny + cj) * nz + ck]
        for i in range(max(ci - shell, 0), min(ci + shell, counts[0] - 1) + 1):
            for j in range(max(cj - shell, 0), min(cj + shell, ny - 1) + 1):
                on_side = abs(i - ci) == shell or abs(j - cj) == shell
                step = 1 if on_side or shell == 0 else 2 * shell
                for k in range(ck - shell, ck + shell + 1, step):
                    if 0 <= k < nz:
                        cell = (i * ny + j) * nz + k
                        for m in range(start[cell], start[cell + 1]):
                            f = members[m]
                            d, where, gx, gy, gz = _try(x, y, z, f, best, corners, planes)
                            if where >= 0:
                                best, facet, region, fx, fy, fz = d, f, where, gx, gy, gz
    radius = math.sqrt(best)
    i0, i1 = _cell(x - radius, origin[0], per_m, counts[0]), _cell(x + radius, origin[0], per_m, counts[0])
    j0, j1 = _cell(y - radius, origin[1], per_m, ny), _cell(y + radius, origin[1], per_m, ny)
    k0, k1 = _cell(z - radius, origin[2], per_m, nz), _cell(z + radius, origin[2], per_m, nz)
    for i in range(i0, i1 + 1):
        low = origin[0] + i * size_m
        dx = max(low - x, x - low - size_m, 0.0)
        for j in range(j0, j1 + 1):
            low = origin[1] + j * size_m
            dy = max(low - y, y - low - size_m, 0.0)
            if dx * dx + dy * dy > best * (1.0 + 1e-9):
                continue
            for k in range(k0, k1 + 1):
                if shell >= 0 and max(abs(i - ci), abs(j - cj), abs(k - ck)) <= shell:
                    continue
                low = origin[2] + k * size_m
                dz = max(low - z, z - low - size_m, 0.0)
                if dx * dx + dy * dy + dz * dz > best * (1.0 + 1e-9):
                    continue
                cell = (i * ny + j) * nz + k
                for m in range(start[cell], start[cell + 1]):
                    f = members[m]
                    d, where, gx, gy, gz = _try(x, y, z, f, best, corners, planes)
                    if where >= 0:
                        best, facet, region, fx, fy, fz = d, f, where, gx, gy, gz
    return facet, region, fx, fy, fz


@numba.njit(cache=True, parallel=True, error_model="numpy")
def nearest(
    points: FloatArray,
    hint: IntArray,
    origin: FloatArray,
    size_m: float,
    counts: NDArray[np.int64],
    start: IntArray,
    members: IntArray,
    gap: IntArray,
    corners: FloatArray,
    planes: FloatArray,
    foot: FloatArray,
    region: NDArray[np.int8],
) -> None:
    """Nearest triangle into `hint` (m,), foot (m, 3) and region (m,) of each point (m, 3)."""
    for chunk in numba.prange((len(points) + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(points))):
            f, where, x, y, z = _search(
                points[i, 0],
                points[i, 1],
                points[i, 2],
                hint[i],
                origin,
                size_m,
                counts,
                start,
                members,
                gap,
                corners,
                planes,
            )
            hint[i], region[i] = f, where
            foot[i, 0], foot[i, 1], foot[i, 2] = x, y, z


@numba.njit(cache=True, inline="always", error_model="numpy")
def _oriented(
    dx: float, dy: float, dz: float, f: int, where: int, normals: FloatArray, open_: NDArray[np.bool_]
) -> tuple[float, float, float, float]:
    """Signed distance and gradient from foot to point; on an open edge the height over the triangle."""
    nx, ny, nz = normals[f, where, 0], normals[f, where, 1], normals[f, where, 2]
    side = dx * nx + dy * ny + dz * nz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if where == 0 or open_[f, where] or length < 1e-12:
        return side, nx, ny, nz
    signed = length if side >= 0.0 else -length
    return signed, dx / signed, dy / signed, dz / signed


@numba.njit(cache=True, parallel=True, error_model="numpy")
def normal_equations(
    base_p: FloatArray,
    weight: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    huber: float,
    hint: IntArray,
    origin: FloatArray,
    size_m: float,
    counts: NDArray[np.int64],
    start: IntArray,
    members: IntArray,
    gap: IntArray,
    corners: FloatArray,
    planes: FloatArray,
    normals: FloatArray,
    open_: NDArray[np.bool_],
    sums: FloatArray,
) -> None:
    """Partial sums (chunks, SUMS) over points of squares of weighted residuals and their derivatives.

    The point in the frame of the mesh is rotation^T (p - shift); the derivatives are by a right perturbation
    of (rotation, shift). Residuals over `huber` weigh less (infinite for none).
    """
    for chunk in numba.prange((len(base_p) + CHUNK - 1) // CHUNK):
        own = np.zeros(SUMS)
        row = np.empty(7)
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(base_p))):
            if weight[i] == 0.0:
                continue
            a, b, c = base_p[i, 0] - shift[0], base_p[i, 1] - shift[1], base_p[i, 2] - shift[2]
            x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
            y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
            z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
            f, where, fx, fy, fz = _search(
                x, y, z, hint[i], origin, size_m, counts, start, members, gap, corners, planes
            )
            hint[i] = f
            distance, gx, gy, gz = _oriented(x - fx, y - fy, z - fz, f, where, normals, open_)
            add_point(own, row, weight[i], huber, distance, x, y, z, gx, gy, gz)
        sums[chunk] = own


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
        cell = _cell(x, origin[0], per_m, counts[0])
        cell = cell * counts[1] + _cell(y, origin[1], per_m, counts[1])
        keys[i] = cell * counts[2] + _cell(z, origin[2], per_m, counts[2])
        ends[keys[i] + 1] += 1
    for cell in range(len(ends) - 1):
        ends[cell + 1] += ends[cell]
    order = np.empty(len(base_p), np.int64)
    for i in range(len(base_p)):
        order[ends[keys[i]]] = i
        ends[keys[i]] += 1
    return order
