"""Phases that go on one measurement after the other once their plan is taken, until it is enough."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from controller.gates import Verdict
from controller.knowledge import observations
from controller.phases import findings
from controller.phases.base import Finding, OnePlan, PhaseContext, good
from controller.planning import Prospect
from controller.planning.online import ADDED_NOTE, ROUND
from controller.planning.plan import MARGIN
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.belief import Belief

GIVE_UP: Final = 5  # added measurements in a row that see nothing


@dataclass(frozen=True, slots=True, eq=False)
class _Recent:
    """The prospect of this round; the key is all that it follows from, so that keeping it changes nothing."""

    key: tuple[object, ...]
    prospect: Prospect


class OneByOne(OnePlan):
    """After the planned steps: the next best measurement, while U is not below the limit by a margin.

    A measurement that saw nothing is made good by the next ones, as what it should have told is still open.
    """

    def __init__(self) -> None:
        self._recent: _Recent | None = None

    # What a kind of phase says of itself

    def known(self, context: PhaseContext[Any], samples: Sequence[Sample]) -> Belief:
        """What the samples, all good, have told so far; without any, what was known before."""
        raise NotImplementedError

    def prospect(self, context: PhaseContext[Any], belief: Belief, seed: int) -> Prospect:
        """What may be measured next, as seen from a belief."""
        raise NotImplementedError

    def counted(self, steps: Sequence[Step]) -> int:
        """How many of the steps count against the budget of the phase."""
        return len(steps)

    # What the job asks

    def more(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Sequence[Step]:
        """The next step once `extend` has begun; none when U is well below the limit, or never can be."""
        left = context.spec.most_measurements - self.counted(steps)
        if not steps or steps[-1].note != ADDED_NOTE or left <= 0:
            return ()
        prospect, fresh = self._round(context, steps, samples)
        taken = observations(context.cell, fresh)
        if prospect.U_m(taken) <= (1.0 - MARGIN) * context.spec.limit_m:
            return ()
        if not fresh and not prospect.best(left).may_meet(context.spec.limit_m):
            return ()
        return self._next(context, steps, samples)

    def extend(
        self,
        context: PhaseContext[Any],
        steps: Sequence[Step],
        samples: Sequence[Sample],
        finding: Finding,
    ) -> Sequence[Step]:
        """The next step, whatever was predicted: the gate did not pass."""
        return self._next(context, steps, samples)

    def judged(
        self,
        context: PhaseContext[Any],
        steps: Sequence[Step],
        belief: Belief,
        verdict: Verdict,
    ) -> Verdict:
        """The verdict; one that more measurements could cure, but not enough of them, says so."""
        left = context.spec.most_measurements - self.counted(steps)
        if verdict.passed or not verdict.curable or left <= 0:
            return verdict
        best = self.prospect(context, belief, context.seed + len(steps)).best(left)
        if best.may_meet(context.spec.limit_m):
            return verdict
        return findings.out_of_reach(verdict, best, context.spec.limit_m, left)

    def _next(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Sequence[Step]:
        hits = {sample.step for sample in good(samples)}
        last = [step for step in steps if step.note == ADDED_NOTE][-GIVE_UP:]
        nothing = len(last) == GIVE_UP and not any(step.id in hits for step in last)
        if nothing or context.spec.most_measurements <= self.counted(steps):
            return ()
        prospect, fresh = self._round(context, steps, samples)
        missed = [step for step in steps if step.id not in hits]
        step = prospect.next_step(observations(context.cell, fresh), steps, missed)
        return () if step is None else (step,)

    def _round(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> tuple[Prospect, list[Sample]]:
        """Candidates around what was known at the last full round, and the good samples since."""
        count = len(steps) // ROUND * ROUND
        before = {step.id for step in steps[:count]}
        base = tuple(sample for sample in good(samples) if sample.step in before)
        key = (context.cell.digest, context.spec.name, context.seed, count, base)
        if self._recent is None or self._recent.key != key:
            belief = self.known(context, base)
            self._recent = _Recent(key, self.prospect(context, belief, context.seed + count))
        return self._recent.prospect, [s for s in good(samples) if s.step not in before]
