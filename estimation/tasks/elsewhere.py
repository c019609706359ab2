"""The same kind of measurement anywhere the arm can go: to tell what this kind never sees."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import Value
from estimation.kinematics import ArmModel
from estimation.tasks.chain import Markers
from estimation.tasks.motion import KINEMATICS, Joints
from estimation.tasks.sensing import SensorTask
from estimation.transform import FloatArray

_STEPS: Final = 25
_LARGEST_STEP_RAD: Final = 0.5
_CLOSE_M: Final = 1e-6


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


def elsewhere(task: SensorTask, motion: Joints, values: Mapping[str, Value], count: int) -> SensorTask:
    """The measurements of the task without their errors, and up to `count` more all over the limits.

    A sensor of whole points reads what it would read there; for others the joints are moved until the
    reading that they have is right (Newton's steps, shortest first), and given up where that fails.

    motion : of the task. values : of all blocks, for the arm as it is nominally.
    """
    arm, place = motion.arm, task.readings().pose_index
    rows = np.concatenate([np.arange(len(place)), np.arange(count) % len(place)])
    joints = np.concatenate([motion.joints_rad[place], spread_joints(arm, count)])
    if isinstance(task.target(), Markers):
        moved = _taken(task, rows, replace(motion, joints_rad=joints))
        points: dict[str, Any] = {"points_m": _predicted(moved, values)}
        return replace(moved, **points)
    turning = replace(arm, free=tuple((joint, "theta") for joint in range(arm.joint_count)))
    values = {**values, KINEMATICS: np.zeros(arm.joint_count)}  # their derivatives are those by the joints
    residual = np.full(len(rows), np.inf)
    for step in range(_STEPS + 1):
        seen = _taken(task, rows, replace(motion, arm=turning, joints_rad=joints)).model().rows(values)
        residual, by_joint = seen.residual_m, seen.jacobian[KINEMATICS]
        if step < _STEPS:
            back = -residual[:, None] * by_joint / np.maximum(np.sum(by_joint**2, axis=1), 1e-6)[:, None]
            largest = np.abs(back).max(axis=1, keepdims=True) / _LARGEST_STEP_RAD
            joints = joints + back / np.maximum(largest, 1.0)
    turned = np.mod(joints + np.pi, 2.0 * np.pi) - np.pi
    good = np.flatnonzero((np.abs(residual) < _CLOSE_M) & arm.within_limits(turned))
    return _taken(task, rows[good], replace(motion, joints_rad=turned[good]))


def _taken(task: SensorTask, rows: NDArray[np.intp], motion: Joints) -> SensorTask:
    """Readings (k,) of the task, each at a pose of its own."""
    changed: dict[str, Any] = {"motion": motion}
    for name in task.per_reading:
        changed[name] = np.asarray(getattr(task, name))[rows]
    if "pose_index" in changed:
        changed["pose_index"] = np.arange(len(rows))
    return replace(task, **changed)


def _predicted(task: SensorTask, values: Mapping[str, Value]) -> FloatArray:
    """(m, 3) what a sensor of whole points would read."""
    target = task.target()
    zero = np.zeros((len(task.readings().points_m), 3))
    origin = task.seen_points(values, zero)
    axes = np.stack([task.seen_points(values, zero + axis) - origin for axis in np.eye(3)], axis=2)
    gap = target.see(origin, values).residual_m
    return np.asarray(-np.einsum("mij,mi->mj", axes, gap))
