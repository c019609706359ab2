import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import EstimationError, Unreachable
from estimation.inverse_kinematics import refine, solve, solve_nearest
from estimation.kinematics import ArmModel
from estimation.transform import FloatArray

Q_WORK = np.radians([20.0, -20.0, 110.0, 25.0, 50.0, 15.0])  # all eight branches keep the limits


def reachable(arm: ArmModel, seed: int, count: int = 200) -> tuple[FloatArray, FloatArray]:
    """Joint angles (count, 6) within the limits, and their poses (count, 4, 4)."""
    q = np.random.default_rng(seed).uniform(arm.lower_rad, arm.upper_rad, (count, arm.joint_count))
    return q, arm.flange_pose(q)


def distance_rad(a: FloatArray, b: FloatArray) -> FloatArray:
    """Largest joint difference, full turns apart counting as equal."""
    difference = a - b
    return np.asarray(np.abs(difference - 2 * np.pi * np.round(difference / (2 * np.pi))).max(axis=-1))


@pytest.mark.parametrize("name", ["prbt", "irb1400"])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_valid_branch_reaches_the_pose_within_the_limits(
    name: str, seed: int, prbt: ArmModel, irb1400: ArmModel
) -> None:
    arm = {"prbt": prbt, "irb1400": irb1400}[name]
    q, poses = reachable(arm, seed)
    joints, valid = solve(arm, poses)
    assert valid.any(axis=1).all()
    assert np.all(arm.within_limits(joints[valid]))
    which = np.nonzero(valid)[0]
    assert np.abs(arm.flange_pose(joints[valid]) - poses[which]).max() < 1e-9
    # the joint angles that made the pose are among the branches
    found = np.where(valid, distance_rad(joints, q[:, None]), np.inf).min(axis=1)
    assert np.median(found) < 1e-12
    assert found.max() < 1e-4  # looser near singular poses


def test_branches_are_different(prbt: ArmModel) -> None:
    joints, valid = solve(prbt, prbt.flange_pose(Q_WORK[None]))
    assert valid.sum() == 8
    apart = distance_rad(joints[0][:, None], joints[0][None]) + 9 * np.eye(8)
    assert apart.min() > 0.1


@pytest.mark.parametrize("q5_rad", [0.0, 1e-15, 1e-12, 1e-9, 1e-7, -1e-5])
def test_straight_wrist_keeps_joint_4_near_the_given_one(prbt: ArmModel, q5_rad: float) -> None:
    q = Q_WORK.copy()
    q[4] = q5_rad
    pose = prbt.flange_pose(q)
    for q4 in (0.0, 0.7):
        joints, valid = solve(prbt, pose, near=np.array([0, 0, 0, q4, 0, 0]))
        assert valid.any()
        assert np.abs(prbt.flange_pose(joints[valid]) - pose).max() < 1e-9
    nearest = solve_nearest(prbt, pose, near=q)
    assert nearest == pytest.approx(q, abs=1e-6)


def test_stretched_arm_and_wrist_over_axis_1(prbt: ArmModel) -> None:
    for q in (np.radians([20.0, 30.0, 0.0, 10.0, 40.0, 5.0]), np.radians([20.0, 0.0, 0.0, 10.0, 40.0, 5.0])):
        pose = prbt.flange_pose(q)
        joints, valid = solve(prbt, pose)
        assert valid.any()
        assert np.abs(prbt.flange_pose(joints[valid]) - pose).max() < 1e-9


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_calibrated_arm_is_reached_as_exactly(prbt: ArmModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    lengths = [label[0] in "ad" and label[1] != "l" for label in prbt.parameter_labels]
    calibrated = prbt.with_deviation(rng.normal(size=18) * np.where(lengths, 1e-4, 2e-4))
    # away from singular poses, where neighbouring arms have far away solutions
    q = Q_WORK + rng.uniform(-0.4, 0.4, (50, 6))
    poses = calibrated.flange_pose(q)
    joints, valid = solve(calibrated, poses)
    found = np.where(valid, distance_rad(joints, q[:, None]), np.inf).min(axis=1)
    assert found.max() < 1e-9
    assert np.abs(calibrated.flange_pose(joints[valid]) - poses[np.nonzero(valid)[0]]).max() < 1e-9


def test_refine_reports_what_it_cannot_reach(prbt: ArmModel) -> None:
    near = prbt.flange_pose(Q_WORK + 0.05)
    far = near.copy()
    far[0, 3] += 2.0
    joints, converged = refine(prbt, np.stack([near, far]), np.stack([Q_WORK, Q_WORK]))
    assert converged.tolist() == [True, False]
    assert joints[0] == pytest.approx(Q_WORK + 0.05, abs=1e-9)
    assert np.isfinite(joints).all()


def test_out_of_reach_is_flagged_and_said(prbt: ArmModel) -> None:
    pose = prbt.flange_pose(Q_WORK)
    pose[0, 3] = 1.2
    joints, valid = solve(prbt, np.stack([pose, prbt.flange_pose(Q_WORK)]))
    assert not valid[0].any()
    assert np.isnan(joints[0]).any(axis=1).all()
    assert valid[1].any()
    with pytest.raises(Unreachable, match=r"\(1200\.0, .* mm is out of reach"):
        solve_nearest(prbt, pose, Q_WORK)


def test_joint_limit_is_named(prbt: ArmModel) -> None:
    q = Q_WORK.copy()
    q[2] = np.radians(140.0)  # limit 135; no other branch reaches as near the shoulder
    with pytest.raises(Unreachable, match=r"joint 3 at -?140\.\d\d deg, limits -135\.00 to 135\.00 deg"):
        solve_nearest(prbt, prbt.flange_pose(q), q)


def test_nearest_branch_moves_least(prbt: ArmModel) -> None:
    for index, branch in enumerate(solve(prbt, prbt.flange_pose(Q_WORK))[0][0]):
        near = branch + 0.01
        assert solve_nearest(prbt, prbt.flange_pose(Q_WORK), near) == pytest.approx(branch, abs=1e-9), index


def test_other_structures_are_refused(prbt: ArmModel) -> None:
    planar = ArmModel.from_dh([0, 0], [0, 0], [1, 1], [0, 0])
    with pytest.raises(EstimationError, match="2 joints"):
        solve(planar, np.eye(4))
    alpha = prbt.alpha.copy()
    alpha[4] = 0.3
    skewed = ArmModel.from_dh(prbt.theta, prbt.d, prbt.a, alpha)
    with pytest.raises(EstimationError, match=r"17\.19"):
        solve(skewed, np.eye(4))
