"""Compiled pass of stripes into voxels: transformed and added up, without a copy of the points."""

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray


@numba.njit(cache=True)
def _slot(key: np.int64, keys: NDArray[np.int64]) -> np.int64:
    """Where a key is in an open table whose length is a power of two, or where it may go."""
    mask = len(keys) - 1
    mixed = key * np.int64(-7046029254386353131)  # 2^64 over the golden ratio: neighbours go far apart
    slot = (mixed ^ (mixed >> 32)) & mask
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@numba.njit(cache=True)
def add_stripes(
    yz: NDArray[np.float32],
    base_T_sensor: FloatArray,
    per_m: float,
    half: int,
    keys: NDArray[np.int64],
    sums: FloatArray,
    first: int,
    used: int,
) -> tuple[int, int]:
    """Adds stripes from `first` on while the table is less than half full; returns the next one and `used`.

    yz (k, n, 2) as y and z in the sensor, NaN for no reading; sums (cells, 4) of x, y, z and the count.
    """
    for stripe in range(first, len(yz)):
        if 2 * (used + yz.shape[1]) > len(keys):
            return stripe, used
        t = base_T_sensor[stripe]
        last, slot = np.int64(-1), np.int64(0)
        x_sum, y_sum, z_sum, count = 0.0, 0.0, 0.0, 0.0
        for i in range(yz.shape[1]):
            a, b = yz[stripe, i, 0], yz[stripe, i, 1]
            if not (abs(a) < np.inf and abs(b) < np.inf):
                continue
            x = t[0, 1] * a + t[0, 2] * b + t[0, 3]
            y = t[1, 1] * a + t[1, 2] * b + t[1, 3]
            z = t[2, 1] * a + t[2, 2] * b + t[2, 3]
            # Shifted to be positive, a cast rounds down.
            key = (
                np.int64(x * per_m + half) << 42
                | np.int64(y * per_m + half) << 21
                | np.int64(z * per_m + half)
            )
            if key != last:  # neighbours on a stripe mostly share their voxel: one look-up for all of them
                if count > 0.0:
                    sums[slot, 0] += x_sum
                    sums[slot, 1] += y_sum
                    sums[slot, 2] += z_sum
                    sums[slot, 3] += count
                    x_sum, y_sum, z_sum, count = 0.0, 0.0, 0.0, 0.0
                slot, last = _slot(key, keys), key
                if keys[slot] == -1:
                    keys[slot] = key
                    used += 1
            x_sum += x
            y_sum += y
            z_sum += z
            count += 1.0
        if count > 0.0:
            sums[slot, 0] += x_sum
            sums[slot, 1] += y_sum
            sums[slot, 2] += z_sum
            sums[slot, 3] += count
    return len(yz), used


@numba.njit(cache=True)
def rehash(
    keys: NDArray[np.int64], sums: FloatArray, more_keys: NDArray[np.int64], more_sums: FloatArray
) -> None:
    """Moves a table into a larger, empty one."""
    for i in range(len(keys)):
        if keys[i] != -1:
            slot = _slot(keys[i], more_keys)
            more_keys[slot] = keys[i]
            more_sums[slot] = sums[i]
