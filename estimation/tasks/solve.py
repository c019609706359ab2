"""From a Problem to a Result: checks, starts, the same non-linear estimate for all, diagnosis."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from estimation.belief import Belief, Value
from estimation.chart import Chart
from estimation.errors import ContradictingData, DegenerateGeometry, EstimationError
from estimation.fitting import (
    LARGEST_REJECTED_SHARE,
    cauchy_cost,
    reweighted,
    robust_start,
    row_variance,
)
from estimation.model import Model, values_of
from estimation.numbered import numbered
from estimation.observability import RANK_TOLERANCE, RankReport
from estimation.solver import Update, update
from estimation.tasks.explanations import explained
from estimation.tasks.findings import Cause, Finding, Status, TaskRefused
from estimation.transform import FloatArray, Transform, log_pose

AMBIGUOUS_RATIO: Final = 10.0  # of the costs of two solutions, below which neither is preferred
OUTLIER_LEVEL: Final = 1e-3  # probability that an honest batch loses a measurement
CONSISTENCY_LEVEL: Final = 1e-3  # probability that honest residuals are called inconsistent
_DECISIVE: Final = 100.0  # chi-square against a second solution: ten standard deviations
_COARSE: Final = 1e-2  # standard deviations: tolerance of a descent that only ranks its start
_FEW_REJECTED: Final = 0.05  # share of rows that may contradict an explanation that all others confirm
_MORE_DESCENTS: Final = 3
_SAME_SIGMAS: Final = 30.0  # two minima closer than this many standard deviations are one


class Problem(Protocol):
    """One calibration task with its data. All lengths in m, angles in rad."""

    @property
    def task(self) -> str:
        """Name in the registry."""

    @property
    def consider(self) -> tuple[str, ...]:
        """Shared errors that are carried but not updated, by name of their block."""

    def check(self) -> Sequence[Finding]:
        """What is wrong with the data at sight, before anything is computed from them."""

    def belief(self) -> Belief:
        """Flat blocks to estimate, and priors of all that they depend on."""

    def rough(self) -> Belief:
        """The belief to compare starts with; errors of many unknowns that readings share may be missing."""

    def model(self) -> Model:
        """The measurements."""

    def starts(self) -> Sequence[Mapping[str, Value]]:
        """Values of flat blocks to start from, most promising first."""

    def settled(self, values: Mapping[str, Value]) -> Mapping[str, Value]:
        """The same solution with what changes nothing, such as spin about a beam, fixed by rule."""

    def explanations(self) -> Iterable[tuple[Finding, "Problem"]]:
        """Mistakes that people make with such data, and the same problem with each undone."""

    def diagnose(self, values: Mapping[str, Value], rejected: NDArray[np.bool_] | None) -> Sequence[Finding]:
        """About the values that fit best: why data leave something open (None), or what was rejected."""


@dataclass(frozen=True, slots=True)
class Ambiguity:
    """A second solution: `ratio` of its cost to that of the first, and its values.

    `gap` is by how much chi-square speaks against it, where many measurements tell; it is reported all the
    same, because both fit to a fraction of what form and noise may be.
    """

    ratio: float
    values: Mapping[str, Value]
    gap: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a task found. A refused task has findings and no values.

    Attributes
    ----------
    estimate : posterior of all blocks with budget and diagnostics; None when refused.
    initial : the belief before; with the posterior it gives sensitivities.
    findings : why a result is refused or flagged.
    shown : blocks that people ask for: all but the errors of single poses.
    ambiguity : the next best minimum that was found, if any.
    """

    task: str
    status: Status
    findings: tuple[Finding, ...]
    estimate: Update | None = None
    initial: Belief | None = None
    shown: tuple[str, ...] = ()
    ambiguity: Ambiguity | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """What people must know beside the values, a sentence each."""
        return tuple(str(finding) for finding in self.findings)

    @property
    def update(self) -> Update:
        """The estimate; raises TaskRefused when there is none."""
        if self.estimate is None:
            causes = "; ".join(str(finding).rstrip(".") for finding in self.findings)
            raise TaskRefused(f"{self.task} was refused: {causes}", "Mend the data, then estimate again")
        return self.estimate

    @property
    def belief(self) -> Belief:
        """Posterior: values, covariance and budget of everything."""
        return self.update.belief

    @property
    def values(self) -> dict[str, Value]:
        """Value of each block; empty when refused."""
        return {} if self.estimate is None else {b.name: b.value for b in self.estimate.belief.blocks}

    def covariance(self, name: str) -> FloatArray:
        """Covariance (k, k) of the freedoms of a block; a pose is form A, [t; phi], m and rad."""
        return self.belief.block_covariance(name)

    def budget(self, name: str) -> dict[str, FloatArray]:
        """Variance (k,) of the freedoms of a block by source; they add up to the covariance's diagonal."""
        place = self.belief.index(name)
        return {source: np.diag(matrix)[place] for source, matrix in self.belief.contributions.items()}

    @property
    def chi2(self) -> float:
        """Minimum of the joint cost, against the full covariance."""
        return self.update.chi2

    @property
    def dof(self) -> int:
        """Rows + prior rows - unknowns."""
        return self.update.dof

    @property
    def rank(self) -> RankReport | None:
        """Rank of the flat blocks on the data alone."""
        return self.update.rank

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(m,) rows that the outlier gate left out."""
        return self.update.rejected

    def sensitivity(self, name: str, source: str) -> FloatArray:
        """L (k, s) = d(estimate of block `name`) / d(shared error `source`), so that cov = L P_source.

        For the next phase that sees the same error: P_source is the prior of that block.
        """
        if self.initial is None:
            raise TaskRefused(f"{self.task} was refused", "Mend the data, then estimate again")
        place = self.initial.index(source)
        prior = self.initial.prior_covariance[place, place]
        cross = self.belief.covariance[self.belief.index(name), self.belief.index(source)]
        return np.asarray(cross @ np.linalg.pinv(prior, hermitian=True))


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where a start rolled to: cost, and values of the flat blocks."""

    cost: float
    values: Mapping[str, Value]


