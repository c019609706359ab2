"""Inspection: stylus qualified on its sphere, features touched, characteristics judged by ISO 14253-1."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.cellfile import Cell, job
from controller.gates import Proof, Verdict, worst
from controller.knowledge import observations, part_features, with_inspected, with_probe
from controller.phases import findings
from controller.phases.base import Finding, OnePlan, PhaseContext, good
from controller.planning import plan_inspect
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.belief import Belief
from estimation.kinematics import ArmModel
from estimation.measurement import Chain
from estimation.solver import predict, update
from estimation.statistics import Outcome, decide
from estimation.surfaces import Feature
from estimation.transform import FloatArray

OUTLIER_LEVEL = 0.001


@dataclass(frozen=True, slots=True)
class Measured:
    """A characteristic's value with its standard uncertainty, metres."""

    value_m: float
    u_m: float
    points: int
    method: str


class InspectPhase(OnePlan):
    """Touches on the stylus sphere and on the tolerated features; all in one estimate."""

    def plan(self, context: PhaseContext[job.InspectPhase]) -> Sequence[Step]:
        prior = with_inspected(with_probe(context.belief, context.cell), context.cell)
        return plan_inspect(context.cell, prior, context.arm, context.spec, context.seed).steps

    def evaluate(
        self, context: PhaseContext[job.InspectPhase], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        cell = context.cell
        prior = with_inspected(with_probe(context.belief, cell), cell)
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
            prior,
            Chain(context.arm, observations(cell, touches)),
            targets=_inspected(cell),
            phase="touch",
            reject_level=OUTLIER_LEVEL,
        )
        table = [
            self._characteristic(context, item, qualified.belief, fit.belief, touches)
            for item in cell.part.characteristics
        ]
        proofs = (
            findings.consistency_proof(qualified, "stylus: "),
            findings.consistency_proof(fit, "touches: "),
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
        conforming = sum(row["outcome"] == Outcome.OK.value for row in table)
        verdict = Verdict(
            proofs,
            f"{conforming} of {len(table)} characteristics conform"
            if outcome is Outcome.OK
            else findings.message(proofs, ""),
            "" if outcome is Outcome.OK else "See the inspection table of the report",
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

    def _characteristic(
        self,
        context: PhaseContext[job.InspectPhase],
        item: Any,
        qualified: Belief,
        belief: Belief,
        touches: Sequence[Sample],
    ) -> dict[str, Any]:
        """One row of the inspection table."""
        cell = context.cell
        feature = next(feature for feature in part_features(cell) if feature.name == item.feature)
        own = [sample for sample in touches if sample.object == "part" and sample.feature == item.feature]
        match item.kind:
            case "diameter":
                measured = _diameter(belief, feature, len(own))
                lower, upper = item.nominal_m + item.tolerance_m[0], item.nominal_m + item.tolerance_m[1]
                nominal: float | None = item.nominal_m
            case "position":
                measured = _position(cell, belief, feature, item.datums, len(own))
                lower, upper, nominal = -np.inf, item.tolerance_m, 0.0
            case _:
                measured = _flatness(cell, context.arm, qualified, own)
                lower, upper, nominal = -np.inf, item.tolerance_m, 0.0
        decision = decide(
            measured.value_m, measured.u_m, lower, upper, probability=cell.job.conformance_probability
        )
        limit = upper if nominal is None or measured.value_m >= nominal else lower
        return {
            "id": item.id,
            "feature": item.feature,
            "kind": item.kind,
            "nominal_m": nominal,
            "lower_m": lower if np.isfinite(lower) else None,
            "upper_m": upper,
            "value_m": measured.value_m,
            "deviation_m": measured.value_m - (nominal or 0.0),
            "limit_m": limit - (nominal or 0.0),
            "u_m": measured.u_m,
            "U_m": 2.0 * measured.u_m,
            "guard_band_m": _finite(decision.guard_band),
            "conformance_probability": _finite(decision.conformance_probability),
            "outcome": decision.outcome.value,
            "points": measured.points,
            "method": measured.method,
            "datums": list(item.datums) if item.kind == "position" else [],
            "text": f"{item.kind} of {item.feature}: {measured.value_m * 1e3:.4f} mm, "
            f"U = {2e3 * measured.u_m:.4f} mm (k = 2)",
        }


def _finite(value: float) -> float | None:
    """For the store, which takes numbers only."""
    return value if np.isfinite(value) else None


def _inspected(cell: Cell) -> tuple[str, ...]:
    return tuple(f"part.{feature.name}" for feature in part_features(cell) if feature.kind == "cylinder")


def _diameter(belief: Belief, feature: Feature, points: int) -> Measured:
    block = f"part.{feature.name}"
    place = feature.deviations.index("offset")
    radius_m = feature.radius_m + feature.radius_sign * float(belief.vector(block)[place])
    return Measured(2.0 * radius_m, 2.0 * float(belief.std(block)[place]), points, "least squares")


def _position(cell: Cell, belief: Belief, feature: Feature, datums: Sequence[str], points: int) -> Measured:
    """Twice the distance of the axis from its exact place in the touched datums.

    The uncertainty is that of the worst direction: near zero the distance has none of its own.
    """
    named = {other.name: other for other in part_features(cell)}
    axis = np.asarray(feature.axis)
    across = [named[datum] for datum in datums if abs(np.dot(named[datum].axis, axis)) < 0.5]
    block = f"part.{feature.name}"
    deviation, jacobian = np.zeros(2), np.zeros((2, belief.size))
    for row, datum in enumerate(across[:2]):
        normal = np.asarray(datum.axis)
        columns = belief.index(block)
        shifts = belief.vector(block)
        for place, kind in enumerate(feature.deviations):
            if kind.startswith("shift"):
                along = normal["xyz".index(kind[-1])]
                deviation[row] += along * shifts[place]
                jacobian[row, columns.start + place] += along
        deviation[row] -= belief.scalar(f"part.{datum.name}")
        jacobian[row, belief.index(f"part.{datum.name}")] -= 1.0
    covariance = jacobian @ belief.covariance @ jacobian.T
    u_m = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return Measured(
        2.0 * float(np.linalg.norm(deviation)), 2.0 * u_m, points, "least squares, touched datums"
    )


def _flatness(cell: Cell, arm: ArmModel, belief: Belief, touches: Sequence[Sample]) -> Measured:
    """Range of the touches about their least-squares plane; u from the full covariance before the fit."""
    prediction = predict(belief, Chain(arm, observations(cell, touches)))
    face = next(feature for feature in part_features(cell) if feature.name == touches[0].feature)
    local = _positions(cell, arm, belief, touches)
    u, v = _in_plane(np.asarray(face.axis))
    design = np.column_stack([np.ones(len(local)), local @ u, local @ v])
    remaining = np.eye(len(local)) - design @ np.linalg.pinv(design)
    residual = remaining @ prediction.residual_m
    covariance = remaining @ prediction.covariance @ remaining.T
    high, low = int(np.argmax(residual)), int(np.argmin(residual))
    variance = covariance[high, high] + covariance[low, low] - 2.0 * covariance[high, low]
    return Measured(
        float(residual[high] - residual[low]),
        float(np.sqrt(max(variance, 0.0))),
        len(touches),
        "least-squares plane",
    )


def _positions(cell: Cell, arm: ArmModel, belief: Belief, touches: Sequence[Sample]) -> FloatArray:
    """Ball centres (m, 3) in the frame of the part."""
    joints = np.array([sample.joints_rad for sample in touches])
    flange = arm.with_deviation(belief.vector("kinematics")).flange_pose(joints)
    centre = flange[:, :3, :3] @ belief.transform("probe").origin_m + flange[:, :3, 3]
    return belief.transform("part").inverse().points(centre)


def _in_plane(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    u = np.cross(normal, helper)
    u /= np.linalg.norm(u)
    return u, np.cross(normal, u)
