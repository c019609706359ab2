"""Compiled passes over all candidates; `gains.py` holds the same in numpy."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

_FAST: Final = {"reassoc", "contract", "nsz"}  # sums in any order, so that they use wide registers


@numba.njit(cache=True, fastmath=_FAST)
def settle_block(
    columns: FloatArray,
    directions: FloatArray,
    factors: FloatArray,
    begin: int,
    end: int,
    first: int,
    last: int,
    gain: FloatArray,
) -> None:
    """Brings the gains from `first` to `last` up to date with the updates from `begin` to `end`.

    Each takes factor (row . direction)^2 off. `columns` (r, m) are the rows of the candidates, transposed:
    the inner loops run over candidates.
    """
    along, mine = np.empty(last - first), gain[first:last]  # slices, so that the loops become wide
    for k in range(begin, end):
        along[:] = 0.0
        for j in range(columns.shape[0]):
            amount, column = directions[k, j], columns[j, first:last]
            for i in range(along.shape[0]):
                along[i] += column[i] * amount
        for i in range(along.shape[0]):
            mine[i] -= factors[k] * along[i] * along[i]


@numba.njit(cache=True, fastmath=_FAST)
def settle(
    columns: FloatArray,
    directions: FloatArray,
    factors: FloatArray,
    end: int,
    size: int,
    seen: NDArray[np.int64],
    gain: FloatArray,
    bounds: FloatArray,
) -> None:
    """Brings gains (m,) and bounds (b,) of all blocks of `size` up to date with the first `end` updates."""
    for block in range(seen.shape[0]):
        first, last = block * size, min((block + 1) * size, gain.shape[0])
        settle_block(columns, directions, factors, seen[block], end, first, last, gain)
        bounds[block] = gain[first:last].max()


@numba.njit(cache=True, fastmath=_FAST)
def largest(
    columns: FloatArray,
    directions: FloatArray,
    factors: FloatArray,
    end: int,
    size: int,
    seen: NDArray[np.int64],
    gain: FloatArray,
    bounds: FloatArray,
    open_: NDArray[np.bool_],
) -> int:
    """The open candidate with the largest gain, the first of equals.

    `bounds` (b,) are upper bounds of the gains in each block; the most promising block comes first.
    """
    best, most = -1, -np.inf
    for block in np.argsort(-bounds):
        if bounds[block] < most:
            break
        first, last = block * size, min((block + 1) * size, gain.shape[0])
        settle_block(columns, directions, factors, seen[block], end, first, last, gain)
        seen[block] = end
        top = gain[first:last].max()
        bounds[block] = top
        if top >= most:
            for i in range(first, last):
                if open_[i] and (gain[i] > most or (gain[i] == most and i < best)):
                    best, most = i, gain[i]
    return best
