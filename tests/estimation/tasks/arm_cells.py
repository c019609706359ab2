"""Arms that are not their nominal selves, and what a tracker sees of them: the twin's own kinematics."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.kinematics import ArmModel
from estimation.tasks.camera import Tracker
from estimation.tasks.kinematics import KinematicTask
from estimation.tasks.motion import Joints
from tests.estimation.tasks.cells import TRACKER_STD_M, TRACKER_STD_RAD, anywhere
from tests.estimation.twin import DEG, FREE, LIMITS_RAD, MM, NAMES, TABLE, arm, forward

FloatArray = NDArray[np.float64]
JOINT_RAD = 0.0015 * DEG
NOMINAL = replace(arm(), free=())


@dataclass(frozen=True)
class ArmCell:
    """A problem, and its truth: D-H table (6, 5), reflectors (r, 3) on the flange, base_T_tracker."""

    problem: KinematicTask
    table: FloatArray
    reflectors: FloatArray
    tracker: FloatArray


def drawn_table(
    rng: np.random.Generator, length_m: float = 0.5 * MM, angle_rad: float = 0.1 * DEG
) -> FloatArray:
    """The twin's table with an error on each of its 18 parameters that are not a matter of frames."""
    table = TABLE.copy()
    for joint, name in FREE:
        table[joint, NAMES.index(name)] += rng.normal() * (length_m if name in ("a", "d") else angle_rad)
    return table


def everywhere(rng: np.random.Generator, count: int) -> FloatArray:
    """Joints (count, 6) all over their limits."""
    return np.asarray(rng.uniform(-0.9, 0.9, (count, 6)) * LIMITS_RAD)


def tracker_cell(
    rng: np.random.Generator,
    count: int = 60,
    reflectors: int = 1,
    joint_rad: float = JOINT_RAD,
    angle_std_rad: float = TRACKER_STD_RAD,
    table: FloatArray | None = None,
    joints: FloatArray | None = None,
    nominal: ArmModel = NOMINAL,
) -> ArmCell:
    """A tracker some metres away follows reflectors on the flange."""
    table = drawn_table(rng) if table is None else table
    joints = everywhere(rng, count) if joints is None else joints
    sits = np.array([0.0, 0.0, 50 * MM]) + rng.uniform(-80 * MM, 80 * MM, (reflectors, 3))
    tracker = anywhere(rng, 2.5)
    flange = forward(table, joints + rng.normal(size=joints.shape) * joint_rad)
    points = np.einsum("kij,rj->kri", flange[:, :3, :3], sits) + flange[:, None, :3, 3]
    points = ((points - tracker[:3, 3]) @ tracker[:3, :3]).reshape(-1, 3)
    across = rng.normal(size=points.shape) * angle_std_rad  # turns about axes square to the beam
    points = points + np.cross(across, points) + rng.normal(size=points.shape) * TRACKER_STD_M
    measured = Tracker(
        motion=Joints(nominal, joints, std_rad=joint_rad),
        points_m=points,
        pose_index=np.repeat(np.arange(len(joints)), reflectors),
        marker_index=np.tile(np.arange(reflectors), len(joints)),
        std_m=TRACKER_STD_M,
        angle_std_rad=angle_std_rad,
    )
    return ArmCell(KinematicTask(measured=measured), table, sits, tracker)


def deviations(problem: KinematicTask, table: FloatArray) -> FloatArray:
    """True deviations (k,) of the parameters that the problem has free."""
    free = problem.motion.arm.free
    return np.array(
        [table[joint, NAMES.index(name)] - TABLE[joint, NAMES.index(name)] for joint, name in free]
    )


def random_arm(rng: np.random.Generator, joints: int = 6) -> ArmModel:
    """An arm without parallel axes, each link of some length."""
    alpha = rng.uniform(0.3, np.pi - 0.3, joints) * rng.choice([-1.0, 1.0], joints)
    sizes = rng.uniform(0.05, 0.5, (2, joints)) * rng.choice([-1.0, 1.0], (2, joints))
    return ArmModel.from_dh(rng.uniform(-3.0, 3.0, joints), *sizes, alpha)
