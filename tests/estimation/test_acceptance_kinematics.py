"""Rows of ESTIMATION.md section 11 about arms: numbers that a correct implementation gives."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.kinematics import PARAMETER_NAMES, ArmModel
from estimation.transform import FloatArray, log_pose

Q_THESIS = np.radians([-25.0, 10.0, 5.0, 20.0, 40.0, 10.0])
angles = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)
deviations = st.lists(st.floats(-0.2, 0.2), min_size=30, max_size=30).map(np.array)


def test_row_6_irb1400_at_zero(irb1400: ArmModel) -> None:
    pose = irb1400.flange_pose(np.zeros(6))
    assert pose[:3, 3] * 1e3 == pytest.approx([955.0, 0.0, 1195.0], abs=1e-3)


def test_row_7_irb1400_at_a_general_pose(irb1400: ArmModel) -> None:
    pose = irb1400.flange_pose(Q_THESIS)
    assert pose[:3, 3] * 1e3 == pytest.approx([941.685, -418.496, 929.001], abs=1e-3)


def test_row_8_joint_noise_at_the_tool(irb1400: ArmModel) -> None:
    covariance = irb1400.tool_covariance(Q_THESIS, np.full(6, np.radians(0.0015)))[0]
    position_mm = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3]))[::-1] * 1e3
    rotation_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:]))[::-1])
    assert position_mm == pytest.approx([0.03151, 0.02702, 0.01048], rel=1e-3)
    assert rotation_deg == pytest.approx([0.002581, 0.002253, 0.001326], rel=1e-3)


@given(q=angles, sigma_rad=st.lists(st.floats(1e-6, 1e-3), min_size=6, max_size=6).map(np.array))
def test_row_9_rotation_variances_add_up_to_the_joint_variances(
    irb1400: ArmModel, q: FloatArray, sigma_rad: FloatArray
) -> None:
    covariance = irb1400.tool_covariance(q, sigma_rad)[0]
    assert np.trace(covariance[3:, 3:]) == pytest.approx((sigma_rad**2).sum(), rel=1e-12)


@settings(max_examples=40)
@given(q=angles, deviation=deviations)
def test_row_20_joint_and_parameter_jacobians(prbt: ArmModel, q: FloatArray, deviation: FloatArray) -> None:
    every = tuple((joint, name) for joint in range(6) for name in PARAMETER_NAMES)
    arm = ArmModel.from_dh(prbt.theta, prbt.d, prbt.a, prbt.alpha, free=every).with_deviation(deviation)
    flange, joint, parameter = (result[0] for result in arm.jacobians(q))
    assert flange == pytest.approx(arm.flange_pose(q), abs=1e-15)

    def by_differences(moved: NDArray[np.float64]) -> FloatArray:
        """Central difference (6,) from poses (2, 4, 4) half a step ahead and behind."""
        ahead, behind = (log_pose(np.linalg.inv(flange) @ pose) for pose in moved)
        return np.asarray((ahead - behind) / 2e-5)

    numeric_joint = np.column_stack(
        [by_differences(arm.flange_pose(q + np.outer([1e-5, -1e-5], e))) for e in np.eye(6)]
    )
    numeric_parameter = np.column_stack(
        [
            by_differences(np.stack([arm.with_deviation(s * e).flange_pose(q) for s in (1e-5, -1e-5)]))
            for e in np.eye(30)
        ]
    )
    for analytic, numeric in ((joint, numeric_joint), (parameter, numeric_parameter)):
        row_norm = np.linalg.norm(analytic, axis=1, keepdims=True)
        assert np.all(np.abs(analytic - numeric) <= 1e-6 * row_norm + 1e-10)


# Joint origins of the public URDF of the PRBT; every joint turns about its own +z.
PRBT_URDF = (
    ((0.0, 0.0, 0.2604), (0.0, 0.0, -np.pi)),
    ((0.0, 0.0, 0.0), (np.pi / 2, 0.0, 0.0)),
    ((0.0, 0.35, 0.0), (0.0, np.pi, 0.0)),
    ((0.0, 0.0, 0.0), (-np.pi / 2, np.pi, 0.0)),
    ((0.0, 0.0, 0.307), (np.pi / 2, 0.0, np.pi)),
    ((0.0, 0.084, 0.0), (-np.pi / 2, 0.0, 0.0)),
)


@given(q=angles)
def test_prbt_agrees_with_its_urdf(prbt: ArmModel, q: FloatArray) -> None:
    position, rotation = np.zeros(3), Rotation.identity()
    for (xyz, rpy), angle in zip(PRBT_URDF, q, strict=True):
        position = position + rotation.apply(xyz)
        rotation = rotation * Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec([0.0, 0.0, angle])
    pose = prbt.flange_pose(q)
    assert pose[:3, 3] == pytest.approx(position, abs=1e-12)
    assert pose[:3, :3] == pytest.approx(rotation.as_matrix(), abs=1e-12)
