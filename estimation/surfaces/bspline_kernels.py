"""Compiled foot points on a bicubic patch, and sums over points; `bspline_cells.py` has the same in numpy.

A patch comes as its cells do: `coefficients` (cells in u, cells in v, 3, 4, 4) of powers of the place within
the cell, `breaks` at the ends of the cells, `closed` where u or v begin anew.
"""

import math
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.surfaces.shape import CHUNK, SUMS
from estimation.surfaces.sums_kernels import BLOCK, add_block, put_point
from estimation.transform import FloatArray

STEPS: Final = 40
CONVERGED: Final = 1e-6  # last step, of the size of the patch: Newton's error is its square
FIRST_DAMPING: Final = 1e-3
LARGEST_DAMPING: Final = 1e12


@numba.njit(cache=True, error_model="numpy")
def _cell(value: float, breaks: FloatArray, cell: int) -> int:
    """The cell that holds the value, sought from a cell nearby."""
    while cell + 2 < len(breaks) and value >= breaks[cell + 1]:
        cell += 1
    while cell > 0 and value < breaks[cell]:
        cell -= 1
    return cell


@numba.njit(cache=True, error_model="numpy")
def _jet(
    u: float,
    v: float,
    i: int,
    j: int,
    breaks_u: FloatArray,
    breaks_v: FloatArray,
    coefficients: FloatArray,
    jet: FloatArray,
) -> None:
    """Point, first and second derivatives (u, v, uu, uv, vv) into `jet` (6, 3), by Horner's rule."""
    per_u, per_v = 1.0 / (breaks_u[i + 1] - breaks_u[i]), 1.0 / (breaks_v[j + 1] - breaks_v[j])
    s, t = (u - breaks_u[i]) * per_u, (v - breaks_v[j]) * per_v
    for k in range(3):
        f, fs, fss, ft, fst, ftt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(3, -1, -1):
            c0, c1 = coefficients[i, j, k, p, 0], coefficients[i, j, k, p, 1]
            c2, c3 = coefficients[i, j, k, p, 2], coefficients[i, j, k, p, 3]
            fss = fss * s + fs
            fs = fs * s + f
            f = f * s + ((c3 * t + c2) * t + c1) * t + c0
            fst = fst * s + ft
            ft = ft * s + (3.0 * c3 * t + 2.0 * c2) * t + c1
            ftt = ftt * s + 6.0 * c3 * t + 2.0 * c2
        jet[0, k], jet[1, k], jet[2, k] = f, fs * per_u, ft * per_v
        jet[3, k], jet[4, k], jet[5, k] = 2.0 * fss * per_u**2, fst * per_u * per_v, ftt * per_v**2


@numba.njit(cache=True, inline="always", error_model="numpy")
def _shift(jet: FloatArray, du: float, dv: float) -> None:
    """Moves point and first derivatives of a jet along."""
    for k in range(3):
        jet[0, k] += du * jet[1, k] + dv * jet[2, k]
        jet[1, k] += du * jet[3, k] + dv * jet[4, k]
        jet[2, k] += du * jet[4, k] + dv * jet[5, k]


@numba.njit(cache=True, error_model="numpy")
def _within(value: float, breaks: FloatArray, closed: bool) -> float:
    low, high = breaks[0], breaks[-1]
    if closed:
        return float(low + (value - low) % (high - low))
    return float(min(max(value, low), high))


@numba.njit(cache=True, error_model="numpy")
def _pinned(value: float, slope: float, breaks: FloatArray, closed: bool) -> bool:
    """The foot is on an edge, and the surface would have to go on to come nearer."""
    return not closed and ((value <= breaks[0] and slope > 0.0) or (value >= breaks[-1] and slope < 0.0))


