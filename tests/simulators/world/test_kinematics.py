"""Forward kinematics against the joint chain of the public URDF of the PRBT."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray
from simulators.world.kinematics import TrueArm
from simulators.world.truth import Truth

# Origin xyz (m) and rpy (rad) of each joint in its parent; every joint turns about its own z.
PI = np.pi
URDF = (
    ((0, 0, 0.2604), (0, 0, -PI)),
    ((0, 0, 0), (PI / 2, 0, 0)),
    ((0, 0.35, 0), (0, PI, 0)),
    ((0, 0, 0), (-PI / 2, PI, 0)),
    ((0, 0, 0.307), (PI / 2, 0, PI)),
    ((0, 0.084, 0), (-PI / 2, 0, 0)),
)


def urdf_flange(joints_rad: list[float]) -> FloatArray:
    pose = np.eye(4)
    for (xyz, rpy), angle in zip(URDF, joints_rad, strict=True):
        joint = np.eye(4)
        joint[:3, :3] = (Rotation.from_euler("xyz", rpy) * Rotation.from_euler("z", angle)).as_matrix()
        joint[:3, 3] = xyz
        pose = pose @ joint
    return pose


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_the_nominal_arm_is_the_arm_of_the_urdf(nominal: Truth, joints_rad: list[float]) -> None:
    arm = TrueArm(nominal.link_parameters)
    np.testing.assert_allclose(arm.flange_pose(np.array(joints_rad)), urdf_flange(joints_rad), atol=1e-12)


def test_a_pose_is_not_changed_by_the_next(nominal: Truth) -> None:
    arm = TrueArm(nominal.link_parameters)
    upright = arm.flange_pose(np.zeros(6))
    kept = upright.copy()
    arm.flange_pose(np.ones(6))
    np.testing.assert_array_equal(upright, kept)
    np.testing.assert_allclose(kept[:3, 3], [0, 0, 0.2604 + 0.35 + 0.307 + 0.084], atol=1e-12)


def test_beta_turns_about_y_after_alpha() -> None:
    theta, d, a, alpha, beta = parameters = (0.3, 0.1, 0.2, -0.4, 0.05)
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_euler("ZXY", [theta + 0.7, alpha, beta]).as_matrix()
    expected[:3, 3] = [a * np.cos(theta + 0.7), a * np.sin(theta + 0.7), d]
    np.testing.assert_allclose(
        TrueArm(np.array([parameters])).flange_pose(np.array([0.7])), expected, atol=1e-15
    )
