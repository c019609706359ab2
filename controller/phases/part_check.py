"""The independent check of a localization: fresh points on the part, never fitted."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import chdtri

from controller.cellfile import job
from controller.gates import Proof, Verdict
from controller.knowledge import observations
from controller.phases import findings
from controller.phases.base import Finding, OnePlan, PhaseContext, checked_phase, good
from controller.planning import plan_part_check
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.measurement import Chain
from estimation.solver import predict
from estimation.statistics import Outcome

GUARD = 1.645  # one-sided 95 %, on the uncertainty of the check itself
FEWEST = 6


class PartCheckPhase(OnePlan):
    """Points from other orientations; each residual is held against the limit, all together against S."""

    def plan(self, context: PhaseContext[job.CheckPhase]) -> Sequence[Step]:
        used = context.earlier[context.spec.of].steps
        return plan_part_check(
            context.cell,
            context.belief,
            context.arm,
            context.spec,
            used,
            context.seed,
        ).steps

    def evaluate(
        self, context: PhaseContext[job.CheckPhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        points = good(samples)
        localize = checked_phase(context, job.LocalizePhase)
        batches = observations(context.cell, points)
        prediction = predict(context.belief, Chain(context.arm, batches))
        own_u_m = np.sqrt(prediction.noise_variance)  # of the check itself
        guarded_m = localize.limit_m - GUARD * own_u_m
        excess = np.abs(prediction.residual_m) - guarded_m
        worst = int(np.argmax(excess))
        upper = float(chdtri(len(points), context.cell.job.test_level))
        proofs = (
            Proof.at_most(
                "missing check points",
                float(max(0, FEWEST - len(points))),
                0.0,
                "",
                f"{len(points)} points, at least {FEWEST}",
            ),
            Proof(
                "chi-square of the check",
                prediction.chi2,
                upper,
                "",
                Outcome.OK if prediction.chi2 <= upper else Outcome.NOT_DECIDABLE,
                f"{len(points)} fresh points with the full covariance of pose, hand-eye, kinematics and form",
            ),
            Proof.at_most(
                "largest residual",
                float(abs(prediction.residual_m[worst])) * 1e3,
                float(guarded_m[worst]) * 1e3,
                "mm",
                f"on {points[worst].feature}; limit {localize.limit_m * 1e3:.2f} mm "
                "less the guard band of the check",
            ),
        )
        passed = all(proof.outcome is Outcome.OK for proof in proofs)
        verdict = Verdict(
            proofs,
            findings.message(
                proofs, f"Fresh points agree with the localization within {proofs[2].value:.3f} mm"
            ),
            "" if passed else "Find out what moved (part, laser mount), then Unhold to check again or Stop",
        )
        estimate: dict[str, Any] = {
            "residuals_m": prediction.residual_m.tolist(),
            "standardised": prediction.standardised.tolist(),
            "features": [sample.feature for sample in points],
            "chi2": prediction.chi2,
            "limit": upper,
        }
        return Finding(verdict, context.belief, estimate)