@numba.njit(cache=True, error_model="numpy")
def _foot(
    x: float,
    y: float,
    z: float,
    u: float,
    v: float,
    size_m: float,
    breaks_u: FloatArray,
    breaks_v: FloatArray,
    closed_u: bool,
    closed_v: bool,
    coefficients: FloatArray,
    jet: FloatArray,
) -> tuple[float, float, bool]:
    """The nearest (u, v) from a start, and whether that is on an edge; `jet` is left there."""
    i, j = _cell(u, breaks_u, 0), _cell(v, breaks_v, 0)
    _jet(u, v, i, j, breaks_u, breaks_v, coefficients, jet)
    rx, ry, rz = jet[0, 0] - x, jet[0, 1] - y, jet[0, 2] - z
    squared, damping, on_edge = rx * rx + ry * ry + rz * rz, 0.0, False
    last = np.inf
    for _ in range(STEPS):
        gu = rx * jet[1, 0] + ry * jet[1, 1] + rz * jet[1, 2]
        gv = rx * jet[2, 0] + ry * jet[2, 1] + rz * jet[2, 2]
        pin_u, pin_v = _pinned(u, gu, breaks_u, closed_u), _pinned(v, gv, breaks_v, closed_v)
        on_edge = pin_u or pin_v
        if last < CONVERGED * size_m or damping > LARGEST_DAMPING or (pin_u and pin_v):
            break
        e = jet[1, 0] ** 2 + jet[1, 1] ** 2 + jet[1, 2] ** 2
        m = jet[1, 0] * jet[2, 0] + jet[1, 1] * jet[2, 1] + jet[1, 2] * jet[2, 2]
        g = jet[2, 0] ** 2 + jet[2, 1] ** 2 + jet[2, 2] ** 2
        huu = e + rx * jet[3, 0] + ry * jet[3, 1] + rz * jet[3, 2]
        huv = m + rx * jet[4, 0] + ry * jet[4, 1] + rz * jet[4, 2]
        hvv = g + rx * jet[5, 0] + ry * jet[5, 1] + rz * jet[5, 2]
        if pin_u or pin_v:
            huv = 0.0
        if huu <= 0.0 or hvv <= 0.0 or huu * hvv - huv * huv <= 1e-6 * e * g:  # not a valley: Gauss-Newton
            huu, hvv = e, g
            huv = 0.0 if pin_u or pin_v else m
        huu, hvv = huu + damping * e, hvv + damping * g
        scale = huu * hvv - huv * huv
        du = 0.0 if pin_u else -(hvv * gu - huv * gv) / scale
        dv = 0.0 if pin_v else -(huu * gv - huv * gu) / scale
        length = math.sqrt(du * du * e + dv * dv * g)
        if length < CONVERGED * size_m and damping == 0.0 and not on_edge:
            un, vn = u + du, v + dv
            if breaks_u[i] <= un < breaks_u[i + 1] and breaks_v[j] <= vn < breaks_v[j + 1]:
                _shift(jet, du, dv)  # so near that its change is linear
                return un, vn, False
        un, vn = _within(u + du, breaks_u, closed_u), _within(v + dv, breaks_v, closed_v)
        i, j = _cell(un, breaks_u, i), _cell(vn, breaks_v, j)
        _jet(un, vn, i, j, breaks_u, breaks_v, coefficients, jet)
        rx, ry, rz = jet[0, 0] - x, jet[0, 1] - y, jet[0, 2] - z
        trial = rx * rx + ry * ry + rz * rz
        if trial <= squared * (1.0 + 1e-14):
            last = length
            u, v, squared, damping = un, vn, trial, damping * 0.1 if damping > FIRST_DAMPING else 0.0
        else:
            damping = max(10.0 * damping, FIRST_DAMPING)
            i, j = _cell(u, breaks_u, i), _cell(v, breaks_v, j)
            _jet(u, v, i, j, breaks_u, breaks_v, coefficients, jet)
            rx, ry, rz = jet[0, 0] - x, jet[0, 1] - y, jet[0, 2] - z
    return u, v, on_edge


@numba.njit(cache=True, inline="always", error_model="numpy")
def _normal(jet: FloatArray) -> tuple[float, float, float]:
    nx = jet[1, 1] * jet[2, 2] - jet[1, 2] * jet[2, 1]
    ny = jet[1, 2] * jet[2, 0] - jet[1, 0] * jet[2, 2]
    nz = jet[1, 0] * jet[2, 1] - jet[1, 1] * jet[2, 0]
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@numba.njit(cache=True, error_model="numpy")
def _turning(
    x: float, y: float, z: float, jet: FloatArray, normal: tuple[float, float, float], along: int
) -> float:
    """How much of the derivative `along` (1: u, 2: v) the gradient has, at a foot that slides in it."""
    rx, ry, rz = x - jet[0, 0], y - jet[0, 1], z - jet[0, 2]
    nx, ny, nz = normal
    height = rx * nx + ry * ny + rz * nz
    ax, ay, az = rx - height * nx, ry - height * ny, rz - height * nz
    # The change of u x v along the edge: uu x v + u x uv, or uv x v + u x vv.
    p, q, bend = (3, 4, 3) if along == 1 else (4, 5, 5)
    cx = jet[p, 1] * jet[2, 2] - jet[p, 2] * jet[2, 1] + jet[1, 1] * jet[q, 2] - jet[1, 2] * jet[q, 1]
    cy = jet[p, 2] * jet[2, 0] - jet[p, 0] * jet[2, 2] + jet[1, 2] * jet[q, 0] - jet[1, 0] * jet[q, 2]
    cz = jet[p, 0] * jet[2, 1] - jet[p, 1] * jet[2, 0] + jet[1, 0] * jet[q, 1] - jet[1, 1] * jet[q, 0]
    lx = jet[1, 1] * jet[2, 2] - jet[1, 2] * jet[2, 1]
    ly = jet[1, 2] * jet[2, 0] - jet[1, 0] * jet[2, 2]
    lz = jet[1, 0] * jet[2, 1] - jet[1, 1] * jet[2, 0]
    turn = (ax * cx + ay * cy + az * cz) / math.sqrt(lx * lx + ly * ly + lz * lz)
    stretch = jet[along, 0] ** 2 + jet[along, 1] ** 2 + jet[along, 2] ** 2
    stretch -= rx * jet[bend, 0] + ry * jet[bend, 1] + rz * jet[bend, 2]
    return float(turn / stretch)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _on_edge(value: float, breaks: FloatArray, closed: bool) -> bool:
    return not closed and (value <= breaks[0] or value >= breaks[-1])


