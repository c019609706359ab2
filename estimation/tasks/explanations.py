"""Which common mistake explains data that do not fit: undone, their residuals are what was declared."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, Protocol, Self, TypeVar

import numpy as np

from estimation.belief import Belief, Value
from estimation.errors import EstimationError
from estimation.fitting import row_variance
from estimation.model import Model, values_of
from estimation.tasks.findings import Finding

_MOST: Final = 3  # explanations that are estimated in full, and the best of each other cause
_MEDIAN_SQUARE: Final = 0.455  # of a standard normal variable


class Explainable(Protocol):
    """What of a problem tells mistakes apart; see `solve.Problem`."""

    def check(self) -> Sequence[Finding]:
        """What is wrong with the data at sight."""

    def rough(self) -> Belief:
        """The belief to compare starts with."""

    def model(self) -> Model:
        """The measurements."""

    def starts(self) -> Sequence[Mapping[str, Value]]:
        """Values of flat blocks to start from, most promising first."""

    def explanations(self) -> Iterable[tuple[Finding, Self]]:
        """Mistakes that people make with such data, and the same problem with each undone."""


P = TypeVar("P", bound=Explainable)


def explained(problem: P, holds: Callable[[P], bool]) -> Finding | None:
    """The mistake that, undone, makes the data hold; None if there is none.

    All mistakes that the problem knows of are compared at their starts, which is cheap. The least surprising
    and one of each other cause are tried in full; that they hold is the proof. A start says little more: two
    markers of many that were exchanged leave the median as it is.
    """
    found = [
        (_surprise(other), finding, other)
        for finding, other in problem.explanations()
        if not any(each.refuses for each in other.check())
    ]
    found = sorted((each for each in found if np.isfinite(each[0])), key=lambda each: each[0])
    tried = found[:_MOST]  # a scale that shrinks the data shrinks their residuals, and would push others out
    for each in found[_MOST:]:
        if all(each[1].cause is not other[1].cause for other in tried):
            tried.append(each)
    return next((finding for _, finding, other in tried if holds(other)), None)


def _surprise(problem: Explainable) -> float:
    """How far residuals are from the declared noise at the most promising start; infinite without one.

    |ln| of the median of their squares over what it is for honest ones: a median, so that a few outliers do
    not hide that all others fit, and both ways, because data that are taken for too small always fit.
    """
    try:
        starts = problem.starts()
        if not starts:
            return np.inf
        values = {**values_of(problem.rough()), **starts[0]}
        rows = problem.model().weighed_at(values).rows(values)
    except EstimationError:
        return np.inf
    median = float(np.median(rows.residual_m**2 / row_variance(rows)))
    return float(abs(np.log(median / _MEDIAN_SQUARE))) if np.isfinite(median) and median > 0.0 else np.inf
