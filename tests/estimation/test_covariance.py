import math
from typing import Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.covariance import (
    Form,
    PoseCovariance,
    adjoint,
    compound,
    ellipsoid,
    merge,
    point_axes,
    relative,
    right_jacobian,
)
from estimation.errors import DegenerateGeometry, EstimationError, FrameMismatch
from estimation.transform import FloatArray, Transform, exp_pose, log_pose

SCALE: Final = np.array([1e-4, 2e-4, 1e-4, 2e-4, 1e-4, 3e-4])  # m, rad
seeds = st.integers(0, 2**32 - 1)


def random_pose(rng: np.random.Generator, target: str = "base", source: str = "part") -> Transform:
    """Up to 0.5 m away and turned by less than 60 deg about each axis."""
    return Transform(target, source, exp_pose(rng.uniform(-0.5, 0.5, 6)))


def random_covariance(rng: np.random.Generator, size: int = 6) -> FloatArray:
    root = rng.normal(size=(size, size + 2)) * np.resize(SCALE, size)[:, None]
    return np.asarray(root @ root.T)


def rpy(transform: Transform) -> FloatArray:
    """Position and fixed-axis roll, pitch, yaw, written out independently of scipy."""
    m = transform.matrix
    turns = [math.atan2(m[2, 1], m[2, 2]), math.asin(-m[2, 0]), math.atan2(m[1, 0], m[0, 0])]
    return np.concatenate([m[:3, 3], turns])


@given(seeds)
def test_forms_convert_back_and_forth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = PoseCovariance(random_pose(rng), random_covariance(rng))
    for via in Form:
        for then in Form:
            back = first.in_form(via).in_form(then).in_form(Form.A)
            assert back.matrix == pytest.approx(first.matrix, abs=1e-9 * first.matrix.max())


@given(seeds)
def test_forms_agree_with_finite_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, direction = random_pose(rng), rng.normal(size=6)
    error = PoseCovariance(pose, np.outer(direction, direction))
    step = 1e-6
    ahead, behind = (pose.perturbed(sign * step * direction) for sign in (1, -1))
    in_c = (rpy(ahead) - rpy(behind)) / (2 * step)
    in_b = (
        log_pose(ahead.matrix @ pose.inverse().matrix) - log_pose(behind.matrix @ pose.inverse().matrix)
    ) / (2 * step)
    scale = float(direction @ direction)
    assert error.in_form(Form.C).matrix == pytest.approx(np.outer(in_c, in_c), abs=1e-6 * scale)
    assert error.in_form(Form.B).matrix == pytest.approx(np.outer(in_b, in_b), abs=1e-6 * scale)


def test_states_its_frame_and_order() -> None:
    covariance = PoseCovariance(random_pose(np.random.default_rng(1)), np.eye(6))
    assert covariance.frame == "part"
    assert covariance.in_form(Form.B).frame == "base"
    assert covariance.in_form(Form.C).order == ("tx", "ty", "tz", "roll", "pitch", "yaw")
    assert covariance.order == ("tx", "ty", "tz", "rx", "ry", "rz")


@pytest.mark.parametrize("pitch_deg", [90.0, -90.0, 89.99])
def test_form_c_is_refused_at_90_deg_of_pitch(pitch_deg: float) -> None:
    rpy_rad = np.array([0.3, math.radians(pitch_deg), -0.2])
    pose = Transform.from_xyz_rpy("base", "tool", np.array([0.1, 0.2, 0.3]), rpy_rad)
    covariance = PoseCovariance(pose, np.eye(6))
    with pytest.raises(DegenerateGeometry, match=r"deg of pitch.* Use form A or B\."):
        covariance.in_form(Form.C)
    with pytest.raises(DegenerateGeometry):
        PoseCovariance(pose, np.eye(6), Form.C).in_form(Form.A)
    assert covariance.in_form(Form.B).in_form(Form.A).matrix == pytest.approx(np.eye(6), abs=1e-12)


@given(seeds)
def test_inverse_twice_is_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = PoseCovariance(random_pose(rng), random_covariance(rng))
    twice = first.inverse().inverse()
    assert twice.matrix == pytest.approx(first.matrix, abs=1e-9 * first.matrix.max())
    assert twice.pose.matrix == pytest.approx(first.pose.matrix, abs=1e-12)
    # the inverse with its error on the other side is the same error
    assert first.inverse().in_form(Form.B).matrix == pytest.approx(
        first.matrix, abs=1e-9 * first.matrix.max()
    )


