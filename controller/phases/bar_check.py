"""The independent check of a hand-eye: a certified two-sphere bar, and plate poses measured again.

Nothing measured here enters a fit. The samples are tested as a five-parameter bump of the laser
with the full joint covariance; the bar catches absolute errors, the plate catches drift.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from controller.cellfile import job
from controller.gates import Proof, Verdict
from controller.knowledge import observations, with_bar
from controller.phases import findings
from controller.phases.base import Finding, OnePlan, PhaseContext, checked_phase, good
from controller.planning import plan_bar_check
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.bump import BumpTest, bump_test
from estimation.measurement import point_jacobian
from estimation.statistics import Outcome

GUARD = 1.645  # one-sided 95 %, on the uncertainty of the check itself


class BarCheckPhase(OnePlan):
    """Bar spheres from several tool orientations, and some poses of the hand-eye again."""

    def plan(self, context: PhaseContext[job.CheckPhase]) -> Sequence[Step]:
        checked = context.earlier[context.spec.of]
        prior = with_bar(context.belief, context.cell)
        return plan_bar_check(
            context.cell, prior, context.arm, context.spec, checked.steps, context.seed
        ).steps

    def evaluate(
        self, context: PhaseContext[job.CheckPhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        prior = with_bar(context.belief, context.cell)
        batches = observations(context.cell, good(samples))
        test = bump_test(prior, context.arm, batches, level=context.cell.job.test_level)
        hand_eye = checked_phase(context, job.HandEyePhase)
        shifts = _shifts(context, test, np.array(hand_eye.gated_ranges_m))
        proofs = (
            Proof(
                "bump of the laser",
                test.statistic,
                test.limit,
                "",
                Outcome.OK if test.passed else Outcome.NOT_DECIDABLE,
                test.words,
            ),
            Proof(
                "chi-square of the check",
                test.chi2,
                test.chi2_limit,
                "",
                Outcome.OK if test.chi2 <= test.chi2_limit else Outcome.NOT_DECIDABLE,
                f"{test.dof} degrees of freedom, with the bump free",
            ),
            _shift_proof(shifts, hand_eye.limit_m),
        )
        verdict = Verdict(
            proofs,
            findings.message(proofs, f"The check agrees with the hand-eye: {test.words}"),
            ""
            if all(proof.outcome is Outcome.OK for proof in proofs)
            else "Find out what moved (laser mount, bar, plate), then Stop, Reset and calibrate again",
        )
        estimate: dict[str, Any] = {
            "bump": {
                "value": test.bump.tolist(),
                "covariance": test.covariance.tolist(),
                "words": test.words,
            },
            "statistic": test.statistic,
            "limit": test.limit,
            "shifts": shifts,
            "points": len(good(samples)),
        }
        return Finding(verdict, context.belief, estimate)


def _shifts(
    context: PhaseContext[job.CheckPhase], test: BumpTest, ranges_m: np.ndarray
) -> list[dict[str, Any]]:
    """What the bump would do to the point of a reading, at each gated range, with its own uncertainty."""
    belief = context.belief
    points = point_jacobian(belief, ranges_m)
    jacobian = points.jacobian[:, :, belief.index("laser")]
    moved = jacobian @ test.bump
    covariance = jacobian @ test.covariance @ np.swapaxes(jacobian, 1, 2)
    size_m = np.linalg.norm(moved, axis=1)
    along = moved / size_m[:, None]
    u_m = np.sqrt(np.einsum("ki,kij,kj->k", along, covariance, along))
    return [
        {"point": f"{range_m * 1e3:.0f} mm", "moved_m": float(size_m[i]), "u_m": float(u_m[i])}
        for i, range_m in enumerate(ranges_m)
    ]


def _shift_proof(shifts: Sequence[dict[str, Any]], limit_m: float) -> Proof:
    worst = max(shifts, key=lambda shift: float(shift["moved_m"] + GUARD * shift["u_m"]))
    guarded_m = limit_m - GUARD * worst["u_m"]
    return Proof.at_most(
        "error seen by the check",
        worst["moved_m"] * 1e3,
        guarded_m * 1e3,
        "mm",
        f"at {worst['point']}; limit {limit_m * 1e3:.2f} mm less the guard band of the check",
    )
