"""From what the sensor shall do to joint angles: flange poses for beams and touches, and the branch."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.inverse_kinematics import solve
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

LIMIT_MARGIN_RAD: Final = np.radians(
    3.0
)  # the calibrated arm needs slightly other joints than the nominal one
WRIST_MARGIN_RAD: Final = np.radians(6.0)  # of axis 5 from straight, where axes 4 and 6 would spin
ELBOW_MARGIN_RAD: Final = np.radians(12.0)  # of axis 3 from stretched
_WEIGHTS: Final = np.array([1.0, 1.0, 1.0, 0.5, 0.7, 0.5])  # moving the wrist disturbs the arm least


def directions_around(axis: FloatArray, tilt_rad: FloatArray, azimuth_rad: FloatArray) -> FloatArray:
    """Unit vectors (m, 3) tilted away from unit axes (m, 3) or (3,), towards an azimuth about them."""
    across, other = _across(np.broadcast_to(axis, (len(tilt_rad), 3)))
    sideways = np.cos(azimuth_rad)[:, None] * across + np.sin(azimuth_rad)[:, None] * other
    return np.cos(tilt_rad)[:, None] * axis + np.sin(tilt_rad)[:, None] * sideways


def beam_poses(
    base_p: FloatArray,
    base_beam: FloatArray,
    spin_rad: FloatArray,
    distance_m: FloatArray,
    flange_T_laser: FloatArray,
) -> FloatArray:
    """base_T_flange (m, 4, 4) with the beam along `base_beam` (m, 3) through `base_p` (m, 3).

    The laser's origin is `distance_m` (m,) before the point; `spin_rad` (m,) turns it about the beam.
    """
    origins = base_p - distance_m[:, None] * base_beam
    base_T_laser = _poses(origins, base_beam, spin_rad)
    laser_T_flange = np.linalg.inv(flange_T_laser)
    return np.asarray(base_T_laser @ laser_T_flange)


def ball_poses(
    base_p: FloatArray, base_tool: FloatArray, spin_rad: FloatArray, flange_p_ball: FloatArray
) -> FloatArray:
    """base_T_flange (m, 4, 4) with the ball at `base_p` (m, 3) and the flange's z along `base_tool`."""
    poses = _poses(base_p, base_tool, spin_rad)
    poses[:, :3, 3] -= poses[:, :3, :3] @ flange_p_ball
    return poses


def choose_joints(
    arm: ArmModel, base_T_flange: FloatArray, near_rad: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """One solution for each pose: the branch nearest to a posture, away from limits and singular places.

    Parameters
    ----------
    base_T_flange : (m, 4, 4).
    near_rad : (6,) or (m, 6). Its first joint counts as pointing at the pose, so that going around the
        base does not make the arm turn over.

    Returns
    -------
    joints (m, 6), zeros where there is none; found (m,).
    """
    joints, valid = solve(arm, base_T_flange)
    joints = np.where(np.isfinite(joints), joints, 0.0)
    usable = valid & arm.within_limits(joints, LIMIT_MARGIN_RAD)
    usable &= np.abs(np.sin(joints[..., 4])) > np.sin(WRIST_MARGIN_RAD)
    usable &= np.abs(np.sin(joints[..., 2])) > np.sin(ELBOW_MARGIN_RAD)
    near: FloatArray = np.array(np.broadcast_to(near_rad, (len(joints), 6)))
    if np.ndim(near_rad) == 1:
        near[:, 0] += np.arctan2(base_T_flange[:, 1, 3], base_T_flange[:, 0, 3]) - near[:, 0]
    motion = (np.abs(joints - near[:, None]) * _WEIGHTS).max(axis=-1)
    best = np.argmin(np.where(usable, motion, np.inf), axis=1)
    rows = np.arange(len(joints))
    found = usable[rows, best]
    return np.where(found[:, None], joints[rows, best], 0.0), found


def _poses(origins: FloatArray, z_axes: FloatArray, spin_rad: FloatArray) -> FloatArray:
    across, other = _across(z_axes)
    x_axes = np.cos(spin_rad)[:, None] * across + np.sin(spin_rad)[:, None] * other
    poses = np.zeros((len(origins), 4, 4))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = x_axes, np.cross(z_axes, x_axes), z_axes
    poses[:, :3, 3], poses[:, 3, 3] = origins, 1.0
    return poses


def _across(axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (m, 3) each, perpendicular to the axes and to each other, right-handed."""
    helper = np.where(np.abs(axes[:, :1]) < 0.9, np.eye(3)[:1], np.eye(3)[1:2])
    first: FloatArray = helper - (helper * axes).sum(axis=1, keepdims=True) * axes
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axes, first)
