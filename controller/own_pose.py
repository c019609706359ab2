"""Where a robot says that its flange is, against where its joints have it by the geometry of the cell file.

Both must agree before anything is measured with them: another active tool or base, another order of angles or
another arm shifts or turns every point, and no residual need show it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.cellfile import Cell
from controller.knowledge import first_belief, joint_variance
from drivers.capabilities import JointReadings
from estimation.errors import DeviceError
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray, Transform, log_pose

AGREED_M: Final = 1e-4  # between two computations of one geometry, with the decimals of the protocol
AGREED_RAD: Final = np.radians(0.01)
SIGMAS: Final = 4.0  # of what the cell file leaves open of geometry and joints


class PoseMismatch(DeviceError):
    """The robot's own pose and its joints tell of different places (fault R7)."""


@dataclass(frozen=True, slots=True)
class PoseGap:
    """Between the two, and the most that honest ones differ."""

    distance_m: float
    distance_limit_m: float
    angle_rad: float
    angle_limit_rad: float

    @property
    def agrees(self) -> bool:
        """Whether both are within their limits."""
        return self.distance_m <= self.distance_limit_m and self.angle_rad <= self.angle_limit_rad


def pose_gap(cell: Cell, arm: ArmModel, joints: JointReadings, reported: Transform) -> PoseGap:
    """How far a reported base_T_flange is from that of the joints, read at the same standstill."""
    flange, by_joint, by_parameter = arm.jacobians(np.mean(joints.joints_rad, axis=0))
    gap = log_pose(np.linalg.inv(flange[0]) @ reported.matrix)
    open_ = joint_variance(cell, len(joints.joints_rad)) * by_joint[0] @ by_joint[0].T
    belief = first_belief(cell)
    if "kinematics" in belief:
        open_ = open_ + by_parameter[0] @ belief.block_covariance("kinematics") @ by_parameter[0].T
    return PoseGap(
        float(np.linalg.norm(gap[:3])),
        AGREED_M + SIGMAS * _largest_std(open_[:3, :3]),
        float(np.linalg.norm(gap[3:])),
        AGREED_RAD + SIGMAS * _largest_std(open_[3:, 3:]),
    )


def require_same_pose(cell: Cell, arm: ArmModel, joints: JointReadings, reported: Transform) -> None:
    """Raises PoseMismatch when a robot's own pose contradicts its joints."""
    gap = pose_gap(cell, arm, joints, reported)
    if not gap.agrees:
        raise PoseMismatch(
            f"The robot says that its flange is {gap.distance_m * 1e3:.2f} mm and "
            f"{np.degrees(gap.angle_rad):.3f} deg away from where its joints have it, limits "
            f"{gap.distance_limit_m * 1e3:.2f} mm and {np.degrees(gap.angle_limit_rad):.3f} deg",
            "Select tool and base 0 on the robot, and compare its geometry and angles with the cell file",
        )


def _largest_std(covariance: FloatArray) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