@numba.njit(cache=True, error_model="numpy")
def closest(points: FloatArray, grid: FloatArray) -> NDArray[np.int64]:
    """(m,) which of a few points, the columns of `grid` (3, n), is closest to each point (m, 3)."""
    found, square = np.empty(len(points), np.int64), np.empty(grid.shape[1])
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(len(square)):  # apart from the search, so that it runs in wide registers
            a, b, c = grid[0, j] - x, grid[1, j] - y, grid[2, j] - z
            square[j] = a * a + b * b + c * c
        best = 0
        for j in range(1, len(square)):
            if square[j] < square[best]:
                best = j
        found[i] = best
    return found


@numba.njit(cache=True, parallel=True, error_model="numpy")
def feet(
    points: FloatArray,
    place: FloatArray,
    size_m: float,
    breaks_u: FloatArray,
    breaks_v: FloatArray,
    closed_u: bool,
    closed_v: bool,
    coefficients: FloatArray,
    beyond: NDArray[np.bool_],
) -> None:
    """Moves `place` (m, 2) from its starts to the feet of points (m, 3); `beyond` (m,) on the edge."""
    for chunk in numba.prange((len(points) + CHUNK - 1) // CHUNK):
        jet = np.empty((6, 3))
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(points))):
            place[i, 0], place[i, 1], beyond[i] = _foot(
                points[i, 0],
                points[i, 1],
                points[i, 2],
                place[i, 0],
                place[i, 1],
                size_m,
                breaks_u,
                breaks_v,
                closed_u,
                closed_v,
                coefficients,
                jet,
            )


@numba.njit(cache=True, parallel=True, error_model="numpy")
def normal_equations(
    base_p: FloatArray,
    weight: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    huber: float,
    place: FloatArray,
    size_m: float,
    breaks_u: FloatArray,
    breaks_v: FloatArray,
    closed_u: bool,
    closed_v: bool,
    coefficients: FloatArray,
    sums: FloatArray,
) -> None:
    """Partial sums (chunks, SUMS), as those of a mesh; `place` (m, 2) moves on to the feet."""
    for chunk in numba.prange((len(base_p) + CHUNK - 1) // CHUNK):
        own, jet = np.zeros(SUMS), np.empty((6, 3))
        rows, placed = np.empty((7, BLOCK)), 0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(base_p))):
            a, b, c = base_p[i, 0] - shift[0], base_p[i, 1] - shift[1], base_p[i, 2] - shift[2]
            x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
            y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
            z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
            place[i, 0], place[i, 1], beyond = _foot(
                x,
                y,
                z,
                place[i, 0],
                place[i, 1],
                size_m,
                breaks_u,
                breaks_v,
                closed_u,
                closed_v,
                coefficients,
                jet,
            )
            nx, ny, nz = _normal(jet)
            distance = (x - jet[0, 0]) * nx + (y - jet[0, 1]) * ny + (z - jet[0, 2]) * nz
            if beyond:  # as the foot slides along its edge, the tangent plane turns under the point
                on_u = _on_edge(place[i, 0], breaks_u, closed_u)
                on_v = _on_edge(place[i, 1], breaks_v, closed_v)
                if on_u != on_v:
                    along = 2 if on_u else 1
                    part = _turning(x, y, z, jet, (nx, ny, nz), along)
                    nx += part * jet[along, 0]
                    ny += part * jet[along, 1]
                    nz += part * jet[along, 2]
            placed = put_point(own, rows, placed, weight[i], huber, distance, x, y, z, nx, ny, nz)
        add_block(own, rows, placed)
        sums[chunk] = own
