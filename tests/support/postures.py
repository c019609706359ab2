"""Joints for a tool that looks straight down."""

import numpy as np

from estimation.inverse_kinematics import solve
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray


def looking_down(
    arm: ArmModel, flange_T_tool: FloatArray, base_p: FloatArray, near: FloatArray
) -> FloatArray:
    """Joints (n,) near others that bring a tool, its z axis downwards, to a point (3,) of the base."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    for pose, turn in zip(poses, np.linspace(0, 2 * np.pi, 8, endpoint=False), strict=True):
        across = np.array([np.cos(turn), np.sin(turn), 0.0])
        pose[:3, :3] = np.column_stack([across, np.cross([0, 0, -1], across), [0, 0, -1]])
        pose[:3, 3] = base_p
    joints, valid = solve(arm, poses @ np.linalg.inv(flange_T_tool))
    found = joints[valid]
    return np.asarray(found[np.abs(found - near).max(axis=1).argmin()])
