"""Greedy choice by rank-one updates, then exchanges: a given number, or the fewest for a limit."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.design.criteria import SHARPNESS, WORST, Criterion
from estimation.design.gains import Gains
from estimation.design.problem import DesignProblem
from estimation.errors import EstimationError
from estimation.transform import FloatArray

IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

EXCHANGES: Final = 2  # passes over all choices; a third hardly ever changes one
_NEGLIGIBLE: Final = 1e-3  # weight of an axis that is not looked at
_REFRESH: Final = 256  # updates after which rounding is cleared


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chosen candidates, in the order of choice, and what they leave.

    Attributes
    ----------
    covariance : (n, n) of the state after them.
    value : of the criterion, a variance.
    curve : (c + 1,) the value after 0, 1, ... choices of the greedy pass, before exchanges.
    """

    chosen: IntArray  # (k,)
    covariance: FloatArray
    value: float
    curve: FloatArray

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def std(self) -> float:
        """Square root of the value: for "worst", the largest standard deviation of a judged quantity."""
        return float(np.sqrt(self.value))


def choose(
    problem: DesignProblem,
    count: int,
    criterion: Criterion = WORST,
    exchanges: int = EXCHANGES,
    group: IntArray | None = None,
    group_limit: int = 0,
) -> Selection:
    """The best `count` candidates that greedy choice and exchange find; the same input gives the same choice.

    Parameters
    ----------
    exchanges : passes in which each choice may be replaced by a better one.
    group, group_limit : (m,) group of each candidate, and how many of one group may be chosen (0: any).

    Raises
    ------
    EstimationError
        Fewer candidates than wanted.
    """
    if count > len(problem):
        raise EstimationError(
            f"{len(problem)} reachable measurements, {count} wanted", "Ask for fewer, or move the object"
        )
    state = _State(problem, criterion, _Groups(group, group_limit))
    curve = [state.value]
    for _ in range(count):
        state.add(state.best())
        curve.append(state.value)
    for _ in range(exchanges):
        if not state.exchange():
            break
    return state.selection(curve)


def fewest(
    problem: DesignProblem,
    target: float,
    criterion: Criterion = WORST,
    most: int | None = None,
    exchanges: int = EXCHANGES,
) -> Selection:
    """The fewest candidates found whose value is at most `target`, or the best `most` when these miss it.

    Greedy choice until the target is met; then one choice after the other is dropped, as long as exchanges
    make good what it took. `selection.value <= target` says whether the target is met.
    """
    state = _State(problem, criterion, _Groups(None, 0))
    most = len(problem) if most is None else min(most, len(problem))
    curve = [state.value]
    while state.value > target and len(state.chosen) < most:
        state.add(state.best())
        curve.append(state.value)
    if state.value > target:
        for _ in range(exchanges):
            if state.value <= target or not state.exchange():
                break
        return state.selection(curve)
    while len(state.chosen) > 1:
        before = list(state.chosen)
        state.drop_least()
        for _ in range(exchanges):
            if state.value <= target or not state.exchange(target):
                break
        if state.value > target:
            state.restore(before)
            break
    return state.selection(curve)


def worth(problem: DesignProblem, criterion: Criterion = WORST) -> FloatArray:
    """How much each candidate (m,) alone lowers the criterion, to first order; the largest is the next."""
    return _State(problem, criterion, _Groups(None, 0)).worth()


class _Groups:
    """How many of each group are chosen."""

    def __init__(self, group: IntArray | None, limit: int) -> None:
        self._group, self._limit = (group, limit) if limit else (None, 0)
        self._counts = np.zeros(0 if group is None else int(group.max(initial=-1)) + 1, dtype=np.intp)

    def add(self, candidate: int, sign: int) -> None:
        if self._group is not None:
            self._counts[self._group[candidate]] += sign

    def allowed(self, open_: BoolArray) -> BoolArray:
        if self._group is None:
            return open_
        within = open_ & (self._counts[self._group] < self._limit)
        return within if within.any() else open_


