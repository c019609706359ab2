"""Joint angles for a flange pose: closed form for arms with a spherical wrist, refined when calibrated."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from estimation.errors import EstimationError, Unreachable
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray

BoolArray = NDArray[np.bool_]

BRANCHES: Final = 8  # shoulder left/right, elbow up/down, wrist turned or not
_LENGTH_SLACK_M: Final = 5e-3  # a calibrated arm may differ from the ideal structure by this much,
_ANGLE_SLACK_RAD: Final = np.radians(2.0)  # and this much; its branches are refined
_EXACT: Final = 1e-12
_WRIST_STRAIGHT: Final = 1e-10  # sin(q5) below which axes 4 and 6 are one line
_REFINE_BEYOND_RAD: Final = 0.05  # branches further outside the limits stay unrefined, and invalid
_LIMIT_SLACK_RAD: Final = 1e-10  # rounding: such a joint is put on its limit


def solve(
    arm: ArmModel, base_T_flange: ArrayLike, near: ArrayLike | None = None
) -> tuple[FloatArray, BoolArray]:
    """All joint solutions of flange poses, branch by branch.

    Six revolute joints: axis 2 perpendicular to axis 1, axis 3 parallel to axis 2, axes 4 to 6 through one
    point. A calibrated arm, near this structure, is solved in closed form and then refined.

    Parameters
    ----------
    base_T_flange : (m, 4, 4), metres.
    near : (6,) or (m, 6), radians. Where the wrist is straight, q4 is free and taken from here (else 0).

    Returns
    -------
    joints : (m, 8, 6), radians. Each joint is the full-turn equivalent nearest the middle of its limits.
        NaN where the pose is out of reach; given, but not valid, where a joint limit is passed.
    valid : (m, 8), the arm reaches the pose within its joint limits.

    Raises
    ------
    EstimationError
        The arm has another structure.
    """
    ideal = _ideal_structure(arm)
    exact = all(
        np.allclose(getattr(arm, name), getattr(ideal, name), rtol=0.0, atol=_EXACT)
        for name in ("theta", "d", "a", "alpha", "beta")
    )
    poses = np.asarray(base_T_flange, dtype=np.float64).reshape(-1, 4, 4)
    start_q4 = np.zeros(len(poses)) if near is None else np.asarray(near, dtype=np.float64)[..., 3]
    joints = _closed_form(ideal, poses, np.broadcast_to(start_q4, len(poses)))
    joints = _nearest_turn(arm, joints)
    reached: BoolArray = np.asarray(np.isfinite(joints).all(axis=-1))
    if not exact:
        chosen = reached & arm.within_limits(joints, margin_rad=-_REFINE_BEYOND_RAD)
        targets = np.broadcast_to(poses[:, None], (len(poses), BRANCHES, 4, 4))[chosen]
        refined, converged = refine(arm, targets, joints[chosen])
        joints[chosen] = np.where(converged[:, None], refined, np.nan)
        reached[chosen] = converged
    on_limit = np.clip(joints, arm.lower_rad, arm.upper_rad)
    joints = np.where(np.abs(on_limit - joints) < _LIMIT_SLACK_RAD, on_limit, joints)
    return joints, reached & arm.within_limits(joints)


def solve_nearest(arm: ArmModel, base_T_flange: ArrayLike, near: ArrayLike) -> FloatArray:
    """The solution (6,) of one pose (4, 4) whose largest joint motion from `near` (6,) is smallest.

    Raises
    ------
    Unreachable
        No branch reaches the pose within the limits; the message says by how much.
    EstimationError
        The arm has another structure.
    """
    start = np.asarray(near, dtype=np.float64)
    joints, valid = solve(arm, base_T_flange, near=start)
    if not valid.any():
        raise _unreachable(arm, np.asarray(base_T_flange, dtype=np.float64), joints[0])
    choices = joints[0, valid[0]]
    nearest: FloatArray = choices[np.argmin(np.abs(choices - start).max(axis=-1))]
    return nearest


def refine(
    arm: ArmModel,
    base_T_flange: ArrayLike,
    start: ArrayLike,
    tolerance: float = 1e-12,
    most_iterations: int = 30,
) -> tuple[FloatArray, BoolArray]:
    """Joint angles that bring any arm to poses, from nearby starts: batched, damped Gauss-Newton.

    Parameters
    ----------
    base_T_flange : (m, 4, 4), metres.
    start : (m, n), radians.
    tolerance : Largest remaining position error (m) and rotation error (rad) of a converged pose.

    Returns
    -------
    joints : (m, n), radians; limits are not looked at. The error never exceeds that of the start.
    converged : (m,).
    """
    poses = np.asarray(base_T_flange, dtype=np.float64)
    joints = np.array(start, dtype=np.float64)
    damping = np.full(len(joints), 1e-9)
    flange, jacobian, _ = arm.jacobians(joints)
    error = _pose_error(flange, poses)
    for _ in range(most_iterations):
        todo = np.flatnonzero((np.abs(error) > tolerance).any(axis=-1) & (damping < 1e6))
        if not len(todo):
            break
        transposed = jacobian[todo].swapaxes(-1, -2)
        normal = transposed @ jacobian[todo] + damping[todo, None, None] * np.eye(joints.shape[1])
        step = np.linalg.solve(normal, transposed @ error[todo, :, None])[..., 0]
        trial = joints[todo] + step
        trial_flange, trial_jacobian, _ = arm.jacobians(trial)
        trial_error = _pose_error(trial_flange, poses[todo])
        better = (trial_error**2).sum(axis=-1) < (error[todo] ** 2).sum(axis=-1)
        accepted = todo[better]
        joints[accepted], error[accepted] = trial[better], trial_error[better]
        jacobian[accepted] = trial_jacobian[better]
        damping[todo] *= np.where(better, 0.1, 100.0)
    return joints, np.asarray((np.abs(error) <= tolerance).all(axis=-1))


def _pose_error(flange: FloatArray, target: FloatArray) -> FloatArray:
    """Body twists (m, 6) that take `flange` (m, 4, 4) to `target`."""
    turned = flange[:, :3, :3].swapaxes(-1, -2)
    error = np.empty((len(flange), 6))
    error[:, :3] = (turned @ (target[:, :3, 3] - flange[:, :3, 3])[..., None])[..., 0]
    error[:, 3:] = Rotation.from_matrix(turned @ target[:, :3, :3]).as_rotvec()
    return error


def _ideal_structure(arm: ArmModel) -> ArmModel:
    """The arm with its small deviations from the closed-form structure taken out."""
    if arm.joint_count != 6:
        raise EstimationError(
            f"Closed-form inverse kinematics of an arm with {arm.joint_count} joints",
            "Only six-axis arms with a spherical wrist are solved in closed form",
        )
    quarter = np.round(arm.alpha / (np.pi / 2))
    alpha, a, d = arm.alpha.copy(), arm.a.copy(), arm.d.copy()
    alpha[:5] = quarter[:5] * np.pi / 2
    a[[3, 4]], d[4] = 0.0, 0.0
    lengths_m = np.abs(np.concatenate([arm.a[[3, 4]], arm.d[[4]]]))
    angles_rad = np.abs(np.concatenate([arm.alpha[:5] - alpha[:5], arm.beta[:5]]))
    parallel = quarter[:5] % 2 == 0
    if (
        not np.array_equal(parallel, [False, True, False, False, False])
        or lengths_m.max() > _LENGTH_SLACK_M
        or angles_rad.max() > _ANGLE_SLACK_RAD
        or abs(arm.a[1]) < _LENGTH_SLACK_M
        or np.hypot(arm.a[2], arm.d[3]) < _LENGTH_SLACK_M
    ):
        raise EstimationError(
            f"No closed-form inverse kinematics: twists {np.degrees(arm.alpha).round(2).tolist()} deg, "
            f"wrist offsets up to {lengths_m.max() * 1e3:.2f} mm",
            "Needed are axes 2 and 3 parallel, their neighbours perpendicular, axes 4 to 6 through one point",
        )
    beta = arm.beta.copy()
    beta[:5] = 0.0  # link 6 is the tool's, and inverted as it stands
    return ArmModel.from_dh(arm.theta, d, a, alpha, beta, arm.lower_rad, arm.upper_rad)


def _closed_form(arm: ArmModel, poses: FloatArray, start_q4: FloatArray) -> FloatArray:
    """Joints (m, 8, 6) of an arm of the ideal structure, not wrapped; NaN out of reach."""
    wrist_pose = poses @ np.linalg.inv(_last_tail(arm))  # base to the frame after Rz of joint 6
    sign1, parity = np.sin(arm.alpha[0]).round(), np.cos(arm.alpha[1]).round()
    sin3 = np.sin(arm.alpha[2]).round()
    shape = (len(poses), 2, 2, 2)
    angles = np.empty((*shape, 6))

    # shoulder: the wrist centre keeps its offset from the plane of the arm
    x, y, z = np.moveaxis(wrist_pose[:, :3, 3], -1, 0)
    offset = -sign1 * (arm.d[1] + parity * arm.d[2])
    forward = _root(x**2 + y**2 - offset**2, scale=x**2 + y**2 + offset**2)
    reach = np.stack([forward, -forward], axis=-1)  # (m, 2)
    angles[..., 0] = (np.arctan2(y, x)[:, None] - np.arctan2(offset, reach))[..., None, None]

    # elbow: two links in the plane
    forearm, bend = np.hypot(arm.a[2], sin3 * arm.d[3]), np.arctan2(-sin3 * arm.d[3], arm.a[2])
    plane_x, plane_y = reach - arm.a[0], sign1 * (z - arm.d[0])[:, None]
    cosine = (plane_x**2 + plane_y**2 - arm.a[1] ** 2 - forearm**2) / (2 * arm.a[1] * forearm)
    sine = _root(1.0 - cosine**2, scale=np.ones_like(cosine))
    elbow = np.arctan2(np.stack([sine, -sine], axis=-1), cosine[..., None])  # (m, 2, 2)
    lean = np.arctan2(parity * forearm * np.sin(elbow), arm.a[1] + forearm * np.cos(elbow))
    angles[..., 1] = (np.arctan2(plane_y, plane_x)[..., None] - lean)[..., None]
    angles[..., 2] = (elbow - bend)[..., None]

    # wrist: what rotation remains after the first three joints
    first_three = (
        ArmModel.from_dh(np.zeros(3), arm.d[:3], arm.a[:3], arm.alpha[:3])
        .flange_pose(angles[:, :, :, 0, :3].reshape(-1, 3))[:, :3, :3]
        .reshape(len(poses), 2, 2, 3, 3)
    )
    rest = first_three.swapaxes(-1, -2) @ wrist_pose[:, None, None, :3, :3]
    sin4, sin5 = np.sin(arm.alpha[3]).round(), np.sin(arm.alpha[4]).round()
    sideways = np.hypot(rest[..., 0, 2], rest[..., 1, 2])
    turned = np.array([1.0, -1.0])
    angles[..., 4] = np.arctan2(turned * sideways[..., None], -sin4 * sin5 * rest[..., 2, 2, None])
    azimuth = np.arctan2(turned * sin5 * rest[..., 1, 2, None], turned * sin5 * rest[..., 0, 2, None])
    free = start_q4[:, None, None, None] + arm.theta[3] + np.array([0.0, np.pi])
    angles[..., 3] = np.where(sideways[..., None] < _WRIST_STRAIGHT, free, azimuth)
    # joint 6 from what joints 4 and 5 leave, so that their rounding near a straight wrist cancels
    wrist = ArmModel.from_dh(np.zeros(2), np.zeros(2), np.zeros(2), arm.alpha[3:5])
    two = wrist.flange_pose(angles[..., 3:5].reshape(-1, 2))[:, :3, :3].reshape(*shape, 3, 3)
    left = two.swapaxes(-1, -2) @ rest[..., None, :, :]
    angles[..., 5] = np.arctan2(left[..., 1, 0], left[..., 0, 0])
    return (angles - arm.theta).reshape(len(poses), BRANCHES, 6)


def _last_tail(arm: ArmModel) -> FloatArray:
    """The last link after its joint rotation, (4, 4)."""
    link = ArmModel.from_dh([0.0], arm.d[5:], arm.a[5:], arm.alpha[5:], arm.beta[5:])
    return link.flange_pose(np.zeros(1))


def _root(square: FloatArray, scale: FloatArray) -> FloatArray:
    """Square root; rounding below zero counts as zero, and less than that as NaN."""
    clipped = np.where((square < 0) & (square > -1e-12 * scale), 0.0, square)
    return np.sqrt(np.where(clipped < 0, np.nan, clipped))


def _nearest_turn(arm: ArmModel, joints: FloatArray) -> FloatArray:
    """Joints (..., n) moved by full turns to within half a turn of the middle of their limits."""
    middle = (arm.lower_rad + arm.upper_rad) / 2
    wrapped: FloatArray = joints - 2 * np.pi * np.round((joints - middle) / (2 * np.pi))
    return wrapped


def _unreachable(arm: ArmModel, pose: FloatArray, joints: FloatArray) -> Unreachable:
    """What stands in the way of the branch that comes closest, joints (8, 6)."""
    x_mm, y_mm, z_mm = pose.reshape(4, 4)[:3, 3] * 1e3
    place = f"Flange pose at ({x_mm:.1f}, {y_mm:.1f}, {z_mm:.1f}) mm"
    solved = joints[np.isfinite(joints).all(axis=-1)]
    if not len(solved):
        return Unreachable(f"{place} is out of reach of the wrist", "Move the target closer to the arm")
    excess = np.maximum(arm.lower_rad - solved, solved - arm.upper_rad)
    branch = int(np.argmin(excess.max(axis=-1)))
    joint = int(np.argmax(excess[branch]))
    return Unreachable(
        f"{place} needs joint {joint + 1} at {np.degrees(solved[branch, joint]):.2f} deg, limits "
        f"{np.degrees(arm.lower_rad[joint]):.2f} to {np.degrees(arm.upper_rad[joint]):.2f} deg",
        "Tilt or turn the tool, or move the target",
    )
