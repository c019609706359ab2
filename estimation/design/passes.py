"""One pass over all candidates for a rank-one update, compiled where numba is installed."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

try:
    from estimation.design import design_kernels as kernels
except ImportError:  # the extra `fast` is not installed: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

COMPILED: Final = kernels is not None


def absorb(rows: FloatArray, direction: FloatArray, factor: float, own: FloatArray) -> None:
    """Subtracts factor (rows @ direction)^2 from `own` (m,), in place; rows (m, r)."""
    if COMPILED:
        kernels.absorb(rows, direction, factor, own)
        return
    along = rows @ direction
    along *= along
    along *= factor
    own -= along


def absorb_and_find(
    rows: FloatArray, direction: FloatArray, factor: float, own: FloatArray, open_: NDArray[np.bool_]
) -> int:
    """As `absorb`; returns the open candidate with the largest `own`, the first of equals."""
    if COMPILED:
        return int(kernels.absorb_and_find(rows, direction, factor, own, open_))
    absorb(rows, direction, factor, own)
    return int(np.argmax(np.where(open_, own, -np.inf)))
