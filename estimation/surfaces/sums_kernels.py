"""The sums that least squares needs from points: shared by the compiled passes over points.

A pass puts the rows of a few points side by side, and then adds them up: so the sums run over points that are
neighbours in memory, in the processor's wide registers.
"""

import math
from typing import Final

import numba

from estimation.transform import FloatArray

BLOCK: Final = 256  # points side by side: their rows (7, BLOCK) stay in the nearest cache
_FAST: Final = {"reassoc", "contract", "nsz"}


@numba.njit(cache=True, inline="always", error_model="numpy")
def put_point(
    own: FloatArray,
    rows: FloatArray,
    place: int,
    weight: float,
    huber: float,
    distance: float,
    x: float,
    y: float,
    z: float,
    gx: float,
    gy: float,
    gz: float,
) -> int:
    """Puts one weighted distance at (x, y, z) with gradient g into `rows` (7, BLOCK), its cost into `own`.

    Returns the next place; when the block is full, it is added to `own`. Residuals over `huber` weigh less.
    """
    w, size = weight, abs(distance) * weight
    if size > huber:
        own[27] += huber * (2.0 * size - huber)
        w *= math.sqrt(huber / size)
    else:
        own[27] += size * size
    own[28] += 1.0
    rows[0, place], rows[1, place], rows[2, place] = -w * gx, -w * gy, -w * gz
    rows[3, place] = -w * (y * gz - z * gy)
    rows[4, place] = -w * (z * gx - x * gz)
    rows[5, place] = -w * (x * gy - y * gx)
    rows[6, place] = w * distance
    if place + 1 < BLOCK:
        return place + 1
    add_block(own, rows, BLOCK)
    return 0


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def add_block(own: FloatArray, rows: FloatArray, count: int) -> None:
    """Adds the first rows to `own`, as `Sums.of` takes it."""
    place = 0
    for j in range(6):
        for k in range(j, 6):
            total = 0.0
            for i in range(count):
                total += rows[j, i] * rows[k, i]
            own[place] += total
            place += 1
    for j in range(6):
        total = 0.0
        for i in range(count):
            total += rows[j, i] * rows[6, i]
        own[21 + j] += total
