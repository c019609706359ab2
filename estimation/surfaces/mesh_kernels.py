"""Compiled search for the nearest triangle of a mesh, exact at any distance, and sums over all points.

Triangles are listed in the cells of a regular grid. A walk from a triangle nearby, across sides, gives an
upper bound; the cells that a ball of that radius meets hold the nearest triangle. Most points near a surface
need no look into cells: see `grid_kernels.clearance`. Points that come sorted by cell find the data of their
neighbours still in the cache.
"""

import math
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.surfaces.grid_kernels import SLACK, IntArray, cell_of
from estimation.surfaces.shape import CHUNK, SUMS
from estimation.surfaces.sums_kernels import BLOCK, add_block, put_point
from estimation.transform import FloatArray

INSIDE: Final = 0  # regions of a foot: 0 inside, 1-3 on the side from corner k - 1, 4-6 at corner k - 4


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
def central(
    origin: FloatArray,
    size_m: float,
    counts: NDArray[np.int64],
    start: IntArray,
    members: IntArray,
    corners: FloatArray,
    planes: FloatArray,
) -> IntArray:
    """(cells,) of the triangles of each cell the one nearest to its centre; -1 in empty cells."""
    found = np.full(len(start) - 1, -1, np.int32)
    for cell in range(len(found)):
        if start[cell] == start[cell + 1]:
            continue
        x = origin[0] + (cell // (counts[1] * counts[2]) + 0.5) * size_m
        y = origin[1] + (cell // counts[2] % counts[1] + 0.5) * size_m
        z = origin[2] + (cell % counts[2] + 0.5) * size_m
        best = np.inf
        for m in range(start[cell], start[cell + 1]):
            d, where, _, _, _ = _try(x, y, z, members[m], best, corners, planes)
            if where >= 0:
                best, found[cell] = d, members[m]
    return found


@numba.njit(cache=True, error_model="numpy")
def _walk(
    x: float, y: float, z: float, f: int, across: IntArray, corners: FloatArray, planes: FloatArray
) -> tuple[float, int, int, float, float, float]:
    """Squared distance, triangle, region and foot where no triangle across a side is nearer; from f."""
    best, region, fx, fy, fz = _try(x, y, z, f, np.inf, corners, planes)
    while region != INSIDE:
        # Across the side of the foot; from a corner, across the side behind which the point is further away.
        k = region - 1 if region < 4 else region - 4
        if region >= 4:
            before = k + 2 if k < 1 else k - 1
            a = planes[f, 4 * k + 4] * x + planes[f, 4 * k + 5] * y + planes[f, 4 * k + 6] * z
            b = planes[f, 4 * before + 4] * x + planes[f, 4 * before + 5] * y + planes[f, 4 * before + 6] * z
            if b - planes[f, 4 * before + 7] < a - planes[f, 4 * k + 7]:
                k = before
        g = across[f, k]
        if g < 0:
            break
        d, where, gx, gy, gz = _try(x, y, z, g, best, corners, planes)
        if where < 0:
            break
        best, f, region, fx, fy, fz = d, g, where, gx, gy, gz
    return best, f, region, fx, fy, fz


@numba.njit(cache=True, inline="always", error_model="numpy")
def _below(x: float, y: float, z: float, f: int, best: float, planes: FloatArray) -> bool:
    """Whether triangle f can be nearer than `best`, squared: judged by its plane and its sides' planes."""
    height = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3]
    s0 = planes[f, 4] * x + planes[f, 5] * y + planes[f, 6] * z - planes[f, 7]
    s1 = planes[f, 8] * x + planes[f, 9] * y + planes[f, 10] * z - planes[f, 11]
    s2 = planes[f, 12] * x + planes[f, 13] * y + planes[f, 14] * z - planes[f, 15]
    aside = min(s0, s1, s2, 0.0)
    return bool(height * height + aside * aside < best)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _inside(x: float, y: float, z: float, f: int, clear: FloatArray, planes: FloatArray) -> float:
    """Height over triangle f if the ball down to it stays in the clear prism over f, else infinite."""
    height = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3]
    s0 = planes[f, 4] * x + planes[f, 5] * y + planes[f, 6] * z - planes[f, 7]
    s1 = planes[f, 8] * x + planes[f, 9] * y + planes[f, 10] * z - planes[f, 11]
    s2 = planes[f, 12] * x + planes[f, 13] * y + planes[f, 14] * z - planes[f, 15]
    return height if abs(height) < min(s0, s1, s2, clear[f, 0]) else np.inf