class _State:
    """What the chosen candidates leave: the white covariance C, and the gains of all."""

    def __init__(self, problem: DesignProblem, criterion: Criterion, groups: _Groups) -> None:
        self._problem, self._criterion, self._groups = problem, criterion, groups
        self._rows = problem.white_rows
        # The determinant of the whole state falls by 1 / (1 + s): no other quadratic form is needed.
        self._own_decides = criterion.name == "D" and problem.targets is None
        self._white = np.eye(self._rows.shape[1])
        self._gains = Gains(self._rows)
        self._updates = 0
        self.restore([])

    @property
    def value(self) -> float:
        return self._criterion.value(self._problem.judged(self._white))

    def restore(self, chosen: list[int]) -> None:
        """Start again from these, free of the rounding of many updates."""
        self.chosen = list(chosen)
        self._open = np.ones(len(self._rows), dtype=np.bool_)
        self._open[self.chosen] = False
        self._refresh()

    def add(self, candidate: int) -> None:
        self.chosen.append(candidate)
        self._groups.add(candidate, 1)
        self._open[candidate] = False
        self._update(candidate, 1.0)

    def remove(self, place: int) -> int:
        candidate = self.chosen.pop(place)
        self._groups.add(candidate, -1)
        self._open[candidate] = True
        self._update(candidate, -1.0)
        return candidate

    def best(self) -> int:
        """The open candidate that lowers the criterion most."""
        if self._own_decides:
            return self._gains.largest(self._groups.allowed(self._open))
        return int(np.argmax(np.where(self._groups.allowed(self._open), self.worth(), -1.0)))

    def exchange(self, target: float = 0.0) -> bool:
        """Replace each choice by the best candidate, where that is better; whether any was replaced."""
        changed = False
        for _ in range(len(self.chosen)):  # each goes to the end: after a pass, the order is as before
            if self._irreplaceable(self.chosen[0]):
                self.chosen.append(self.chosen.pop(0))
                continue
            before = self.value
            old = self.remove(0)
            new = self.best()
            self.add(new)
            if new != old and self.value > before * (1.0 - 1e-12):  # not better after all
                self.remove(len(self.chosen) - 1)
                self.add(old)
            elif new != old:
                changed = True
                if self.value <= target:
                    break
        return changed

    def _irreplaceable(self, candidate: int) -> bool:
        """Whether a choice is surely as good as any other candidate in its place.

        Without it, the gain s of another one is at most s / (1 - own), by Cauchy and Schwarz; its own is then
        own / (1 - own).
        """
        if not self._own_decides or not self._open.any():
            return False
        row = self._rows[candidate]
        best = self._gains.largest(self._open)
        return float(self._gains.of(best)) <= float(row @ self._white @ row)

    def drop_least(self) -> None:
        """Take back the choice that is missed least."""
        loss = self.worth(-1.0)[self.chosen]
        self.remove(int(np.argmin(loss)))

    def selection(self, curve: list[float]) -> Selection:
        """The result, computed afresh."""
        chosen = np.array(self.chosen, dtype=np.intp)
        white = self._problem.white_covariance(chosen=chosen)
        value = self._criterion.value(self._problem.judged(white))
        return Selection(chosen, self._problem.after(white), value, np.array(curve))

    def worth(self, sign: float = 1.0) -> FloatArray:
        """How much each candidate (m,) lowers the criterion when added, or raises it when taken away (-1)."""
        targets = self._problem.white_targets @ self._white
        values, axes = self._criterion.weight(self._problem.judged(self._white), SHARPNESS)
        kept = values > (0.0 if self._criterion.logarithmic else _NEGLIGIBLE) * values.max()
        # Rows of F: judged axes by the white state, as heavy as the criterion weighs them.
        factor = (axes.swapaxes(-1, -2) @ targets)[kept] * np.sqrt(values[kept])[:, None]
        along = self._rows @ factor.T
        return np.asarray(np.einsum("mk,mk->m", along, along) / (1.0 + sign * self._gains.exact()))

    def _update(self, candidate: int, sign: float) -> None:
        direction = self._white @ self._rows[candidate]
        factor = 1.0 / (sign + float(self._rows[candidate] @ direction))
        self._white = self._white - factor * np.outer(direction, direction)
        self._updates += 1
        if self._updates >= _REFRESH:
            self._refresh()
        else:
            self._gains.update(direction, factor)

    def _refresh(self) -> None:
        self._updates = 0
        chosen = np.array(self.chosen, dtype=np.intp)
        self._white = self._problem.white_covariance(chosen=chosen)
        self._gains.restart(self._white if len(chosen) else None)
