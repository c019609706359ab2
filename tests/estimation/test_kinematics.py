import numpy as np
import pytest

from estimation.errors import EstimationError
from estimation.kinematics import ArmModel
from estimation.transform import exp_pose


def test_batches_agree_with_single_poses(prbt: ArmModel) -> None:
    q = np.random.default_rng(1).uniform(-2, 2, (5, 6))
    flange, joint, parameter = prbt.jacobians(q)
    assert (flange.shape, joint.shape, parameter.shape) == ((5, 4, 4), (5, 6, 6), (5, 6, 18))
    for index in range(5):
        single = prbt.jacobians(q[index : index + 1])
        for batch, alone in zip((flange, joint, parameter), single, strict=True):
            assert batch[index] == pytest.approx(alone[0], abs=1e-15)
        assert prbt.flange_pose(q[index]) == pytest.approx(flange[index], abs=1e-15)


def test_no_poses_give_empty_results(prbt: ArmModel) -> None:
    flange, joint, parameter = prbt.jacobians(np.empty((0, 6)))
    assert (flange.shape, joint.shape, parameter.shape) == ((0, 4, 4), (0, 6, 6), (0, 6, 18))


def test_arm_without_free_parameters_has_an_empty_parameter_jacobian(irb1400: ArmModel) -> None:
    assert irb1400.jacobians(np.zeros((2, 6)))[2].shape == (2, 6, 0)


def test_deviation_acts_on_the_named_parameter_only(prbt: ArmModel) -> None:
    assert prbt.parameter_labels[:6] == ("a1", "alpha1", "theta2", "a2", "alpha2", "beta2")
    delta = np.zeros(18)
    delta[prbt.parameter_labels.index("d4")] = 1e-3
    longer = prbt.with_deviation(delta)
    assert longer.d - prbt.d == pytest.approx([0, 0, 0, 1e-3, 0, 0])
    assert longer.alpha == pytest.approx(prbt.alpha)
    assert longer.parameter_labels == prbt.parameter_labels


def test_tool_covariance_is_that_of_sampled_poses(prbt: ArmModel) -> None:
    rng = np.random.default_rng(2)
    q, sigma_rad = np.array([0.3, -0.4, 1.9, 0.2, 0.9, -0.5]), np.full(6, 2e-5)
    flange_T_tool = exp_pose(np.array([0.08, 0.0, 0.15, 0.1, 0.2, 0.3]))
    claimed = prbt.tool_covariance(q, sigma_rad, flange_T_tool)[0]
    sampled_q = q + rng.normal(size=(40_000, 6)) * sigma_rad
    tool = prbt.flange_pose(q) @ flange_T_tool
    position = (prbt.flange_pose(sampled_q) @ flange_T_tool)[:, :3, 3]
    in_tool = (position - tool[:3, 3]) @ tool[:3, :3]
    sampled = np.cov(in_tool.T)
    assert sampled == pytest.approx(claimed[:3, :3], abs=0.03 * np.trace(claimed[:3, :3]))


def test_the_model_keeps_its_own_numbers() -> None:
    theta = np.zeros(2)
    arm = ArmModel.from_dh(theta, [0, 0], [1, 1], [0, 0])
    theta[0] = 1.0
    assert arm.flange_pose(np.zeros(2))[:3, 3] == pytest.approx([2.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="read-only"):
        arm.theta[0] = 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"d": [0.0]}, r"2 values of theta, but d has shape \(1,\)"),
        ({"lower_rad": [1.0, 0.0], "upper_rad": [0.5, 1.0]}, "Joint 1 runs from 1.0000 to 0.5000 rad"),
        ({"free": [(2, "a")]}, "'a' of joint 3"),
        ({"free": [(0, "gamma")]}, "'gamma' of joint 1"),
    ],
)
def test_refuses_inconsistent_arms(changes: dict[str, object], message: str) -> None:
    sound: dict[str, object] = {"theta": [0, 0], "d": [0, 0], "a": [1, 1], "alpha": [0, 0]}
    with pytest.raises(EstimationError, match=message):
        ArmModel.from_dh(**(sound | changes))  # type: ignore[arg-type]


def test_refuses_a_deviation_of_another_length(prbt: ArmModel) -> None:
    with pytest.raises(EstimationError, match=r"\(3,\) for 18 free"):
        prbt.with_deviation(np.zeros(3))
