"""Compiled chord Newton, one replica after another; numpy has the same steps for all replicas at once.

The plan comes with its points along the last axis, so that a pass over them fills the processor's registers.
"""

import math
from typing import Final

import numba
import numpy as np

from estimation.transform import FloatArray

# Sums in any order, so that they use the processor's wide registers; not-a-number is still seen.
_FAST: Final = {"reassoc", "contract", "nsz", "arcp"}


@numba.njit(cache=True, inline="always")
def _unit(across: FloatArray, a: float, b: float) -> tuple[float, float, float, float]:
    """lead + across (a, b), of length 1, and one over its length before; `across` (3, 3) ends with lead."""
    x = across[0, 2] + across[0, 0] * a + across[0, 1] * b
    y = across[1, 2] + across[1, 0] * a + across[1, 1] * b
    z = across[2, 2] + across[2, 0] * a + across[2, 1] * b
    per = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * per, y * per, z * per, per


@numba.njit(cache=True, inline="always")
def _stepped(
    state: FloatArray, gradient: FloatArray, gain: FloatArray, deviations: FloatArray, step: FloatArray
) -> float:
    """Fills `step` = -gain gradient, adds it to `state`; its largest size in standard deviations."""
    size = 0.0
    for j in range(len(gradient)):
        total = 0.0
        for i in range(len(gradient)):
            total -= gain[j, i] * gradient[i]
        step[j] = total
        state[j] += total
        share = abs(total) / deviations[j]
        if not share <= size:  # not-a-number is never small
            size = share
    return size


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def hand_eye(
    turns: FloatArray,
    places: FloatArray,
    ranges: FloatArray,
    range_variance: FloatArray,
    rest_variance: FloatArray,
    beam_across: FloatArray,
    normal_across: FloatArray,
    gain: FloatArray,
    deviations: FloatArray,
    tolerance: float,
    limit: int,
    states: FloatArray,
) -> int:
    """Moves `states` (k, 8), coordinates as of `PlaneHandEye.covariance`, to the optimum of each replica.

    turns (9, n), places (3, n), ranges (k, n). Returns the iterations of the slowest, or -1.
    """
    slowest = 0
    gradient, step = np.empty(8), np.empty(8)
    for k in range(len(states)):
        state, reading = states[k], ranges[k]
        settled = False
        for iteration in range(limit):
            tx, ty, tz, offset = state[0], state[1], state[2], state[7]
            ux, uy, uz, per_beam = _unit(beam_across, state[3], state[4])
            nx, ny, nz, per_normal = _unit(normal_across, state[5], state[6])
            tx_sum, ty_sum, tz_sum, ux_sum, uy_sum, uz_sum = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            nx_sum, ny_sum, nz_sum, sum_ = 0.0, 0.0, 0.0, 0.0
            for i in range(len(rest_variance)):
                d = reading[i]
                rx = turns[0, i] * nx + turns[3, i] * ny + turns[6, i] * nz  # R^T n
                ry = turns[1, i] * nx + turns[4, i] * ny + turns[7, i] * nz
                rz = turns[2, i] * nx + turns[5, i] * ny + turns[8, i] * nz
                lx, ly, lz = tx + d * ux, ty + d * uy, tz + d * uz
                flat = nx * places[0, i] + ny * places[1, i] + nz * places[2, i]
                slope = rx * ux + ry * uy + rz * uz
                error = (rx * lx + ry * ly + rz * lz + flat - offset) / (
                    range_variance[i] * slope * slope + rest_variance[i]
                )
                tx_sum += error * rx
                ty_sum += error * ry
                tz_sum += error * rz
                ux_sum += error * d * rx
                uy_sum += error * d * ry
                uz_sum += error * d * rz
                nx_sum += error * (turns[0, i] * lx + turns[1, i] * ly + turns[2, i] * lz + places[0, i])
                ny_sum += error * (turns[3, i] * lx + turns[4, i] * ly + turns[5, i] * lz + places[1, i])
                nz_sum += error * (turns[6, i] * lx + turns[7, i] * ly + turns[8, i] * lz + places[2, i])
                sum_ += error
            gradient[0], gradient[1], gradient[2], gradient[7] = tx_sum, ty_sum, tz_sum, -sum_
            along = ux_sum * ux + uy_sum * uy + uz_sum * uz
            ux_sum, uy_sum, uz_sum = ux_sum - along * ux, uy_sum - along * uy, uz_sum - along * uz
            along = nx_sum * nx + ny_sum * ny + nz_sum * nz
            nx_sum, ny_sum, nz_sum = nx_sum - along * nx, ny_sum - along * ny, nz_sum - along * nz
            for j in range(2):
                gradient[3 + j] = per_beam * (
                    ux_sum * beam_across[0, j] + uy_sum * beam_across[1, j] + uz_sum * beam_across[2, j]
                )
                gradient[5 + j] = per_normal * (
                    nx_sum * normal_across[0, j] + ny_sum * normal_across[1, j] + nz_sum * normal_across[2, j]
                )
            if _stepped(state, gradient, gain, deviations, step) < tolerance:
                slowest, settled = max(slowest, iteration + 1), True
                break
        if not settled:
            return -1
    return slowest


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def plane_pose(
    points: FloatArray,
    normals: FloatArray,
    offsets: FloatArray,
    weights: FloatArray,
    gain: FloatArray,
    deviations: FloatArray,
    tolerance: float,
    limit: int,
    rotations: FloatArray,
    origins: FloatArray,
) -> int:
    """Moves poses (k, 3, 3), (k, 3) to the optimum of each replica.

    points (k, 3, n) in the base, normals (3, n) and offsets (n,) of the planes in the object. Returns the
    iterations of the slowest, or -1.
    """
    slowest = 0
    gradient, step, turned = np.empty(6), np.empty(6), np.empty((3, 3))
    state = np.zeros(6)
    for k in range(len(points)):
        r, t, p = rotations[k], origins[k], points[k]
        settled = False
        for iteration in range(limit):
            r00, r01, r02 = r[0, 0], r[0, 1], r[0, 2]
            r10, r11, r12 = r[1, 0], r[1, 1], r[1, 2]
            r20, r21, r22 = r[2, 0], r[2, 1], r[2, 2]
            tx, ty, tz = t[0], t[1], t[2]
            tx_sum, ty_sum, tz_sum, rx_sum, ry_sum, rz_sum = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(len(weights)):
                a, b, c = p[0, i] - tx, p[1, i] - ty, p[2, i] - tz
                x = r00 * a + r10 * b + r20 * c
                y = r01 * a + r11 * b + r21 * c
                z = r02 * a + r12 * b + r22 * c
                nx, ny, nz = normals[0, i], normals[1, i], normals[2, i]
                error = weights[i] * (nx * x + ny * y + nz * z - offsets[i])
                tx_sum += error * nx
                ty_sum += error * ny
                tz_sum += error * nz
                rx_sum += error * (y * nz - z * ny)
                ry_sum += error * (z * nx - x * nz)
                rz_sum += error * (x * ny - y * nx)
            gradient[0], gradient[1], gradient[2] = -tx_sum, -ty_sum, -tz_sum
            gradient[3], gradient[4], gradient[5] = -rx_sum, -ry_sum, -rz_sum
            size = _stepped(state, gradient, gain, deviations, step)
            for j in range(3):
                t[j] += r[j, 0] * step[0] + r[j, 1] * step[1] + r[j, 2] * step[2]
            _turn(r, step[3], step[4], step[5], turned)
            if size < tolerance:
                slowest, settled = max(slowest, iteration + 1), True
                break
        if not settled:
            return -1
    return slowest


@numba.njit(cache=True)
def _turn(r: FloatArray, x: float, y: float, z: float, turned: FloatArray) -> None:
    """r (3, 3) times the rotation by (x, y, z), in place; `turned` (3, 3) is scratch."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-4:
        first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    for j in range(3):
        a, b, c = r[j, 0], r[j, 1], r[j, 2]
        # a row times [v]x, and that times [v]x again
        d, e, f = b * z - c * y, c * x - a * z, a * y - b * x
        turned[j, 0] = a + first * d + second * (e * z - f * y)
        turned[j, 1] = b + first * e + second * (f * x - d * z)
        turned[j, 2] = c + first * f + second * (d * y - e * x)
    r[:] = turned
