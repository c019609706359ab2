"""Characteristics of the part: value and uncertainty from touches, and what may be claimed of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.cellfile import Cell
from controller.cellfile.objects import Characteristic, Diameter, Position
from controller.knowledge import observations, part_features
from controller.samples import Sample
from estimation.belief import Belief
from estimation.flatness import flatness
from estimation.kinematics import ArmModel
from estimation.measurement import Chain
from estimation.solver import predict
from estimation.statistics import Decision, decide
from estimation.surfaces import Feature
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True)
class Measured:
    """A characteristic's value with its standard uncertainty, metres."""

    value_m: float
    u_m: float
    method: str


def measured(cell: Cell, item: Diameter | Position, belief: Belief) -> Measured:
    """A diameter or a position as the belief knows it."""
    feature = next(feature for feature in part_features(cell) if feature.name == item.feature)
    if isinstance(item, Diameter):
        return _diameter(belief, feature)
    return _position(cell, belief, feature, item.datums)


def decision(cell: Cell, item: Characteristic, found: Measured) -> Decision:
    """By ISO 14253-1, with the conformance probability of the job."""
    lower_m, upper_m, _ = _limits(item)
    return decide(found.value_m, found.u_m, lower_m, upper_m, probability=cell.job.conformance_probability)


def table_row(cell: Cell, item: Characteristic, found: Measured, points: int) -> dict[str, Any]:
    """One row of the inspection table."""
    lower_m, upper_m, nominal_m = _limits(item)
    decided = decision(cell, item, found)
    limit_m = upper_m if found.value_m >= nominal_m else lower_m
    return {
        "id": item.id,
        "feature": item.feature,
        "kind": item.kind,
        "nominal_m": nominal_m,
        "lower_m": _finite(lower_m),
        "upper_m": upper_m,
        "value_m": found.value_m,
        "deviation_m": found.value_m - nominal_m,
        "limit_m": limit_m - nominal_m,
        "u_m": found.u_m,
        "U_m": 2.0 * found.u_m,
        "guard_band_m": _finite(decided.guard_band),
        "conformance_probability": _finite(decided.conformance_probability),
        "outcome": decided.outcome.value,
        "points": points,
        "method": found.method,
        "datums": list(item.datums) if isinstance(item, Position) else [],
        "text": f"{item.kind} of {item.feature}: {found.value_m * 1e3:.4f} mm, "
        f"U = {2e3 * found.u_m:.4f} mm (k = 2)",
    }


def _finite(value: float) -> float | None:
    """For the store, which takes numbers only."""
    return value if np.isfinite(value) else None


def _limits(item: Characteristic) -> tuple[float, float, float]:
    """Lower and upper limit and the nominal value, metres."""
    if isinstance(item, Diameter):
        lower_m, upper_m = item.tolerance_m
        return item.nominal_m + lower_m, item.nominal_m + upper_m, item.nominal_m
    return -np.inf, item.tolerance_m, 0.0


def _diameter(belief: Belief, feature: Feature) -> Measured:
    block = f"part.{feature.name}"
    place = feature.deviations.index("offset")
    radius_m = feature.radius_m + feature.radius_sign * float(belief.vector(block)[place])
    return Measured(2.0 * radius_m, 2.0 * float(belief.std(block)[place]), "least squares")


def _position(cell: Cell, belief: Belief, feature: Feature, datums: Sequence[str]) -> Measured:
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
    return Measured(2.0 * float(np.linalg.norm(deviation)), 2.0 * u_m, "least squares, touched datums")


def measured_flatness(cell: Cell, arm: ArmModel, belief: Belief, touches: Sequence[Sample]) -> Measured:
    """Flatness of the face that was touched; `belief` has not used these touches."""
    prediction = predict(belief, Chain(arm, observations(cell, touches)))
    face = next(feature for feature in part_features(cell) if feature.name == touches[0].feature)
    places = _positions(cell, arm, belief, touches) @ np.column_stack(_in_plane(np.asarray(face.axis)))
    estimate = flatness(places, prediction.residual_m, prediction.covariance)
    return Measured(estimate.value_m, estimate.u_m, "least-squares plane, form apart from noise")


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