@given(seeds)
def test_compound_and_relative_agree_with_finite_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a_T_b, b_T_c = random_pose(rng, "a", "b"), random_pose(rng, "b", "c")
    a_T_d = random_pose(rng, "a", "d")
    joint = random_covariance(rng, 12)
    first, cross, second = joint[:6, :6], joint[:6, 6:], joint[6:, 6:]

    def by_differences(left: Transform, right: Transform, invert: bool) -> FloatArray:
        """Covariance of the product, with both errors moved one by one."""
        columns = []
        for axis in np.eye(12) * 1e-6:
            ends = []
            for sign in (1, -1):
                moved = left.perturbed(sign * axis[:6])
                moved = moved.inverse() if invert else moved
                ends.append(moved @ right.perturbed(sign * axis[6:]))
            centre = (left.inverse() if invert else left) @ right
            ahead, behind = (log_pose((centre.inverse() @ end).matrix) for end in ends)
            columns.append((ahead - behind) / 2e-6)
        jacobian = np.column_stack(columns)
        return np.asarray(jacobian @ joint @ jacobian.T)

    chain = compound(PoseCovariance(a_T_b, first), PoseCovariance(b_T_c, second), cross)
    assert chain.matrix == pytest.approx(by_differences(a_T_b, b_T_c, False), abs=1e-7 * joint.max())
    assert chain.pose.target == "a" and chain.pose.source == "c"
    between = relative(PoseCovariance(a_T_b, first), PoseCovariance(a_T_d, second), cross)
    assert between.matrix == pytest.approx(by_differences(a_T_b, a_T_d, True), abs=1e-7 * joint.max())
    assert between.pose.target == "b" and between.pose.source == "d"


def test_what_two_poses_share_cancels_between_them() -> None:
    rng = np.random.default_rng(4)
    shared = PoseCovariance(random_pose(rng, "base", "cell"), random_covariance(rng))
    exact = np.zeros((6, 6))
    parts = [PoseCovariance(random_pose(rng, "cell", name), exact) for name in ("left", "right")]
    placed = [compound(shared, part) for part in parts]
    # the error of `cell` reaches both: cov = Ad(left^-1) P Ad(right^-1)^T
    to = [adjoint(part.pose.inverse().matrix) for part in parts]
    cross = to[0] @ shared.matrix @ to[1].T
    between = relative(placed[0], placed[1], cross)
    assert np.abs(between.matrix).max() < 1e-12 * shared.matrix.max()
    with pytest.raises(EstimationError, match="Cross-covariance larger"):
        relative(placed[0], placed[1], 2 * cross)


def test_frames_must_meet() -> None:
    rng = np.random.default_rng(5)
    first, second = (PoseCovariance(random_pose(rng), np.eye(6)) for _ in range(2))
    with pytest.raises(FrameMismatch):
        compound(first, second)
    with pytest.raises(FrameMismatch, match="base_T_part merged with part_T_base"):
        merge(first, second.inverse())


@given(seeds)
def test_merging_does_not_depend_on_the_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_pose(rng)
    first, second = (
        PoseCovariance(truth.perturbed(rng.normal(size=6) * SCALE), random_covariance(rng)) for _ in range(2)
    )
    one, other = merge(first, second), merge(second, first)
    # charts 1e-4 apart: the difference is of second order
    assert log_pose((one.pose.inverse() @ other.pose).matrix) == pytest.approx(np.zeros(6), abs=1e-6)
    assert one.matrix == pytest.approx(other.matrix, abs=1e-3 * one.matrix.max())
    for covariance in (first.matrix, second.matrix):
        assert np.linalg.eigvalsh(covariance - one.matrix).min() > -1e-3 * covariance.max()


def test_merged_error_is_the_claimed_one_also_when_correlated() -> None:
    rng = np.random.default_rng(6)
    truth, joint = random_pose(rng), random_covariance(rng, 12)
    errors = rng.multivariate_normal(np.zeros(12), joint, size=800)
    normalised = []
    for error in errors:
        first = PoseCovariance(truth.perturbed(error[:6]), joint[:6, :6])
        second = PoseCovariance(truth.perturbed(error[6:]), joint[6:, 6:])
        merged = merge(first, second, joint[:6, 6:])
        left = log_pose((truth.inverse() @ merged.pose).matrix)
        normalised.append(left @ np.linalg.solve(merged.matrix, left))
    assert np.mean(normalised) == pytest.approx(6.0, abs=4 * math.sqrt(12 / 800))


def test_merging_an_estimate_with_itself_is_refused() -> None:
    first = PoseCovariance(random_pose(np.random.default_rng(7)), np.diag(SCALE**2))
    with pytest.raises(EstimationError, match="Drop one"):
        merge(first, first, cross=first.matrix)


