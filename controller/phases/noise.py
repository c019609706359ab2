"""Noise: do joints and laser repeat as the cell file declares?"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import chdtri

from controller.cellfile import job
from controller.gates import Proof, Verdict
from controller.knowledge import first_belief, observations, with_plate
from controller.phases.base import Finding, OnePlan, PhaseContext, good
from controller.phases.findings import message
from controller.planning import plan_noise
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.measurement import Chain
from estimation.model import evaluate
from estimation.statistics import Outcome
from estimation.transform import FloatArray


class NoisePhase(OnePlan):
    """Scatter of readings at rest, and of laser points on a small patch of the plate."""

    def plan(self, context: PhaseContext[job.NoisePhase]) -> Sequence[Step]:
        return plan_noise(
            context.cell, with_plate(context.belief, context.cell), context.arm, context.spec
        ).steps

    def evaluate(
        self, context: PhaseContext[job.NoisePhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        still = good(samples, "noise")
        joints = _joint_proofs(context, still)
        laser = [_reading_proof(context, good(samples)), _point_proof(context, good(samples))]
        proofs = [*joints, *(proof for proof in laser if proof is not None)]
        verdict = Verdict(
            tuple(proofs),
            message(proofs, "Joints and laser repeat as declared"),
            ""
            if all(proof.outcome is Outcome.OK for proof in proofs)
            else "Have that axis or sensor looked at, or declare its noise in the cell file and plan again",
        )
        estimate: dict[str, Any] = {
            "values": [
                {"name": proof.name, "value": proof.value, "limit": proof.limit, "unit": proof.unit}
                for proof in proofs
            ]
        }
        return Finding(verdict, context.belief, estimate)


def _pooled(scatter: FloatArray, counts: FloatArray) -> tuple[FloatArray, float]:
    """Pooled standard deviation of samples with their own means, and its degrees of freedom."""
    dof = counts - 1
    return np.sqrt(np.tensordot(dof, scatter**2, axes=1) / dof.sum()), float(dof.sum())


def _upper(dof: float, level: float) -> float:
    """Largest ratio of seen to declared standard deviation, which honest noise exceeds at `level`."""
    return float(np.sqrt(chdtri(dof, level) / dof))


def _joint_proofs(context: PhaseContext[job.NoisePhase], samples: Sequence[Sample]) -> list[Proof]:
    robot = context.cell.robot
    if not samples:
        return []
    scatter = np.array([sample.joint_scatter_rad for sample in samples])
    seen, dof = _pooled(scatter, np.array([sample.joint_readings for sample in samples], dtype=np.float64))
    # A coarse reading of an arm on the edge between two steps flips by a whole step.
    steps = robot.encoder_step_rad**2 / (4 if robot.coarse else 12)
    declared = np.sqrt(robot.joint_noise_rad**2 + steps)
    limit = declared * _upper(dof, context.cell.job.test_level / len(seen))
    order = np.argsort(-seen)  # the noisiest first: a message names that joint
    return [
        Proof.at_most(
            f"noise of joint {j + 1}",
            float(np.degrees(seen[j])),
            float(np.degrees(limit)),
            "deg",
            f"standard deviation of one reading, {dof:.0f} degrees of freedom, "
            f"declared {np.degrees(declared):.4f} deg with the encoder step",
        )
        for j in order
    ]


def _reading_proof(context: PhaseContext[job.NoisePhase], samples: Sequence[Sample]) -> Proof | None:
    if not samples or context.cell.laser.reading_noise_m == 0.0:
        return None
    scatter = np.array([[sample.reading_scatter_m] for sample in samples])
    seen, dof = _pooled(scatter, np.array([sample.readings for sample in samples], dtype=np.float64))
    declared = context.cell.laser.reading_noise_m
    limit = 1.02 * declared * _upper(dof, context.cell.job.test_level)  # the step of its output adds 1 %
    return Proof.at_most(
        "noise of one laser cycle",
        float(seen[0] * 1e3),
        limit * 1e3,
        "mm",
        f"at rest, {dof:.0f} degrees of freedom, declared {declared * 1e3:.3f} mm",
    )


def _point_proof(context: PhaseContext[job.NoisePhase], samples: Sequence[Sample]) -> Proof | None:
    """Points a few millimetres apart, seen from one posture: what remains about a local plane is noise."""
    patch = [sample for sample in samples if sample.kind == "laser" and sample.object == "plate"]
    if len(patch) < 6:
        return None
    belief = with_plate(first_belief(context.cell), context.cell)
    rows = evaluate(belief, Chain(context.arm, observations(context.cell, patch)))
    plane = np.column_stack([rows.jacobian["plate"][:, [2, 3, 4]]])  # height and two tilts
    solution, *_ = np.linalg.lstsq(plane, rows.residual_m, rcond=None)
    remaining = rows.residual_m - plane @ solution
    dof = len(patch) - 3
    declared = float(np.sqrt(np.mean(rows.noise_variance)))
    seen = float(np.sqrt(remaining @ remaining / dof))
    return Proof.at_most(
        "noise of laser points",
        seen * 1e3,
        declared * 1e3 * _upper(dof, context.cell.job.test_level),
        "mm",
        f"about a local plane, {dof} degrees of freedom, declared {declared * 1e3:.3f} mm",
    )