@numba.njit(cache=True, inline="always", error_model="numpy")
def _across(
    x: float,
    y: float,
    z: float,
    f: int,
    radius: float,
    slack_m: float,
    across: IntArray,
    clear: FloatArray,
    planes: FloatArray,
) -> int:
    """The triangle across a side of f if no third one can be as near as `radius`, at which f is; else -1."""
    s0 = planes[f, 4] * x + planes[f, 5] * y + planes[f, 6] * z - planes[f, 7]
    s1 = planes[f, 8] * x + planes[f, 9] * y + planes[f, 10] * z - planes[f, 11]
    s2 = planes[f, 12] * x + planes[f, 13] * y + planes[f, 14] * z - planes[f, 15]
    k = 0 if s0 < min(s1, s2) else (1 if s1 < s2 else 2)
    others = min(s1, s2) if k == 0 else (min(s0, s2) if k == 1 else min(s0, s1))
    if not (radius < clear[f, k + 1] and radius + slack_m < others):
        return -1
    g = across[f, k]
    for j in range(3):
        aside = planes[g, 4 * j + 4] * x + planes[g, 4 * j + 5] * y + planes[g, 4 * j + 6] * z
        if across[g, j] != f and not radius + slack_m < aside - planes[g, 4 * j + 7]:
            return -1
    return int(g)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _cell(x: float, y: float, z: float, origin: FloatArray, size_m: float, counts: NDArray[np.int64]) -> int:
    per_m = 1.0 / size_m
    i, j = cell_of(x, origin[0], per_m, counts[0]), cell_of(y, origin[1], per_m, counts[1])
    return int((i * counts[1] + j) * counts[2] + cell_of(z, origin[2], per_m, counts[2]))


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
    seed: IntArray,
    gap: NDArray[np.int8],
    across: IntArray,
    clear: FloatArray,
    corners: FloatArray,
    planes: FloatArray,
) -> tuple[int, int, float, float, float]:
    """Nearest triangle, region and foot; `hint` is a triangle that may be near, or -1."""
    per_m = 1.0 / size_m
    ny, nz = counts[1], counts[2]
    if hint < 0:
        hint = seed[_cell(x, y, z, origin, size_m, counts)]
    height = _inside(x, y, z, hint, clear, planes)
    if height < np.inf:
        return (
            hint,
            INSIDE,
            x - height * planes[hint, 0],
            y - height * planes[hint, 1],
            z - height * planes[hint, 2],
        )
    best, facet, region, fx, fy, fz = _walk(x, y, z, hint, across, corners, planes)
    if facet != hint and _inside(x, y, z, facet, clear, planes) < np.inf:
        return facet, region, fx, fy, fz
    radius = math.sqrt(best)
    other = _across(x, y, z, facet, radius, SLACK * size_m, across, clear, planes)
    if other >= 0:
        d, where, gx, gy, gz = _try(x, y, z, other, best, corners, planes)
        if where >= 0:
            return other, where, gx, gy, gz
        return facet, region, fx, fy, fz
    i0, i1 = (
        cell_of(x - radius, origin[0], per_m, counts[0]),
        cell_of(x + radius, origin[0], per_m, counts[0]),
    )
    j0, j1 = cell_of(y - radius, origin[1], per_m, ny), cell_of(y + radius, origin[1], per_m, ny)
    k0, k1 = cell_of(z - radius, origin[2], per_m, nz), cell_of(z + radius, origin[2], per_m, nz)
    for i in range(i0, i1 + 1):
        low = origin[0] + i * size_m
        dx = max(low - x, x - low - size_m, 0.0)
        for j in range(j0, j1 + 1):
            low = origin[1] + j * size_m
            dy = max(low - y, y - low - size_m, 0.0)
            if dx * dx + dy * dy > best * (1.0 + 1e-9):
                continue
            k = k0 - 1
            while k < k1:
                k += 1
                cell = (i * ny + j) * nz + k
                if gap[cell] > 0:  # the next cells are as empty
                    k += gap[cell] - 1
                    continue
                low = origin[2] + k * size_m
                dz = max(low - z, z - low - size_m, 0.0)
                if dx * dx + dy * dy + dz * dz > best * (1.0 + 1e-9):
                    continue
                for m in range(start[cell], start[cell + 1]):
                    f = members[m]
                    if not _below(x, y, z, f, best, planes):
                        continue
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
    seed: IntArray,
    gap: NDArray[np.int8],
    across: IntArray,
    clear: FloatArray,
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
                seed,
                gap,
                across,
                clear,
                corners,
                planes,
            )
            hint[i], region[i] = f, where
            foot[i, 0], foot[i, 1], foot[i, 2] = x, y, z


