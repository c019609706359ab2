"""Inspection: stylus qualified on its sphere, features touched, characteristics judged by ISO 14253-1."""

from collections.abc import Sequence
from itertools import count
from typing import Any

import numpy as np

from controller.cellfile import Cell, job
from controller.cellfile.objects import Characteristic, Flatness
from controller.gates import Proof, Verdict, worst
from controller.knowledge import observations, part_features, with_inspected, with_probe
from controller.phases import findings
from controller.phases.base import Finding, OnePlan, PhaseContext, good
from controller.phases.characteristics import decision, measured, measured_flatness, table_row
from controller.planning import more_inspect, plan_inspect
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.belief import Belief
from estimation.errors import Unreachable
from estimation.measurement import Chain
from estimation.solver import update
from estimation.statistics import Outcome

OUTLIER_LEVEL = 0.001


class InspectPhase(OnePlan):
    """Touches on the stylus sphere and on the tolerated features; all in one estimate."""

    def plan(self, context: PhaseContext[job.InspectPhase]) -> Sequence[Step]:
        prior = with_inspected(with_probe(context.belief, context.cell), context.cell)
        return plan_inspect(context.cell, prior, context.arm, context.spec, context.seed).steps

    def evaluate(
        self, context: PhaseContext[job.InspectPhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        cell = context.cell
        prior = with_probe(context.belief, cell)
        touches = good(samples, "touch")
        qualified = update(
            prior,
            Chain(
                context.arm, observations(cell, [sample for sample in touches if sample.object == "sphere"])
            ),
            targets=("probe", "sphere"),
            phase="stylus",
        )
        fit = update(
            with_inspected(prior, cell, u_m=np.inf),  # no wish enters the verdict
            Chain(context.arm, observations(cell, touches)),
            targets=_inspected(cell),
            phase="touch",
            reject_level=OUTLIER_LEVEL,
        )
        table = []
        for item in cell.part.characteristics:
            own = [touch for touch in touches if touch.object == "part" and touch.feature == item.feature]
            found = (
                measured_flatness(cell, context.arm, qualified.belief, own)
                if isinstance(item, Flatness)
                else measured(cell, item, fit.belief)
            )
            table.append(table_row(cell, item, found, len(own)))
        consistent = (
            findings.consistency_proof(qualified, cell.job.test_level, "stylus: "),
            findings.consistency_proof(fit, cell.job.test_level, "touches: "),
        )
        proofs = (
            *consistent,
            *(
                Proof(
                    row["id"],
                    row["deviation_m"] * 1e3,
                    row["limit_m"] * 1e3,
                    "mm",
                    Outcome(row["outcome"]),
                    row["text"],
                )
                for row in table
            ),
        )
        outcome = worst(proof.outcome for proof in proofs)
        curable = all(proof.outcome is Outcome.OK for proof in consistent)
        conforming = sum(row["outcome"] == Outcome.OK.value for row in table)
        verdict = Verdict(
            proofs,
            f"{conforming} of {len(table)} characteristics conform"
            if outcome is Outcome.OK
            else findings.message(proofs, ""),
            "" if outcome is Outcome.OK else "See the inspection table of the report",
            curable,
        )
        estimate: dict[str, Any] = {
            "characteristics": table,
            "values": findings.block_values(
                fit.belief, ["probe", "probe.radius", "sphere", "part", *_inspected(cell)]
            ),
            "stylus": {
                "radius_m": fit.belief.scalar("probe.radius"),
                "u_m": float(fit.belief.std("probe.radius")[0]),
            },
            "fit": findings.fit_summary(fit),
            "decision_rule": cell.job.decision_rule,
            "conformance_probability": cell.job.conformance_probability,
        }
        return Finding(verdict, fit.belief, estimate)

    def extend(
        self,
        context: PhaseContext[job.InspectPhase],
        steps: Sequence[Step],
        samples: Sequence[Sample],
        finding: Finding,
    ) -> Sequence[Step]:
        """The fewest rounds of touches that can decide a characteristic, if its value stays where it is."""
        cell = context.cell
        belief = finding.belief
        undecided = [item for item in cell.part.characteristics if _is_open(cell, item, belief)]
        names = {name for item in undecided for name in (item.feature, *getattr(item, "datums", ()))}
        for rounds in count(1) if undecided else ():
            try:
                plan = more_inspect(cell, belief, context.arm, steps, names, rounds)
            except Unreachable:  # no room for more
                return ()
            if len(steps) + len(plan.steps) > context.spec.most_measurements:
                return ()
            if plan.belief and not all(_is_open(cell, item, plan.belief) for item in undecided):
                return plan.steps
        return ()


def _is_open(cell: Cell, item: Characteristic, belief: Belief) -> bool:
    """A diameter or position that this belief can neither accept nor refuse."""
    if isinstance(item, Flatness):
        return False
    return decision(cell, item, measured(cell, item, belief)).outcome is Outcome.NOT_DECIDABLE


def _inspected(cell: Cell) -> tuple[str, ...]:
    return tuple(f"part.{feature.name}" for feature in part_features(cell) if feature.kind == "cylinder")
