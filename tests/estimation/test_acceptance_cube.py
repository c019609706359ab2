"""Rows 1 to 5 of ESTIMATION.md section 11: cubes and squares located by points on their sides.

One unit of the thesis is a millimetre here, so that the cube stands within reach of an arm.
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.belief import Belief
from estimation.covariance import PoseCovariance, ellipsoid
from estimation.inverse_kinematics import solve
from estimation.kinematics import ArmModel
from estimation.measurement import Chain, Observations
from estimation.solver import update
from estimation.surfaces import plane
from estimation.transform import FloatArray, Transform, log_pose, skew

MM = 1e-3
CORNER_MM = np.array([100.0, 100.0, 100.0])
FIRST_ORDER = {  # side covered (mm): principal standard deviations of the corner for sigma = 1
    100.0: (0.6184, 0.6184, 0.1826),
    30.0: (2.4773, 2.4773, 0.1826),
    10.0: (7.8436, 7.8436, 0.1826),
}
BASE_T_CUBE = Transform.from_xyz_rpy(
    "base", "cube", np.array([0.30, -0.05, 0.25]), np.array([0.1, -0.2, 0.3])
)


def cube_points(length_mm: float) -> tuple[FloatArray, FloatArray]:
    """Points (90, 3) in mm and normals (90, 3): each face through the origin, along both of its edges."""
    steps = length_mm * np.arange(1, 16) / 15
    lines = [(face, edge) for face in range(3) for edge in range(3) if edge != face]
    points = np.concatenate([np.outer(steps, np.eye(3)[edge]) for _, edge in lines])
    normals = np.repeat(np.eye(3)[[face for face, _ in lines]], 15, axis=0)
    return points, normals


def rows(points: FloatArray, normals: FloatArray) -> FloatArray:
    """Signed distances by the pose of the cube, n^T [I | -[p]x], up to their common sign."""
    return np.concatenate([normals, np.cross(points, normals)], axis=-1)


def touches(arm: ArmModel, cube_p_m: FloatArray, face: NDArray[np.intp], sigma_m: float) -> Observations:
    """The arm's flange, as an ideal stylus, at points (m, 3) of the cube."""
    pose = np.tile(np.eye(4), (len(cube_p_m), 1, 1))
    pose[:, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    pose[:, :3, 3] = BASE_T_CUBE.points(cube_p_m)
    joints, valid = solve(arm, pose)
    assert valid.any(axis=1).all()
    count = len(cube_p_m)
    return Observations(
        sensor="probe",
        object="cube",
        joints_rad=joints[np.arange(count), valid.argmax(axis=1)],
        joint_variance=np.zeros((count, 6)),
        reading_m=np.zeros(count),
        reading_variance=np.full(count, sigma_m**2),
        surface_variance=np.zeros(count),
        features=tuple(plane(name, np.zeros(3), axis) for name, axis in zip("xyz", np.eye(3), strict=True)),
        feature_index=face,
    )


def belief_without_knowledge() -> Belief:
    """An exact stylus, and a cube whose prior is far too wide to matter."""
    return (
        Belief()
        .with_block("probe", Transform("flange", "probe", np.eye(4)), std=0.0)
        .with_block("cube", BASE_T_CUBE, std=[1e3] * 3 + [1e4] * 3)
    )


def fit_all(measured: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least-squares poses of many cubes at once: rotations (r, 3, 3), origins (r, 3) from (r, 90, 3)."""
    rotation, origin = np.tile(np.eye(3), (len(measured), 1, 1)), np.zeros((len(measured), 3))
    for _ in range(60):
        seen = (measured - origin[:, None]) @ rotation
        jacobian = -rows(np.broadcast_to(seen, measured.shape), np.broadcast_to(normals, measured.shape))
        gradient = jacobian.swapaxes(1, 2) @ (normals * seen).sum(axis=-1)[..., None]
        step = -np.linalg.solve(jacobian.swapaxes(1, 2) @ jacobian, gradient)[..., 0]
        origin += (rotation @ step[:, :3, None])[..., 0]
        rotation = rotation @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
        if np.abs(step).max() < 1e-9:
            return rotation, origin
    raise AssertionError("a fit did not converge")


def corner_axes_by_monte_carlo(length_mm: float, sigma_mm: float, runs: int, seed: int) -> FloatArray:
    """Principal standard deviations (3,) of the corner, mm, with noise along all three axes."""
    points, normals = cube_points(length_mm)
    noise = sigma_mm * np.random.default_rng(seed).normal(size=(runs, *points.shape))
    rotation, origin = fit_all(points + noise, normals)
    return ellipsoid(np.cov((rotation @ CORNER_MM + origin).T)).axes


@pytest.mark.parametrize("length_mm", FIRST_ORDER)
def test_row_1_first_order_uncertainty_of_a_cube_corner(length_mm: float) -> None:
    jacobian = rows(*cube_points(length_mm))
    cube = PoseCovariance(BASE_T_CUBE, np.asarray(np.linalg.inv(jacobian.T @ jacobian)))
    axes = ellipsoid(cube.point_covariance(CORNER_MM)).axes
    assert axes == pytest.approx(FIRST_ORDER[length_mm], rel=5e-4)


@pytest.mark.parametrize("length_mm", FIRST_ORDER)
def test_row_1_by_the_estimator_of_the_cell(prbt: ArmModel, length_mm: float) -> None:
    points, normals = cube_points(length_mm)
    observed = touches(prbt, points * MM, normals.argmax(axis=1), sigma_m=1 * MM)
    result = update(belief_without_knowledge(), Chain(prbt, [observed]))
    cube = PoseCovariance(result.belief.transform("cube"), result.belief.block_covariance("cube"))
    axes_mm = ellipsoid(cube.point_covariance(CORNER_MM * MM)).axes / MM
    assert axes_mm == pytest.approx(FIRST_ORDER[length_mm], rel=5e-4)


@pytest.mark.parametrize("length_mm", FIRST_ORDER)
def test_row_2_monte_carlo_agrees_with_first_order(length_mm: float) -> None:
    axes = corner_axes_by_monte_carlo(length_mm, sigma_mm=0.1, runs=2000, seed=2)
    assert axes == pytest.approx(0.1 * np.array(FIRST_ORDER[length_mm]), rel=0.06)


def test_row_3_monte_carlo_beyond_first_order() -> None:
    axes = corner_axes_by_monte_carlo(10.0, sigma_mm=1.0, runs=3000, seed=3)
    assert axes[2] == pytest.approx(0.44, abs=0.04)


def test_monte_carlo_and_the_cell_have_the_same_estimator(prbt: ArmModel) -> None:
    points, normals = cube_points(30.0)
    measured = points + np.random.default_rng(4).normal(size=points.shape)
    rotation, origin = fit_all(measured[None], normals)
    observed = touches(prbt, measured * MM, normals.argmax(axis=1), sigma_m=1 * MM)
    found = update(belief_without_knowledge(), Chain(prbt, [observed])).belief.transform("cube")
    by_batch = np.eye(4)
    by_batch[:3, :3], by_batch[:3, 3] = rotation[0], origin[0] * MM
    apart = log_pose(np.linalg.inv(by_batch) @ BASE_T_CUBE.inverse().matrix @ found.matrix)
    assert np.abs(apart).max() < 1e-8


@pytest.mark.parametrize(
    ("positions", "second_axis"),
    [
        (np.linspace(5, 95, 100), 0.6805),
        (np.concatenate([np.linspace(0, 5, 50), np.linspace(95, 100, 50)]), 0.4590),
    ],
    ids=["pattern", "planned"],
)
def test_row_4_square(positions: FloatArray, second_axis: float) -> None:
    ones, zeros = np.ones(100), np.zeros(100)
    jacobian = np.concatenate(
        [np.column_stack([zeros, ones, positions]), np.column_stack([ones, zeros, -positions])]
    )
    covariance = 0.1 * 100 * np.linalg.inv(jacobian.T @ jacobian)  # sigma^2 / n = 0.1
    to_corner = np.array([[1.0, 0.0, -100.0], [0.0, 1.0, 100.0]])
    axes = ellipsoid(to_corner @ covariance @ to_corner.T).axes
    assert axes == pytest.approx([second_axis, 0.31623], rel=5e-4)


@pytest.mark.parametrize(
    ("counts", "condition", "noise_index"),
    [((2, 2, 2), 507.3, 4.244e5), ((4, 2, 1), 567.7, 4.719e5)],
    ids=["corners twice", "four by two along the edges"],
)
def test_row_5_condition_of_the_identification_jacobian(
    counts: tuple[int, int, int], condition: float, noise_index: float
) -> None:
    size_mm = np.array([100.0, 400.0, 100.0])
    across, along, repeats = counts
    points, normals = [], []
    for face in range(3):
        first, second = (axis for axis in range(3) if axis != face)
        for u in np.linspace(0, size_mm[first], across):
            for v in np.linspace(0, size_mm[second], along):
                points += [u * np.eye(3)[first] + v * np.eye(3)[second]] * repeats
                normals += [np.eye(3)[face]] * repeats
    singular = np.linalg.svd(rows(np.array(points), np.array(normals)), compute_uv=False)
    assert len(points) == 24
    assert singular[0] / singular[-1] == pytest.approx(condition, rel=1e-3)
    assert singular[0] ** 2 / singular[-1] == pytest.approx(noise_index, rel=1e-3)


def test_rows_are_those_of_a_moved_cube() -> None:
    """Row 20 for n^T [I | -[p]x], by central differences of the signed distance."""
    points, normals = cube_points(100.0)
    pose = Transform("base", "cube", np.eye(4))
    numeric = np.column_stack(
        [
            (normals * (pose.perturbed(step).points(points) - pose.perturbed(-step).points(points))).sum(
                axis=1
            )
            / 2e-5
            for step in np.eye(6) * 1e-5
        ]
    )
    analytic = np.concatenate([normals, -(normals[:, None] @ skew(points))[:, 0]], axis=1)
    assert rows(points, normals) == pytest.approx(analytic, abs=1e-12)
    assert np.abs(numeric - analytic).max() < 1e-6 * np.linalg.norm(analytic, axis=1).min()
