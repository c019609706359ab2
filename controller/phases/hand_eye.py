"""Hand-eye: where the laser sits on the flange, from the plate, jointly with the kinematic parameters."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from controller.cellfile import job
from controller.knowledge import observations, with_plate
from controller.phases import findings
from controller.phases.base import Finding, PhaseContext, good
from controller.phases.one_by_one import OneByOne
from controller.planning import Prospect, plan_hand_eye
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.belief import Belief
from estimation.measurement import Chain, point_jacobian
from estimation.solver import Update, update

OUTLIER_LEVEL = 0.001  # probability that an honest batch loses a row


class HandEyePhase(OneByOne):
    """Laser on the plate from planned poses, then from the next best ones."""

    def plan(self, context: PhaseContext[job.HandEyePhase]) -> Sequence[Step]:
        prior = with_plate(context.belief, context.cell)
        return plan_hand_eye(context.cell, prior, context.arm, context.spec.measurements, context.seed).steps

    def evaluate(
        self, context: PhaseContext[job.HandEyePhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        fit = self._fit(context, good(samples))
        gated = self.gated(context, fit.belief)
        level = context.cell.job.test_level
        verdict = findings.uncertainty_verdict(fit, gated, context.spec.limit_m, "Hand-eye", level)
        verdict = self.judged(context, steps, fit.belief, verdict)
        estimate: dict[str, Any] = {
            "pose": findings.pose_dict(fit.belief.transform("laser")),
            "values": findings.block_values(
                fit.belief, ["laser", "laser.scale", "laser.offset", "plate", "kinematics"]
            ),
            "gated": gated,
            "limit_m": context.spec.limit_m,
            "fit": findings.fit_summary(fit),
        }
        return Finding(verdict, fit.belief, estimate)

    def known(self, context: PhaseContext[job.HandEyePhase], samples: Sequence[Sample]) -> Belief:
        if not samples:
            return with_plate(context.belief, context.cell)
        return self._fit(context, samples).belief

    @staticmethod
    def _fit(context: PhaseContext[job.HandEyePhase], samples: Sequence[Sample]) -> Update:
        return update(
            with_plate(context.belief, context.cell),
            Chain(context.arm, observations(context.cell, samples)),
            targets=("laser", "plate"),
            phase="hand-eye",
            reject_level=OUTLIER_LEVEL,
        )

    def prospect(self, context: PhaseContext[job.HandEyePhase], belief: Belief, seed: int) -> Prospect:
        return Prospect.of_hand_eye(context.cell, belief, context.arm, context.spec, seed)

    @staticmethod
    def gated(context: PhaseContext[job.HandEyePhase], belief: Belief) -> list[dict[str, Any]]:
        """The point of a reading, in the flange, at each gated range: offset and mount count as one there."""
        ranges_m = np.array(context.spec.gated_ranges_m)
        names = [f"{range_m * 1e3:.0f} mm" for range_m in ranges_m]
        return findings.gated_points(point_jacobian(belief, ranges_m), belief, names)
