"""Localization: where the part lies, from laser points on its faces."""

from collections.abc import Sequence
from typing import Any

from controller.cellfile import job
from controller.faults import OutsideCause
from controller.knowledge import observations, part_corners_m, with_part
from controller.phases import findings
from controller.phases.base import Finding, PhaseContext, good
from controller.phases.one_by_one import OneByOne
from controller.planning import Prospect, plan_coarse_localize, plan_localize
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.belief import Belief
from estimation.measurement import Chain, object_point_jacobian
from estimation.solver import Update, update

OUTLIER_LEVEL = 0.001
FEWEST_COARSE = 6  # points without which the six freedoms of the part stay open
COARSE_NOTE = "coarse"


class LocalizePhase(OneByOne):
    """A few robust points to find the part, the planned ones, then the next best; all are fitted."""

    def plan(self, context: PhaseContext[job.LocalizePhase]) -> Sequence[Step]:
        prior = with_part(context.belief, context.cell)
        return plan_coarse_localize(context.cell, prior, context.arm, context.spec, context.seed).steps

    def more(
        self, context: PhaseContext[job.LocalizePhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Sequence[Step]:
        if any(step.note != COARSE_NOTE for step in steps):
            return super().more(context, steps, samples)
        return plan_localize(
            context.cell,
            self.found(context, steps, samples),
            context.arm,
            context.spec,
            context.seed,
        ).steps

    def found(
        self, context: PhaseContext[job.LocalizePhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Belief:
        """Where the coarse points say that the part is: for aiming only."""
        coarse = {step.id for step in steps if step.note == COARSE_NOTE}
        hits = good([sample for sample in samples if sample.step in coarse])
        if len(hits) < FEWEST_COARSE:
            raise OutsideCause(
                f"{len(hits)} of {len(coarse)} search points hit the part, at least {FEWEST_COARSE} must",
                "Put the part nearer to its nominal place, then Unsuspend",
            )
        prior = with_part(context.belief, context.cell)
        return update(
            prior,
            Chain(context.arm, observations(context.cell, hits)),
            phase="search",
            robust="huber",
            reject_level=OUTLIER_LEVEL,
        ).belief

    def evaluate(
        self, context: PhaseContext[job.LocalizePhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        fit = self._fit(context, good(samples))
        corners = part_corners_m(context.cell)
        names = [f"corner ({x * 1e3:.0f}, {y * 1e3:.0f}, {z * 1e3:.0f})" for x, y, z in corners]
        gated = findings.gated_points(object_point_jacobian(fit.belief, "part", corners), fit.belief, names)
        level = context.cell.job.test_level
        verdict = findings.uncertainty_verdict(fit, gated, context.spec.limit_m, "Part", level)
        verdict = self.judged(context, steps, fit.belief, verdict)
        faces = [f"part.{name}" for name in context.spec.faces]
        estimate: dict[str, Any] = {
            "pose": findings.pose_dict(fit.belief.transform("part")),
            "values": findings.block_values(fit.belief, ["part", *faces]),
            "gated": gated,
            "limit_m": context.spec.limit_m,
            "fit": findings.fit_summary(fit),
        }
        return Finding(verdict, fit.belief, estimate)

    def known(self, context: PhaseContext[job.LocalizePhase], samples: Sequence[Sample]) -> Belief:
        if not samples:
            return with_part(context.belief, context.cell)
        return self._fit(context, samples).belief

    @staticmethod
    def _fit(context: PhaseContext[job.LocalizePhase], samples: Sequence[Sample]) -> Update:
        return update(
            with_part(context.belief, context.cell),
            Chain(context.arm, observations(context.cell, samples)),
            targets=("part",),
            phase="localize",
            robust="huber",
            reject_level=OUTLIER_LEVEL,
        )

    def prospect(self, context: PhaseContext[job.LocalizePhase], belief: Belief, seed: int) -> Prospect:
        return Prospect.of_part(context.cell, belief, context.arm, context.spec, seed)

    def counted(self, steps: Sequence[Step]) -> int:
        """The coarse points come on top of the budget."""
        return sum(step.note != COARSE_NOTE for step in steps)