@numba.njit(cache=True, inline="always", error_model="numpy")
def _oriented(
    dx: float,
    dy: float,
    dz: float,
    f: int,
    where: int,
    planes: FloatArray,
    order: IntArray,
    normals: FloatArray,
    open_: NDArray[np.bool_],
) -> tuple[float, float, float, float]:
    """Signed distance and gradient from foot to point; on an open edge the height over the triangle."""
    if where == INSIDE:  # nearly always, and then the plane is still in the cache
        nx, ny, nz = planes[f, 0], planes[f, 1], planes[f, 2]
        return dx * nx + dy * ny + dz * nz, nx, ny, nz
    f = order[f]
    nx, ny, nz = normals[f, where, 0], normals[f, where, 1], normals[f, where, 2]
    side = dx * nx + dy * ny + dz * nz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if open_[f, where] or length < 1e-12:
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
    seed: IntArray,
    gap: NDArray[np.int8],
    across: IntArray,
    clear: FloatArray,
    corners: FloatArray,
    planes: FloatArray,
    order: IntArray,
    normals: FloatArray,
    open_: NDArray[np.bool_],
    sums: FloatArray,
) -> None:
    """Partial sums (chunks, SUMS) over points of squares of weighted residuals and their derivatives.

    The point in the frame of the mesh is rotation^T (p - shift); the derivatives are by a right perturbation
    of (rotation, shift). Residuals over `huber` weigh less (infinite for none).
    """
    for chunk in numba.prange((len(base_p) + CHUNK - 1) // CHUNK):
        own, rows, placed = np.zeros(SUMS), np.empty((7, BLOCK)), 0
        p, height = np.empty((3, BLOCK)), np.empty(BLOCK)
        for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(base_p)), BLOCK):
            count = min(BLOCK, len(base_p) - first)
            # Those that lie clearly over the triangle that is known come first: nothing there depends on the
            # point before, and the processor fetches the triangles of several points at a time.
            for n in range(count):
                i = first + n
                a, b, c = base_p[i, 0] - shift[0], base_p[i, 1] - shift[1], base_p[i, 2] - shift[2]
                x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
                y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
                z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
                p[0, n], p[1, n], p[2, n] = x, y, z
                if hint[i] < 0:
                    hint[i] = seed[_cell(x, y, z, origin, size_m, counts)]
            for n in range(count):
                height[n] = _inside(p[0, n], p[1, n], p[2, n], hint[first + n], clear, planes)
            for n in range(count):
                i = first + n
                if weight[i] == 0.0:
                    continue
                x, y, z, distance, f = p[0, n], p[1, n], p[2, n], height[n], hint[i]
                if distance < np.inf:
                    gx, gy, gz = planes[f, 0], planes[f, 1], planes[f, 2]
                else:
                    f, where, fx, fy, fz = _search(
                        x,
                        y,
                        z,
                        f,
                        origin,
                        size_m,
                        counts,
                        start,
                        members,
                        seed,
                        gap,
                        across,
                        clear,
                        corners,
                        planes,
                    )
                    hint[i] = f
                    distance, gx, gy, gz = _oriented(
                        x - fx, y - fy, z - fz, f, where, planes, order, normals, open_
                    )
                placed = put_point(own, rows, placed, weight[i], huber, distance, x, y, z, gx, gy, gz)
        add_block(own, rows, placed)
        sums[chunk] = own