def solve(problem: Problem, explain: bool = True) -> Result:
    """Estimate; never raises for bad data, which come back refused or flagged with their cause.

    With `explain`, data that fit badly are tried again with common mistakes undone: if one of them
    makes the residuals what they should be, it is named.
    """
    sight = tuple(problem.check())
    if any(finding.refuses for finding in sight):
        return refused(problem.task, sight)
    try:
        starts = problem.starts()
    except EstimationError as error:
        return refused(problem.task, sight, error)
    result = _estimated(problem, sight, starts)
    if explain and misfits(result):
        mistake = explained(problem, _holds)
        if mistake is not None:
            return refused(problem.task, (*sight, mistake))
    return result


def _holds(problem: Problem) -> bool:
    """Whether nearly all the data of a problem agree."""
    return agrees(_estimated(problem, (), problem.starts()))


def agrees(result: Result) -> bool:
    """Whether nearly all the data say the same."""
    return (
        result.estimate is not None and not misfits(result) and float(result.rejected.mean()) <= _FEW_REJECTED
    )


def misfits(result: Result) -> bool:
    """Whether residuals may speak against the data, and not only the geometry."""
    return any(
        finding.cause in (Cause.INCONSISTENT, Cause.CLUSTERED_OUTLIERS, Cause.NO_SOLUTION, Cause.UNDETERMINED)
        for finding in result.findings
    )


