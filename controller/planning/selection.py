"""Which of many candidates to measure: greedy by rank-one updates of the covariance, then exchanges."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.errors import EstimationError
from estimation.transform import FloatArray

_SHARPNESS: Final = 4.0  # how much more the largest principal axes count than the smaller ones
_NEGLIGIBLE: Final = 1e-3  # weight of an axis that is not looked at


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chosen candidates, in the order of choice, and what they leave."""

    chosen: NDArray[np.intp]  # (k,)
    covariance: FloatArray  # (n, n) of the state after them
    largest_std_m: float  # of the gated points, along their worst axes
    curve_m: FloatArray  # (k + 1,) the largest std after each greedy choice, before exchanges


def largest_std(gates: FloatArray, covariance: FloatArray) -> float:
    """Square root of the largest eigenvalue of G P G^T over gated points; gates (g, 3, n)."""
    principal = np.linalg.eigvalsh(gates @ covariance @ gates.swapaxes(-1, -2))
    return float(np.sqrt(max(principal[..., -1].max(), 0.0)))


def select(
    covariance: FloatArray,
    rows: FloatArray,
    variance: FloatArray,
    gates: FloatArray,
    count: int,
    exchanges: int = 1,
    group: NDArray[np.intp] | None = None,
    group_limit: int = 0,
) -> Selection:
    """Choose `count` of m candidates so that the worst gated point becomes as certain as it can.

    Parameters
    ----------
    covariance : (n, n) of everything uncertain, shared errors as states: they do not average out.
    rows : (m, n) derivative of each candidate's residual by the state.
    variance : (m,) its independent noise, m^2.
    gates : (g, 3, n) derivative of the gated points by the state.
    exchanges : passes in which each choice may be replaced by a better one.
    group, group_limit : at most so many of one group, when a limit is given.

    Raises
    ------
    EstimationError
        Fewer candidates than wanted.

    Notes
    -----
    The reduction of v^T G P G^T v by a candidate h is (v^T G P h)^2 / (q + h^T P h), summed over the
    principal axes v of all gated points, weighted by their eigenvalues: nearly the worst axis, but smooth.
    """
    if count > len(rows):
        raise EstimationError(
            f"{len(rows)} reachable measurements, {count} wanted", "Ask for fewer, or move the object"
        )
    state = _State(covariance, rows, variance, gates)
    open_ = np.ones(len(rows), dtype=np.bool_)
    chosen: list[int] = []
    curve = [state.largest_std_m]
    counts = np.zeros(0 if group is None else int(group.max()) + 1, dtype=np.intp)
    for _ in range(count):
        best = state.best(_allowed(open_, group, counts, group_limit))
        state.take(best, 1.0)
        chosen.append(best)
        open_[best] = False
        if group is not None:
            counts[group[best]] += 1
        curve.append(state.largest_std_m)
    for _ in range(exchanges):
        for place, old in enumerate(chosen):
            state.take(old, -1.0)
            open_[old] = True
            if group is not None:
                counts[group[old]] -= 1
            new = state.best(_allowed(open_, group, counts, group_limit))
            state.take(new, 1.0)
            open_[new] = False
            if group is not None:
                counts[group[new]] += 1
            chosen[place] = new
    final = state.exact(chosen)
    return Selection(np.array(chosen, dtype=np.intp), final, largest_std(gates, final), np.array(curve))


def _allowed(
    open_: NDArray[np.bool_], group: NDArray[np.intp] | None, counts: NDArray[np.intp], limit: int
) -> NDArray[np.bool_]:
    if group is None or not limit:
        return open_
    within = open_ & (counts[group] < limit)
    return within if within.any() else open_


class _State:
    """P H^T, G P H^T, H P H^T and G P G^T, kept up to date by rank-one updates."""

    def __init__(
        self, covariance: FloatArray, rows: FloatArray, variance: FloatArray, gates: FloatArray
    ) -> None:
        self._prior, self._rows, self._variance = covariance, rows, variance
        self._cross = covariance @ rows.T  # (n, m)
        self._own = np.einsum("mn,nm->m", rows, self._cross)  # (m,) h^T P h
        self._gated = np.einsum("gin,nm->gim", gates, self._cross)  # (g, 3, m)
        self._gate_covariance = gates @ covariance @ gates.swapaxes(-1, -2)  # (g, 3, 3)

    @property
    def largest_std_m(self) -> float:
        return float(np.sqrt(max(np.linalg.eigvalsh(self._gate_covariance).max(), 0.0)))

    def best(self, allowed: NDArray[np.bool_]) -> int:
        values, axes = np.linalg.eigh(self._gate_covariance)
        values = np.maximum(values, 0.0)
        weights = (values / max(values.max(), 1e-300)) ** _SHARPNESS
        gain = np.zeros(len(self._variance))
        # einsum, not matmul: on such small arrays the threads of a BLAS cost more than the sum
        for gate, axis in zip(*np.nonzero(weights > _NEGLIGIBLE), strict=True):
            along = np.einsum("i,im->m", axes[gate, :, axis], self._gated[gate])
            gain += weights[gate, axis] * along**2
        gain /= self._variance + self._own
        return int(np.argmax(np.where(allowed, gain, -1.0)))

    def take(self, candidate: int, sign: float) -> None:
        """Add the candidate's information (+1) or take it away again (-1)."""
        column, gated = self._cross[:, candidate].copy(), self._gated[:, :, candidate].copy()
        factor = 1.0 / (sign * self._variance[candidate] + self._own[candidate])
        along = factor * np.einsum("mn,n->m", self._rows, column)
        self._cross -= column[:, None] * along
        self._gated -= gated[..., None] * along
        self._gate_covariance -= factor * gated[:, :, None] * gated[:, None, :]
        self._own -= along**2 / factor

    def exact(self, chosen: list[int]) -> FloatArray:
        """The covariance computed afresh, free of the rounding of many updates."""
        rows, variance = self._rows[chosen], self._variance[chosen]
        cross = self._prior @ rows.T
        gain = np.linalg.solve(rows @ cross + np.diag(variance), cross.T)
        return np.asarray(self._prior - cross @ gain)
