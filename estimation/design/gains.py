"""What each candidate could still add, b^T C b; compiled where numba is installed.

A choice makes every gain smaller. So an old gain is an upper bound, and only blocks of candidates with a
bound above the best that was found are brought up to date.

Source: Minoux (1978), Accelerated greedy algorithms for maximizing submodular set functions.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

try:
    from estimation.design import design_kernels as kernels
except ImportError:  # the extra `fast` is not installed: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

COMPILED: Final = kernels is not None
_PENDING: Final = 64  # updates after which everything is brought up to date
_BLOCK: Final = 512  # candidates; their numbers stay in the fastest cache


class Gains:
    """b^T C b of m candidates with white rows (m, r), for the covariance C (r, r) of the white state."""

    def __init__(self, rows: FloatArray) -> None:
        self._rows = rows
        self._columns = np.ascontiguousarray(rows.T)
        self._gain = np.zeros(len(rows))
        self._directions = np.zeros((_PENDING, rows.shape[1]))
        self._factors = np.zeros(_PENDING)
        self._pending = 0
        blocks = -(-len(rows) // _BLOCK)
        self._seen = np.zeros(blocks, dtype=np.int64)  # updates that a block has taken
        self._bounds = np.zeros(blocks)

    def restart(self, white: FloatArray | None) -> None:
        """From a covariance, free of the rounding of many updates; None is the prior's, the identity."""
        root = self._rows if white is None else self._rows @ np.linalg.cholesky(white)
        self._gain = np.einsum("mr,mr->m", root, root)
        self._seen[:] = 0
        self._pending = 0
        self._bounds[:] = np.inf

    def update(self, direction: FloatArray, factor: float) -> None:
        """C -= factor direction direction^T, where direction (r,) = C b of the candidate added or removed."""
        if self._pending == _PENDING:
            self.exact()
        self._directions[self._pending], self._factors[self._pending] = direction, factor
        self._pending += 1
        if factor < 0.0:
            self.exact()  # a removal makes gains larger: no old one is a bound any more

    def exact(self) -> FloatArray:
        """All gains (m,), up to date."""
        if self._pending:
            if COMPILED:
                kernels.settle(
                    self._columns,
                    self._directions,
                    self._factors,
                    self._pending,
                    _BLOCK,
                    self._seen,
                    self._gain,
                    self._bounds,
                )
            else:
                along = self._rows @ self._directions[: self._pending].T
                self._gain -= (along * along) @ self._factors[: self._pending]
            self._seen[:] = 0
            self._pending = 0
        return self._gain

    def of(self, candidate: int) -> float:
        """An upper bound; the gain itself where `largest` has just returned the candidate."""
        return float(self._gain[candidate])

    def largest(self, open_: NDArray[np.bool_]) -> int:
        """The open candidate with the largest gain, the first of equals; one at least is open (m,)."""
        if COMPILED:
            return int(
                kernels.largest(
                    self._columns,
                    self._directions,
                    self._factors,
                    self._pending,
                    _BLOCK,
                    self._seen,
                    self._gain,
                    self._bounds,
                    open_,
                )
            )
        return int(np.argmax(np.where(open_, self.exact(), -np.inf)))