def _estimated(problem: Problem, sight: tuple[Finding, ...], starts: Sequence[Mapping[str, Value]]) -> Result:
    try:
        belief, model = problem.belief(), problem.model()
        minima, reason = ranked(problem, model, starts)
    except EstimationError as error:
        return refused(problem.task, sight, error)
    if not minima:
        return refused(problem.task, sight, reason)
    start = belief.started(minima[0].values)
    try:
        found = estimated(start, model, problem.consider)
    except DegenerateGeometry as error:
        share = _contradicting(start, model)
        if share > LARGEST_REJECTED_SHARE:  # they drove it to where nothing is determined
            return refused(problem.task, sight, _contradictory(share))
        seen = tuple(problem.diagnose(values_of(start), None))
        return refused(problem.task, (*sight, *seen), error)
    except EstimationError as error:
        return refused(problem.task, sight, error)
    findings = list(sight)
    if found.rejected.any():
        findings += problem.diagnose(values_of(found.belief), found.rejected)
    if len(minima) > 1:  # what was left out must not decide between solutions
        again = [minimum.values for minimum in minima]
        minima = descents(problem, model, again, ~found.rejected)[0] or minima
    ambiguity = None
    for other in minima[1:]:
        if apart(found.belief, minima[0].values, other.values):
            ratio = other.cost / max(minima[0].cost, float(np.finfo(float).tiny))
            ambiguity = Ambiguity(ratio, other.values)
            break
    return judged(problem.task, found, belief, findings, problem.rough().names, ambiguity)


def _contradicting(belief: Belief, model: Model) -> float:
    """Share of the rows whose residuals at the values of the belief honest noise does not reach."""
    values = values_of(belief)
    rows = model.weighed_at(values).rows(values)
    limit = chdtri(1, OUTLIER_LEVEL / len(rows.residual_m))
    return float(np.mean(rows.residual_m**2 > limit * row_variance(rows)))


def _contradictory(share: float) -> ContradictingData:
    return ContradictingData(
        f"{share:.0%} of the rows contradict the best solution that was found, limit "
        f"{LARGEST_REJECTED_SHARE:.0%}",
        "Look for a moved object, a wrong feature or a loose sensor, then measure again",
    )


def estimated(
    start: Belief, model: Model, consider: Sequence[str], rank_tolerance: float = RANK_TOLERANCE
) -> Update:
    """The estimate of every task, from values that are near enough; raises as `update` does."""
    return update(
        start,
        model,
        consider=consider,
        robust="cauchy",
        reject_level=OUTLIER_LEVEL,
        tolerance=1e-6,
        rank_tolerance=rank_tolerance,
    )


def judged(
    task: str,
    found: Update,
    initial: Belief,
    findings: Sequence[Finding],
    shown: tuple[str, ...],
    ambiguity: Ambiguity | None,
) -> Result:
    """The result of an estimate, with what its residuals and a second solution say beside `findings`."""
    findings = [*findings, *_diagnosed(found)]
    if ambiguity is not None and ambiguity.ratio < AMBIGUOUS_RATIO:
        findings.append(_ambiguous(ambiguity))
    if any(finding.refuses for finding in findings):
        return Result(task, Status.REFUSED, tuple(findings), ambiguity=ambiguity)
    status = Status.FLAGGED if findings else Status.OK
    return Result(task, status, tuple(findings), found, initial, shown, ambiguity)


def refused(task: str, findings: Sequence[Finding], error: EstimationError | None = None) -> Result:
    """The result of data that were refused at sight, or of an estimate that came to nothing."""
    match error:
        case None:
            return Result(task, Status.REFUSED, tuple(findings))
        case DegenerateGeometry():
            cause = Cause.UNDETERMINED
        case ContradictingData():
            cause = Cause.CLUSTERED_OUTLIERS
        case _:
            cause = Cause.NO_SOLUTION
    return Result(task, Status.REFUSED, (*findings, Finding(cause, error.problem, error.remedy)))


