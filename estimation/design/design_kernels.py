"""Compiled passes over all candidates; `passes.py` holds the same in numpy."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

_FAST: Final = {"reassoc", "contract", "nsz"}  # sums in any order, so that they use wide registers


@numba.njit(cache=True, fastmath=_FAST)
def absorb(rows: FloatArray, direction: FloatArray, factor: float, own: FloatArray) -> None:
    """own -= factor (rows @ direction)^2."""
    for i in range(rows.shape[0]):
        along = 0.0
        for j in range(rows.shape[1]):
            along += rows[i, j] * direction[j]
        own[i] -= factor * along * along


@numba.njit(cache=True, fastmath=_FAST)
def absorb_and_find(
    rows: FloatArray, direction: FloatArray, factor: float, own: FloatArray, open_: NDArray[np.bool_]
) -> int:
    """As `absorb`; returns the open candidate with the largest `own`, the first of equals."""
    best, largest = 0, -np.inf
    for i in range(rows.shape[0]):
        along = 0.0
        for j in range(rows.shape[1]):
            along += rows[i, j] * direction[j]
        own[i] -= factor * along * along
        if open_[i] and own[i] > largest:
            best, largest = i, own[i]
    return best