def test_point_covariance_agrees_with_moved_points() -> None:
    rng = np.random.default_rng(8)
    covariance = PoseCovariance(random_pose(rng), random_covariance(rng))
    points = rng.uniform(-0.3, 0.3, (5, 3))
    claimed = covariance.point_covariance(points)
    steps = np.eye(6) * 1e-6
    jacobian = np.stack(
        [
            (covariance.pose.perturbed(s).points(points) - covariance.pose.perturbed(-s).points(points))
            / 2e-6
            for s in steps
        ],
        axis=-1,
    )
    expected = jacobian @ covariance.matrix @ jacobian.swapaxes(-1, -2)
    assert claimed == pytest.approx(expected, abs=1e-8 * expected.max())
    assert covariance.point_covariance(points[2]) == pytest.approx(claimed[2])
    # the points' own covariance turns with the pose
    own = np.diag([1e-8, 0.0, 0.0])
    turned = covariance.point_covariance(points, own) - claimed
    axis = covariance.pose.vectors(np.array([1.0, 0.0, 0.0]))
    assert turned == pytest.approx(np.broadcast_to(1e-8 * np.outer(axis, axis), (5, 3, 3)), abs=1e-20)
    assert covariance.in_form(Form.B).point_covariance(points) == pytest.approx(claimed)


def test_second_order_share_grows_with_rotation_and_distance() -> None:
    pose = Transform("base", "part", np.eye(4))
    fine = PoseCovariance(pose, np.diag([1e-10] * 3 + [1e-8] * 3))
    coarse = PoseCovariance(pose, np.diag([1e-10] * 3 + [1e-4] * 3))
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert np.all(np.diff(fine.second_order_share(points)) > 0)
    assert fine.second_order_share(points).max() < 0.01
    assert coarse.second_order_share(points[1:]).min() > 0.5
    flat = PoseCovariance(pose, np.diag([0.0] * 3 + [1e-4] * 3))
    assert flat.second_order_share(points).tolist() == [0.0, math.inf, math.inf]


@given(seeds)
def test_axes_of_many_points_are_those_of_each(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, points = PoseCovariance(random_pose(rng), random_covariance(rng)), rng.uniform(-0.3, 0.3, (20, 3))
    axes = point_axes(pose, points)
    assert axes == pytest.approx(ellipsoid(pose.point_covariance(points)).axes, rel=1e-6)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("estimation.covariance.COMPILED", False)
        assert point_axes(pose, points) == pytest.approx(axes, rel=1e-6)


def test_axes_of_a_ball_are_its_radius() -> None:
    pose = PoseCovariance(random_pose(np.random.default_rng(1)), np.diag([4e-8] * 3 + [0.0] * 3))
    assert point_axes(pose, np.ones((2, 3))) == pytest.approx(np.full((2, 3), 2e-4))


def test_ellipsoid_axes_and_volume() -> None:
    turn = exp_pose(np.array([0, 0, 0, 0.1, 0.2, 0.3]))[:3, :3]
    result = ellipsoid(np.stack([turn @ np.diag([4.0, 1.0, 9.0]) @ turn.T, np.zeros((3, 3))]))
    assert result.axes[0] == pytest.approx([3.0, 2.0, 1.0])
    assert np.abs(result.directions[0].T @ turn[:, 2]) == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert result.volume == pytest.approx([4 / 3 * math.pi * 6.0, 0.0])
    assert ellipsoid(np.diag([0.3162**2, 0.460**2])).volume == pytest.approx(0.457, abs=5e-4)  # Table 17


@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3).map(np.array), st.floats(-9.0, 0.0))
def test_right_jacobian(direction: FloatArray, exponent: float) -> None:
    rotation = direction * 10.0**exponent
    twist = np.concatenate([np.zeros(3), rotation])

    def moved(axis: FloatArray) -> FloatArray:
        return log_pose(exp_pose(-twist) @ exp_pose(twist + np.concatenate([np.zeros(3), axis])))[3:]

    numeric = np.column_stack([(moved(axis) - moved(-axis)) / 2e-5 for axis in 1e-5 * np.eye(3)])
    assert right_jacobian(rotation) == pytest.approx(numeric, abs=1e-8)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), r"shape \(3, 3\)"),
        (np.full((6, 6), math.nan), "not finite"),
        (np.eye(6) + np.eye(6, k=1) * 0.5, "symmetric"),
        (np.diag([1.0, 1, 1, 1, 1, -1e-9]), "negative"),
    ],
)
def test_refuses_what_is_no_covariance(matrix: FloatArray, message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        PoseCovariance(Transform("base", "part", np.eye(4)), matrix)
