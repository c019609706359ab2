"""Monte Carlo, all replicas at once: each replica ends where the estimator itself ends."""

import numpy as np
import pytest

from estimation.belief import Belief
from estimation.errors import EstimationError
from estimation.localization.points import SurfacePoints
from estimation.replicas import hand_eye, plane_pose
from estimation.replicas.hand_eye import PlaneHandEye, plane_hand_eye
from estimation.replicas.plane_pose import PlanePoses, plane_poses
from estimation.solver import update
from estimation.surfaces import plane
from estimation.tasks.laser import PointLaserOnPlane
from estimation.tasks.motion import Poses
from estimation.transform import FloatArray, Transform, log_pose
from tests.estimation.cube_plans import CubePlan, cube_plan
from tests.estimation.laser_plans import LaserPlan, laser_plan

SIGMA_M = 3e-5


def _hand_eye(plan: LaserPlan) -> PlaneHandEye:
    turned = plan.beam + np.array([0.02, 0.01, 0.0])
    start = (plan.origin_m + 2e-3, turned / np.linalg.norm(turned), plan.normal, plan.offset_m + 1e-3)
    variances = (np.full(len(plan.weights), SIGMA_M**2), np.zeros(len(plan.weights)))
    return plane_hand_eye(plan.rotations, plan.positions_m, plan.ranges_m, variances, start)


def _poses(plan: CubePlan) -> PlanePoses:
    start = plan.base_T_cube.perturbed(np.array([2e-3, -1e-3, 1e-3, 0.01, 0.02, -0.01]))
    return plane_poses(plan.base_p, plan.normals, plan.offsets_m, plan.weights, start)


def _along(axis: FloatArray, origin_m: FloatArray, names: tuple[str, str]) -> Transform:
    """A frame with its z along an axis that is nearly z already."""
    x = np.cross([0.0, 1.0, 0.0], axis)
    matrix = np.eye(4)
    matrix[:3, 0] = x / np.linalg.norm(x)
    matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = np.cross(axis, matrix[:3, 0]), axis, origin_m
    return Transform(*names, matrix)


def test_replicas_of_a_hand_eye_end_where_the_estimator_ends() -> None:
    plan = laser_plan(100, sigma_m=SIGMA_M)
    found = _hand_eye(plan)
    deviations = np.sqrt(np.diag(found.covariance))
    flange = np.tile(np.eye(4), (len(plan.weights), 1, 1))
    flange[:, :3, :3], flange[:, :3, 3] = plan.rotations, plan.positions_m
    starts = {
        "laser": _along(plan.beam, plan.origin_m, ("flange", "laser")),
        "plane": _along(plan.normal, plan.normal * plan.offset_m, ("base", "plane")),
    }
    for k, ranges in enumerate(plan.ranges_m):
        problem = PointLaserOnPlane(motion=Poses(flange), reading_m=ranges, std_m=SIGMA_M)
        belief = update(problem.belief().started(starts), problem.model()).belief
        laser, plate = belief.transform("laser").matrix, belief.transform("plane").matrix
        gap = [
            *(found.origin_m[k] - laser[:3, 3]),
            *((found.beam[k] - laser[:3, 2]) @ found.beam_across),
            *((found.normal[k] - plate[:3, 2]) @ found.normal_across),
            found.offset_m[k] - plate[:3, 2] @ plate[:3, 3],
        ]
        assert np.max(np.abs(gap) / deviations) < 1e-3


def test_replicas_of_a_pose_end_where_the_estimator_ends() -> None:
    plan = cube_plan(100, sigma_m=SIGMA_M)
    found = _poses(plan)
    deviations = np.sqrt(np.diag(found.covariance))
    features = tuple(plane(name, 0.1 * axis, axis) for name, axis in zip("xyz", np.eye(3), strict=True))
    belief = Belief().with_block("cube", plan.base_T_cube, std=np.inf)
    noise = np.tile(SIGMA_M**2 * np.eye(3), (len(plan.weights), 1, 1))
    for k, points in enumerate(plan.base_p):
        model = SurfacePoints(points, noise, features, plan.normals.argmax(axis=1), (), "cube")
        exact = update(belief, model).belief.transform("cube").matrix
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = found.rotations[k], found.origins_m[k]
        assert np.max(np.abs(log_pose(np.linalg.inv(exact) @ own)) / deviations) < 1e-3


def test_numpy_gives_the_same_replicas(monkeypatch: pytest.MonkeyPatch) -> None:
    laser, cube = laser_plan(200), cube_plan(200)
    compiled = _hand_eye(laser), _poses(cube)
    monkeypatch.setattr(hand_eye, "COMPILED", False)
    monkeypatch.setattr(plane_pose, "COMPILED", False)
    plain = _hand_eye(laser), _poses(cube)
    assert compiled[0].origin_m == pytest.approx(plain[0].origin_m, abs=1e-12)
    assert compiled[0].beam == pytest.approx(plain[0].beam, abs=1e-11)
    assert compiled[0].normal == pytest.approx(plain[0].normal, abs=1e-12)
    assert compiled[0].offset_m == pytest.approx(plain[0].offset_m, abs=1e-12)
    assert compiled[0].iterations == plain[0].iterations
    assert compiled[1].origins_m == pytest.approx(plain[1].origins_m, abs=1e-12)
    assert compiled[1].rotations == pytest.approx(plain[1].rotations, abs=1e-12)


def test_scatter_of_replicas_is_the_predicted_one() -> None:
    found = _hand_eye(laser_plan(4000))
    predicted = np.sqrt(np.diag(found.covariance))[:3]
    assert found.origin_m.std(axis=0) / predicted == pytest.approx(np.ones(3), abs=0.05)
    plan = cube_plan(4000)
    poses = _poses(plan)
    scatter = ((poses.origins_m - plan.base_T_cube.matrix[:3, 3]) @ plan.base_T_cube.rotation).std(axis=0)
    assert scatter / np.sqrt(np.diag(poses.covariance))[:3] == pytest.approx(np.ones(3), abs=0.05)


def test_plans_that_leave_a_freedom_open_are_refused() -> None:
    plan = laser_plan(10)
    same = np.repeat(plan.rotations[:1], 28, axis=0)
    start = (plan.origin_m, plan.beam, plan.normal, plan.offset_m)
    with pytest.raises(EstimationError, match="freedom"):
        plane_hand_eye(same, plan.positions_m, plan.ranges_m, (np.zeros(28), np.full(28, SIGMA_M**2)), start)
    cube = cube_plan(10)
    with pytest.raises(EstimationError, match="freedom"):
        plane_poses(
            cube.base_p, np.tile([1.0, 0.0, 0.0], (26, 1)), cube.offsets_m, cube.weights, cube.base_T_cube
        )


def test_noise_too_large_for_the_shared_hessian_is_refused() -> None:
    plan = laser_plan(50, sigma_m=0.03)
    with pytest.raises(EstimationError, match="did not settle"):
        _hand_eye(plan)
