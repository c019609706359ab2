"""The sums that least squares needs from each point: shared by the compiled passes over points."""

import math

import numba

from estimation.transform import FloatArray


@numba.njit(cache=True, inline="always", error_model="numpy")
def add_point(
    own: FloatArray,
    row: FloatArray,
    weight: float,
    huber: float,
    distance: float,
    x: float,
    y: float,
    z: float,
    gx: float,
    gy: float,
    gz: float,
) -> None:
    """Adds one weighted distance at (x, y, z) with gradient g to `own`, as `Sums.of` takes it.

    `row` (7,) is scratch. Residuals over `huber` weigh less.
    """
    w, size = weight, abs(distance) * weight
    if size > huber:
        own[27] += huber * (2.0 * size - huber)
        w *= math.sqrt(huber / size)
    else:
        own[27] += size * size
    own[28] += 1.0
    row[0], row[1], row[2] = -w * gx, -w * gy, -w * gz
    row[3] = -w * (y * gz - z * gy)
    row[4] = -w * (z * gx - x * gz)
    row[5] = -w * (x * gy - y * gx)
    row[6] = w * distance
    place = 0
    for j in range(6):
        for k in range(j, 6):
            own[place] += row[j] * row[k]
            place += 1
    for j in range(6):
        own[21 + j] += row[j] * row[6]
