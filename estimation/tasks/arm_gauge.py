"""Gauge freedoms of an arm that is calibrated: what another base frame, flange frame or scale does as well.

For each freedom one parameter keeps its nominal value, the first that takes part in it of: theta and d of
joint 1 (they place the base frame), all of the last link (they place the flange frame), d of joints whose
axis is parallel to the next, from the base outwards, the longest link (the scale, where nothing of known
length is seen), compliance, and the others. A parameter with a prior is never held.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from estimation.belief import Belief, Value
from estimation.covariance import adjoint
from estimation.gauge import Effect, Gauge, gauges
from estimation.kinematics import PARAMETER_NAMES, ArmModel
from estimation.model import values_of, vector_of
from estimation.tasks.chain import SensorChain
from estimation.tasks.closed_forms import inverse
from estimation.tasks.motion import COMPLIANCE, KINEMATICS, Joints
from estimation.tasks.sensing import SensorTask
from estimation.transform import FloatArray

_POSES: Final = 100  # all over the limits, where a gauge must have no effect
_SAME_SCALE: Final = 1e-3  # of all lengths, by which they may grow differently and still be one scale


def arm_gauges(task: SensorTask, motion: Joints, start: Mapping[str, Value]) -> tuple[Gauge, ...]:
    """What the measurements of a task cannot tell of the arm, whatever its joints do.

    motion : of the task, with all parameters free that are wanted. start : values of the mount, the object
    and what else is flat, that fit the nominal arm.
    """
    task = replace(task, motion=motion)
    belief = task.rough().started(start)
    values = values_of(belief)
    rows = _faultless(task, values).rows(values)
    found = gauges(belief, rows.dense(belief), rows.noise_variance, _order(motion), _effect(motion, belief))
    return tuple(_as_scale(gauge, motion.arm) for gauge in found)


def spread_joints(arm: ArmModel, count: int) -> FloatArray:
    """(count, n) joint angles evenly all over the limits of the arm, rad.

    Source: M. Roberts (2018), the additive sequence R_n of low discrepancy.
    """
    n = arm.joint_count
    root = 2.0
    for _ in range(40):  # x^(n + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (n + 1))
    steps = np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, n + 1.0))
    lower, upper = np.maximum(arm.lower_rad, -np.pi), np.minimum(arm.upper_rad, np.pi)
    return np.asarray(lower + (upper - lower) * ((0.5 + steps) % 1.0))


def _effect(motion: Joints, belief: Belief) -> Effect:
    """On the flange in the base, but for what moves either frame or scales all lengths."""
    there = replace(motion, joints_rad=spread_joints(motion.arm, _POSES)).at(values_of(belief))
    dense = np.zeros((_POSES, 6, belief.size))
    for name, matrix in there.jacobian.items():
        dense[:, :, belief.index(name)] = matrix
    back = inverse(there.pose)
    frames = np.zeros((_POSES, 6, 13))
    frames[:, :, :6], frames[:, :, 6:12] = adjoint(back), np.eye(6)
    frames[:, :3, 12] = -back[:, :3, 3]
    basis = np.linalg.qr(frames.reshape(6 * _POSES, 13))[0]
    whole = dense.reshape(6 * _POSES, -1)
    return Effect(whole - basis @ (basis.T @ whole), np.linalg.norm(whole, axis=0))


def _faultless(task: SensorTask, values: Mapping[str, Value]) -> SensorChain:
    """The model with readings that fit: with residuals, what only moves a frame or a scale looks seen."""
    model, target = task.model(), task.target()
    points = model.readings.points_m
    seen = target.see(task.seen_points(values, points), values)
    origin = task.seen_points(values, np.zeros_like(points))
    axes = np.stack(
        [task.seen_points(values, np.zeros_like(points) + axis) - origin for axis in np.eye(3)], 2
    )
    # A sensor that reports one or two numbers has no others to change.
    gradient = (seen.gradient @ axes) * (np.abs(points).max(axis=0) > 0.0)
    residual = seen.residual_m
    if f"{task.sensor}.radius" in values:
        residual = residual - vector_of(values, f"{task.sensor}.radius", 1)
    back = np.linalg.pinv(gradient) @ residual[:, :, None]
    return replace(model, readings=replace(model.readings, points_m=points - back[:, :, 0]))


def _order(motion: Joints) -> list[str]:
    """Labels of what may be held, the first choice first."""
    arm, last = motion.arm, motion.arm.joint_count
    ends = ["theta1", "d1", *(f"{name}{last}" for name in PARAMETER_NAMES)]
    parallel = [f"d{joint + 1}" for joint in np.flatnonzero(arm.parallel_to_next)]
    lengths = {
        f"{name}{joint + 1}": abs(getattr(arm, name)[joint]) for joint, name in arm.free if name in "da"
    }
    longest = sorted(lengths, key=lambda label: -float(lengths[label]))[:1]
    others = [f"{name}{joint + 1}" for name in reversed(PARAMETER_NAMES) for joint in range(last)]
    soft = [f"{COMPLIANCE}.joint{joint + 1}" for joint in motion.soft_joints]
    return [
        *(f"{KINEMATICS}.{label}" for label in (*ends, *parallel, *longest)),
        *soft,
        *(f"{KINEMATICS}.{label}" for label in others),
    ]


def _as_scale(gauge: Gauge, arm: ArmModel) -> Gauge:
    """The gauge with words of its own where all lengths of the arm grow together."""
    nominal = {
        f"{KINEMATICS}.{name}{joint + 1}": float(getattr(arm, name)[joint])
        for joint in range(arm.joint_count)
        for name in ("a", "d")
    }
    amounts = dict(gauge.partners)
    own = nominal.get(gauge.held, 0.0)
    if not own or not any(nominal.get(label) for label in amounts):
        return gauge
    grown = [
        abs(amounts.get(label, 0.0) - length / own) for label, length in nominal.items() if label in amounts
    ]
    if max(grown) > _SAME_SCALE:
        return gauge
    return replace(
        gauge,
        words=f"{gauge.held.rpartition('.')[2]} says how large the arm is: nothing of known length is seen",
    )
