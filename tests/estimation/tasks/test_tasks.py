"""Each task on random cells: no guess is given, and the truth is where the result says it is."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimation.model import values_of
from estimation.solver import update
from estimation.tasks.findings import Cause, Status, TaskRefused
from estimation.tasks.laser import PointLaserOnPlane
from estimation.tasks.motion import Joints, Poses
from estimation.tasks.solve import Result, solve
from estimation.transform import FloatArray, Transform, exp_pose, log_pose
from tests.estimation.tasks.cells import (
    CELLS,
    RANGE_STD_M,
    Cell,
    Make,
    camera_hand_eye,
    point_laser_plane,
    point_laser_planes,
    to_plane,
)
from tests.estimation.tasks.pair_cells import PAIR_CELLS
from tests.estimation.tasks.two_robot_cells import TWO_ROBOT_CELLS
from tests.estimation.twin import LASER, PLATE_M, Sizes, Truth, arm
from tests.estimation.twin_poses import plate_poses

SEEDS = (11,)
ALL_CELLS: dict[str, Make] = {**CELLS, **PAIR_CELLS, **TWO_ROBOT_CELLS}


def normalised_error(result: Result, truth: dict[str, FloatArray]) -> tuple[float, int]:
    """Squared error of the flat blocks by their joint covariance, and the number of freedoms."""
    gaps = []
    for name, true in truth.items():
        value = result.belief.value(name)
        freedoms = result.belief.block(name).freedoms
        if not isinstance(value, Transform):
            gaps.append(true - value)
            continue
        gap = np.linalg.inv(value.matrix) @ true
        axis = gap[:3, 2]
        if "rz" in freedoms or "rx" not in freedoms:
            gaps.append(log_pose(gap)[result.belief.block(name).active])
        elif "tx" in freedoms:  # a beam: its spin means nothing
            gaps.append(np.array([*gap[:3, 3], -axis[1], axis[0]]))
        else:  # a plane: its height where the result has its origin, and its tilt
            gaps.append(np.array([axis @ gap[:3, 3] / axis[2], -axis[1], axis[0]]))
    error = np.concatenate(gaps)
    covariance = result.belief.marginal(truth).covariance
    return float(error @ np.linalg.solve(covariance, error)), len(error)


@pytest.mark.parametrize("name", ALL_CELLS)
@pytest.mark.parametrize("seed", SEEDS)
def test_no_guess_is_needed_and_the_truth_is_within_the_covariance(name: str, seed: int) -> None:
    cell = ALL_CELLS[name](np.random.default_rng(seed))
    result = solve(cell.problem)
    assert result.status is Status.OK, result.findings
    error, freedoms = normalised_error(result, cell.truth)
    assert error < freedoms + 5.0 * np.sqrt(2.0 * freedoms)
    assert np.linalg.eigvalsh(result.belief.marginal(cell.truth).covariance).min() > 0.0
    assert result.rank is not None
    assert result.rank.complete
    for block in cell.truth:
        total = np.sum(list(result.budget(block).values()), axis=0)
        assert total == pytest.approx(np.diag(result.covariance(block)))


@pytest.mark.parametrize("name", ALL_CELLS)
def test_jacobians_are_those_of_central_differences(name: str) -> None:
    cell = ALL_CELLS[name](np.random.default_rng(21))
    estimate = solve(cell.problem).belief
    model = cell.problem.model().weighed_at(values_of(estimate))
    jacobian = model.rows(values_of(estimate)).jacobian
    for block in estimate.blocks:
        analytic = jacobian[block.name][:, block.active]
        for column in range(min(analytic.shape[1], 12)):
            sides = []
            for step in (1e-6, -1e-6):
                if isinstance(block.value, Transform):
                    xi = np.zeros(6)
                    xi[block.active[column]] = step
                    moved: Transform | FloatArray = block.value.perturbed(xi)
                else:
                    moved = block.value + step * np.eye(block.value.size)[column]
                sides.append(model.rows({**values_of(estimate), block.name: moved}).residual_m)
            numeric = (sides[0] - sides[1]) / 2e-6
            scale = np.maximum(np.linalg.norm(analytic, axis=1), 1e-3)
            assert np.all(np.abs(analytic[:, column] - numeric) < 1e-6 * scale + 1e-8)


def laser_cell(seed: int = 5) -> Cell:
    return point_laser_plane(np.random.default_rng(seed))


def causes(result: Result) -> set[Cause]:
    return {finding.cause for finding in result.findings}


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (
            lambda poses: poses * np.where(np.arange(len(poses)) == 3, np.nan, 1.0)[:, None, None],
            "NOT_FINITE",
        ),
        (lambda poses: poses[:, :3], "WRONG_SHAPE"),
        (lambda poses: poses * [1.0, 1.0, -1.0, 1.0], "LEFT_HANDED"),
        (lambda poses: poses * [1.0, 1.01, 1.0, 1.0], "NOT_A_ROTATION"),
        (lambda poses: poses * np.array([1.0, 1.0, 1.0, 1e3]) ** (np.arange(4) < 3)[:, None], "WRONG_UNITS"),
        (lambda poses: poses.swapaxes(1, 2), "NOT_A_ROTATION"),
    ],
    ids=["nan", "shape", "left-handed", "skewed", "mm", "transposed"],
)
def test_numbers_that_are_no_poses_are_refused_at_sight(
    change: Callable[[FloatArray], FloatArray], cause: str
) -> None:
    problem = laser_cell().problem
    poses = change(problem.motion.base_T_flange)
    result = solve(replace(problem, motion=replace(problem.motion, base_T_flange=poses)))
    assert result.status is Status.REFUSED
    assert Cause[cause] in causes(result)
    assert result.values == {}
    with pytest.raises(TaskRefused, match="was refused"):
        _ = result.belief


def with_rotations(problem: object, turn: FloatArray) -> Poses:
    """The poses of the problem, with the orientations replaced."""
    poses = problem.motion.base_T_flange.copy()  # type: ignore[attr-defined]
    poses[:, :3, :3] = turn
    return replace(problem.motion, base_T_flange=poses)  # type: ignore[attr-defined,no-any-return]


def test_orientations_that_leave_the_mount_open_are_named() -> None:
    problem = laser_cell().problem
    count, rng = len(problem.motion), np.random.default_rng(1)
    axis = np.array([0.6, 0.0, 0.8])
    cases = {
        Cause.CONSTANT_ORIENTATION: np.tile(np.eye(3), (count, 1, 1)),
        Cause.SMALL_ROTATIONS: Rotation.from_rotvec(rng.uniform(-0.008, 0.008, (count, 3))).as_matrix(),
        Cause.ONE_AXIS: Rotation.from_rotvec(np.outer(rng.uniform(-1, 1, count), axis)).as_matrix(),
    }
    for cause, turn in cases.items():
        result = solve(replace(problem, motion=with_rotations(problem, turn)))
        assert result.status is Status.REFUSED
        assert causes(result) == {cause}


def test_too_few_and_copied_measurements() -> None:
    problem = laser_cell().problem
    few = replace(
        problem,
        motion=replace(problem.motion, base_T_flange=problem.motion.base_T_flange[:7]),
        reading_m=problem.reading_m[:7],
    )
    assert Cause.TOO_FEW in causes(solve(few))
    again = np.arange(len(problem.reading_m)) % 6
    copied = replace(
        problem,
        motion=replace(problem.motion, base_T_flange=problem.motion.base_T_flange[again]),
        reading_m=problem.reading_m[again],
    )
    assert solve(copied).status is Status.REFUSED
    assert Cause.DUPLICATED in causes(solve(copied))


def test_one_gross_outlier_is_left_out_and_flagged() -> None:
    cell = laser_cell()
    reading = cell.problem.reading_m.copy()
    reading[4] += 5e-3
    result = solve(replace(cell.problem, reading_m=reading))
    assert result.status is Status.FLAGGED
    assert causes(result) == {Cause.OUTLIER}
    assert np.flatnonzero(result.rejected).tolist() == [4]
    error, freedoms = normalised_error(result, cell.truth)
    assert error < freedoms + 5.0 * np.sqrt(2.0 * freedoms)


@pytest.mark.filterwarnings("error")
def test_readings_of_a_plate_that_was_moved_meanwhile_are_refused() -> None:
    cell = laser_cell()
    reading = cell.problem.reading_m.copy()
    reading[::5] += 3e-3
    result = solve(replace(cell.problem, reading_m=reading))
    assert result.status is Status.REFUSED
    assert causes(result) == {Cause.CLUSTERED_OUTLIERS}


@pytest.mark.filterwarnings("error")
def test_faces_that_are_parallel_to_one_line_leave_the_part_to_slide() -> None:
    problem = point_laser_planes(np.random.default_rng(3)).problem
    rows = np.flatnonzero(np.isin(problem.face_index, [0, 2]))
    result = solve(
        replace(
            problem,
            motion=replace(problem.motion, base_T_flange=problem.motion.base_T_flange[rows]),
            reading_m=problem.reading_m[rows],
            face_index=problem.face_index[rows],
        )
    )
    assert result.status is Status.REFUSED
    assert causes(result) == {Cause.SYMMETRIC}


@pytest.mark.filterwarnings("error")
def test_markers_on_a_line_leave_the_object_to_turn() -> None:
    problem = camera_hand_eye(np.random.default_rng(3)).problem
    line = np.outer(np.linspace(-1.0, 1.0, len(problem.markers_m)), [0.06, 0.03, 0.0])
    result = solve(replace(problem, markers_m=line))
    assert result.status is Status.REFUSED
    assert causes(result) == {Cause.COLLINEAR}


def test_poses_the_wrong_way_round_are_recognised() -> None:
    problem = camera_hand_eye(np.random.default_rng(3)).problem
    inverse = np.linalg.inv(problem.motion.base_T_flange)
    result = solve(replace(problem, motion=replace(problem.motion, base_T_flange=inverse)))
    assert result.status is Status.REFUSED
    assert Cause.INVERTED in causes(result)


def test_exchanged_faces_and_one_face_are_recognised() -> None:
    problem = point_laser_planes(np.random.default_rng(3)).problem
    exchanged = np.array([1, 0, 2, 3])[problem.face_index]
    result = solve(replace(problem, face_index=exchanged))
    assert result.status is Status.REFUSED
    assert Cause.WRONG_SURFACE in causes(result)
    one = replace(problem, face_index=np.zeros_like(problem.face_index))
    assert causes(solve(one)) == {Cause.ONE_FACE}


def test_the_sensitivity_to_a_shared_error_gives_its_correlation() -> None:
    problem = replace(laser_cell().problem, scale_std=1e-3)
    result = solve(problem)
    sensitivity = result.sensitivity("laser", "laser.scale")
    place = result.belief.index("laser"), result.belief.index("laser.scale")
    assert sensitivity * 1e-6 == pytest.approx(result.belief.covariance[place], rel=1e-9)
    start = problem.belief().started({name: result.values[name] for name in ("laser", "plane")})
    held = update(start, problem.model(), consider=("laser.scale",))
    assert held.belief.std("laser.scale") == pytest.approx([1e-3])


def joints_cell() -> tuple[PointLaserOnPlane, Truth]:
    """The twin's laser on its plate: joints instead of poses, and an arm that is not its nominal self."""
    rng, sizes = np.random.default_rng(7), Sizes(scale=0.0, offset_m=0.0, placed_m=0.0, placed_rad=0.0)
    truth, q = Truth.drawn(rng, sizes), plate_poses(60)
    origin, beam = truth.beams(q + rng.normal(size=q.shape) * sizes.joint_rad)
    reading = to_plane(origin, beam, PLATE_M, np.array([0.0, 0.0, 1.0])) + rng.normal(size=60) * RANGE_STD_M
    spread = [sizes.length_m if name in ("d", "a") else sizes.angle_rad for _, name in arm().free]
    motion = Joints(arm(), q, std_rad=sizes.joint_rad, kinematics_std=spread)
    return PointLaserOnPlane(motion=motion, reading_m=reading, std_m=RANGE_STD_M), truth


def test_joints_of_an_uncertain_arm_are_calibrated_together_with_the_laser() -> None:
    problem, truth = joints_cell()
    result = solve(problem)
    assert result.status is Status.OK, result.findings
    mount = np.eye(4)
    mount[:3, 3] = LASER
    laser = mount @ exp_pose(truth.laser)
    error, freedoms = normalised_error(result, {"laser": laser, "kinematics": truth.kinematics})
    assert freedoms == 23
    assert error < 23 + 5.0 * np.sqrt(46.0)
    assert result.budget("laser")["kinematics"].max() > 0.0


def test_exchanged_joints_and_degrees_are_recognised() -> None:
    problem, _ = joints_cell()
    joints = problem.motion.joints_rad  # type: ignore[attr-defined]
    for given, cause in (
        (joints[:, [0, 1, 2, 4, 3, 5]], Cause.SWAPPED_JOINTS),
        (np.degrees(joints), Cause.WRONG_UNITS),
        (np.radians(joints), Cause.WRONG_UNITS),
    ):
        result = solve(replace(problem, motion=replace(problem.motion, joints_rad=given)))  # type: ignore[type-var]
        assert result.status is Status.REFUSED
        assert cause in causes(result), result.findings
