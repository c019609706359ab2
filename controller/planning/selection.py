"""Which of many candidates to measure: greedy by rank-one updates of the covariance, then exchanges."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.errors import EstimationError
from estimation.transform import FloatArray

_SHARPNESS: Final = 4.0  # how much more the largest principal axes count than the smaller ones


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
    curve = [largest_std(gates, state.covariance)]
    counts = np.zeros(0 if group is None else int(group.max()) + 1, dtype=np.intp)
    for _ in range(count):
        best = state.best(_allowed(open_, group, counts, group_limit))
        state.take(best, 1.0)
        chosen.append(best)
        open_[best] = False
        if group is not None:
            counts[group[best]] += 1
        curve.append(largest_std(gates, state.covariance))
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
    """Covariance P, and what of P H^T and H P H^T the choice needs, kept up to date by rank-one updates."""

    def __init__(
        self, covariance: FloatArray, rows: FloatArray, variance: FloatArray, gates: FloatArray
    ) -> None:
        self._prior = self.covariance = covariance
        self._rows, self._variance, self._gates = rows, variance, gates
        self._cross = covariance @ rows.T  # (n, m)
        self._own = np.einsum("mn,nm->m", rows, self._cross)  # h^T P h

    def best(self, allowed: NDArray[np.bool_]) -> int:
        values, axes = np.linalg.eigh(self._gates @ self.covariance @ self._gates.swapaxes(-1, -2))
        values = np.maximum(values, 0.0)
        weights = (values / max(values.max(), 1e-300)) ** _SHARPNESS
        directions = np.einsum("gia,gin->gan", axes, self._gates) * np.sqrt(weights)[..., None]
        gain = ((directions.reshape(-1, directions.shape[-1]) @ self._cross) ** 2).sum(axis=0)
        gain /= self._variance + self._own
        return int(np.argmax(np.where(allowed, gain, -1.0)))

    def take(self, candidate: int, sign: float) -> None:
        """Add the candidate's information (+1) or take it away again (-1)."""
        column = self._cross[:, candidate]
        factor = 1.0 / (sign * self._variance[candidate] + self._own[candidate])
        along = self._rows @ column
        self.covariance = self.covariance - factor * np.outer(column, column)
        self._cross = self._cross - factor * np.outer(column, along)
        self._own = self._own - factor * along**2

    def exact(self, chosen: list[int]) -> FloatArray:
        """The covariance computed afresh, free of the rounding of many updates."""
        rows, variance = self._rows[chosen], self._variance[chosen]
        cross = self._prior @ rows.T
        gain = np.linalg.solve(rows @ cross + np.diag(variance), cross.T)
        return self._prior - cross @ gain