def ranked(
    problem: Problem, model: Model, starts: Sequence[Mapping[str, Value]]
) -> tuple[list[Minimum], EstimationError]:
    """Where the starts roll to, outliers weighing less, lowest cost first; why the last that failed did."""
    found: list[Minimum] = []
    reason = EstimationError("No start was found", "Measure from more and other directions")
    belief = problem.rough()
    for values in starts:
        chart = Chart(belief.started(values), model)
        try:
            z = robust_start(chart, np.zeros(belief.size), "cauchy")
            cost = cauchy_cost(chart, z)
        except EstimationError as error:
            reason = error
            continue
        reached = chart.at(z)[0]
        found.append(Minimum(cost, problem.settled({name: reached[name] for name in values})))
    return sorted(found, key=lambda minimum: minimum.cost), reason


def descents(
    problem: Problem, model: Model, starts: Sequence[Mapping[str, Value]], used: NDArray[np.bool_]
) -> tuple[list[Minimum], EstimationError]:
    """Where the starts roll to on the rows `used` (m,), lowest cost first; why the last that failed did."""
    found: list[Minimum] = []
    reason = EstimationError("No start was found", "Measure from more and other directions")
    belief, lowest = problem.rough(), np.inf
    for values in starts:
        chart = Chart(belief.started(values), model)
        try:
            fit = reweighted(chart, np.zeros(belief.size), used, _COARSE)
            # One that is still on its way may be the same as another, and must not count as a second.
            for _ in range(_MORE_DESCENTS):
                if fit.converged or fit.costs[-1][-1] > AMBIGUOUS_RATIO * lowest:
                    break
                fit = reweighted(chart, fit.z, used, _COARSE)
        except EstimationError as error:
            reason = error
            continue
        reached = chart.at(fit.z)[0]
        settled = problem.settled({name: reached[name] for name in values})
        found.append(Minimum(fit.costs[-1][-1], settled))
        lowest = min(lowest, found[-1].cost)
    return sorted(found, key=lambda minimum: minimum.cost), reason


def apart(posterior: Belief, one: Mapping[str, Value], other: Mapping[str, Value]) -> bool:
    """Whether two minima are two solutions, and not the same one less far converged."""
    for name, there in other.items():
        here, std = one[name], posterior.std(name)
        if isinstance(here, Transform) and isinstance(there, Transform):
            gap = log_pose(here.inverse().matrix @ there.matrix)[posterior.block(name).active]
        else:
            gap = np.asarray(there) - np.asarray(here)
        if np.abs(gap / np.maximum(std, 1e-12)).max() > _SAME_SIGMAS and np.abs(gap).max() > 1e-6:
            return True
    return False


def _diagnosed(found: Update) -> list[Finding]:
    findings = []
    if found.rejected.any():
        worst = float(np.abs(found.standardised[found.rejected]).max())
        left_out = np.flatnonzero(found.rejected.reshape(-1, found.group)[:, 0])
        count = len(found.rejected) // found.group
        findings.append(
            Finding(
                Cause.OUTLIER,
                f"{len(left_out)} of {count} measurements contradict the others by up to "
                f"{worst:.0f} standard deviations and were left out: number {numbered(left_out)}",
                "Look at these measurements; measure them again",
                refuses=False,
            )
        )
    if found.dof > 0 and not found.consistency(CONSISTENCY_LEVEL).passed:
        test = found.consistency(CONSISTENCY_LEVEL)
        large = found.chi2 > test.upper
        findings.append(
            Finding(
                Cause.INCONSISTENT,
                f"Residuals are {'larger' if large else 'smaller'} than declared: chi2 {found.chi2:.3g}, "
                f"honest data keep {test.lower:.3g} to {test.upper:.3g}",
                "Check the declared noise, and that every reading belongs to its pose and surface",
                refuses=large and found.variance_factor > 10.0,
            )
        )
    return findings


def _ambiguous(second: Ambiguity) -> Finding:
    return Finding(
        Cause.AMBIGUOUS,
        f"Two solutions fit: the second costs {second.ratio:.2g} times the first, limit {AMBIGUOUS_RATIO:g}",
        "Measure where the two differ, or give a prior for what is known",
        refuses=second.gap < _DECISIVE,
    )
