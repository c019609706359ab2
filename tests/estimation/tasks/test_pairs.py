"""Hand-eye from pairs of poses and of moves: beside OpenCV, against the truth, and of data that are wrong."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimation.model import pose_of, values_of
from estimation.solver import predicted_belief
from estimation.statistics import chi_square_two_sided
from estimation.tasks import closed_forms
from estimation.tasks.findings import Cause, Status
from estimation.tasks.motion import Joints
from estimation.tasks.pairs import PosePairs
from estimation.tasks.solve import solve
from estimation.transform import FloatArray
from tests.estimation.tasks import opencv
from tests.estimation.tasks.cells import Cell
from tests.estimation.tasks.layout import USUAL, anywhere, reported
from tests.estimation.tasks.pair_cells import (
    SENSOR_STD,
    move_pairs,
    noisy,
    pose_pairs,
    pose_pairs_beside,
    views,
)
from tests.estimation.tasks.test_tasks import causes, normalised_error
from tests.estimation.twin import arm

Change = Callable[[FloatArray], FloatArray]


def by_name(flange: FloatArray, seen: FloatArray) -> dict[str, list[FloatArray]]:
    """Our closed forms of the equations that OpenCV solves, in its direction of moves."""
    second, first = closed_forms.every_pair(len(flange))
    moves = [closed_forms.moves(poses, (first, second)) for poses in (flange, np.linalg.inv(seen))]
    found = {name: [solved(*moves)] for name, solved in closed_forms.AX_XB.items()}
    inverse_y, inverse_x = closed_forms.shah(seen, np.linalg.inv(flange))
    return {**found, "shah": [np.linalg.inv(inverse_x), np.linalg.inv(inverse_y)]}


def test_closed_forms_find_the_truth_from_exact_data() -> None:
    rng = np.random.default_rng(0)
    mount, holder, seen = anywhere(rng), anywhere(rng), views(rng, USUAL, 12, spin_deg=180.0)
    flange = holder @ seen @ np.linalg.inv(mount)
    for pairs in (closed_forms.every_pair(12), closed_forms.consecutive(12)):
        moves = closed_forms.moves(flange, pairs), closed_forms.moves(seen, pairs)
        for solved in closed_forms.AX_XB.values():
            assert solved(*moves) == pytest.approx(mount, abs=1e-12)
    for both in closed_forms.AX_YB.values():
        x, y = both(flange, seen)
        assert x == pytest.approx(mount, abs=1e-12)
        assert y == pytest.approx(holder, abs=1e-12)


def agree(ours: dict[str, list[FloatArray]], theirs: dict[str, list[FloatArray]]) -> None:
    assert ours.keys() == theirs.keys()
    for name, poses in theirs.items():
        assert np.array(ours[name]) == pytest.approx(np.array(poses), abs=1e-9), name


def test_closed_forms_answer_noisy_data_as_opencv_did() -> None:
    recorded = json.loads(opencv.RECORDED.read_text())
    poses = np.array(recorded["base_T_flange"]), np.array(recorded["sensor_T_object"])
    agree(by_name(*poses), {name: np.array(found) for name, found in recorded["answers"].items()})


def test_closed_forms_answer_as_the_opencv_that_is_installed() -> None:
    cv2 = pytest.importorskip("cv2")
    if not hasattr(cv2, "calibrateHandEye"):
        pytest.skip(f"OpenCV {cv2.__version__} does not show its hand-eye calibration to Python")
    poses = opencv.comparable(5)
    agree(by_name(*poses), opencv.answers(cv2, *poses))


def test_dornaika_horaud_and_shah_differ_by_noise_only() -> None:
    problem = pose_pairs(np.random.default_rng(6)).problem
    poses = problem.motion.base_T_flange, np.linalg.inv(problem.sensor_T_object)
    one, other = (np.array(solved(*poses)) for solved in closed_forms.AX_YB.values())
    assert one == pytest.approx(other, abs=1e-6)


@pytest.mark.parametrize(("make", "draws"), [(pose_pairs, 12), (move_pairs, 3)])
def test_regions_are_honest_and_the_refined_mount_is_nearer(make: Callable[..., Any], draws: int) -> None:
    error, freedoms, near, far = 0.0, 0, 0.0, 0.0
    for seed in range(draws):
        cell = make(np.random.default_rng(100 + seed))
        result = solve(cell.problem)
        one, count = normalised_error(result, cell.truth)
        error, freedoms = error + one, freedoms + count
        start = pose_of(cell.problem.starts()[-1], "sensor").matrix
        near += float(np.sum((pose_of(result.values, "sensor").matrix - cell.truth["sensor"]) ** 2))
        far += float(np.sum((start - cell.truth["sensor"]) ** 2))
    assert chi_square_two_sided(error, freedoms, 1e-3).passed
    assert near < far


def flange(change: Change) -> Callable[[Any], Any]:
    def changed(problem: Any) -> Any:
        poses = change(problem.motion.base_T_flange)
        return replace(problem, motion=replace(problem.motion, base_T_flange=poses))

    return changed


def sensor(change: Change) -> Callable[[Any], Any]:
    return lambda problem: replace(problem, **{problem.reported: change(problem.given)})


def thousandths(poses: FloatArray) -> FloatArray:
    """Lengths divided by 1000, as if metres had been taken for millimetres."""
    scaled = poses.copy()
    scaled[:, :3, 3] *= 1e-3
    return scaled


MISTAKES: dict[str, tuple[Callable[[Any], Any], Cause]] = {
    "flange inverted": (flange(np.linalg.inv), Cause.INVERTED),
    "sensor inverted": (sensor(np.linalg.inv), Cause.INVERTED),
    "flange in another unit": (flange(thousandths), Cause.WRONG_UNITS),
    "sensor in another unit": (sensor(thousandths), Cause.WRONG_UNITS),
    "flange left-handed": (flange(lambda poses: poses * [1.0, 1.0, -1.0, 1.0]), Cause.LEFT_HANDED),
    "sensor left-handed": (sensor(lambda poses: poses * [1.0, 1.0, -1.0, 1.0]), Cause.LEFT_HANDED),
    "sensor skewed": (sensor(lambda poses: poses * [1.0, 1.01, 1.0, 1.0]), Cause.NOT_A_ROTATION),
    "sensor not finite": (sensor(lambda poses: poses * np.nan), Cause.NOT_FINITE),
    "one missing": (sensor(lambda poses: poses[:-1]), Cause.WRONG_SHAPE),
    "far away": (sensor(lambda poses: poses + 1e3 * (np.arange(4) == 3) * (np.arange(4) < 3)[:, None]),
                 Cause.WRONG_UNITS),
    "no noise": (lambda problem: replace(problem, std_m=0.0), Cause.NOISE),
    "noise of another shape": (lambda problem: replace(problem, covariance=np.eye(3)), Cause.WRONG_SHAPE),
}  # fmt: skip


@pytest.mark.parametrize(
    ("make", "mistake"),
    [(pose_pairs, each) for each in MISTAKES] + [(move_pairs, "sensor inverted"), (move_pairs, "no noise")],
)
def test_mistakes_are_named(make: Callable[..., Any], mistake: str) -> None:
    change, cause = MISTAKES[mistake]
    cell = make(np.random.default_rng(2), 6)
    result = solve(change(cell.problem))
    assert result.status is Status.REFUSED
    assert cause in causes(result), result.findings
    assert result.values == {}


def turned(rotation: FloatArray) -> Cell:
    """Pairs in which the sensor has these orientations (k, 3, 3) and any position."""
    rng = np.random.default_rng(3)
    seen = np.tile(np.eye(4), (len(rotation), 1, 1))
    seen[:, :3, :3], seen[:, :3, 3] = rotation, rng.uniform(-0.3, 0.3, (len(rotation), 3))
    cell = pose_pairs(rng, len(rotation))
    poses = cell.truth["object"] @ seen @ np.linalg.inv(cell.truth["sensor"])
    motion = replace(cell.problem.motion, base_T_flange=reported(rng, poses))
    seen = noisy(rng, np.linalg.inv(seen))
    return replace(cell, problem=replace(cell.problem, motion=motion, sensor_T_object=seen))


def test_orientations_that_leave_the_mount_open_are_named() -> None:
    rng, axis = np.random.default_rng(1), np.array([0.6, 0.0, 0.8])
    cases = {
        Cause.CONSTANT_ORIENTATION: np.tile(np.eye(3), (12, 1, 1)),
        Cause.SMALL_ROTATIONS: Rotation.from_rotvec(rng.uniform(-0.008, 0.008, (12, 3))).as_matrix(),
        Cause.ONE_AXIS: Rotation.from_rotvec(np.outer(rng.uniform(-1, 1, 12), axis)).as_matrix(),
    }
    for cause, rotation in cases.items():
        result = solve(turned(rotation).problem)
        assert result.status is Status.REFUSED
        assert causes(result) == {cause}


def test_half_turns_are_flagged_and_solved() -> None:
    half = Rotation.from_quat(np.eye(4)[np.arange(12) % 4]).as_matrix()
    cell = turned(half)
    result = solve(cell.problem)
    assert result.status is Status.FLAGGED
    assert causes(result) == {Cause.HALF_TURNS}
    error, freedoms = normalised_error(result, cell.truth)
    assert error < freedoms + 5.0 * np.sqrt(2.0 * freedoms)


def test_one_axis_of_moves_is_named_and_an_index_too_high() -> None:
    problem = move_pairs(np.random.default_rng(7)).problem
    turn = Rotation.from_rotvec(np.outer(np.linspace(-1, 1, 15), [0.0, 0.6, 0.8])).as_matrix()
    poses = problem.motion.base_T_flange.copy()
    poses[:, :3, :3] = turn
    result = solve(replace(problem, motion=replace(problem.motion, base_T_flange=poses)))
    assert causes(result) == {Cause.ONE_AXIS}
    assert causes(solve(replace(problem, second=problem.second + 1))) == {Cause.WRONG_SHAPE}


def test_two_pairs_are_too_few_and_copies_are_not_counted() -> None:
    problem = pose_pairs(np.random.default_rng(8)).problem

    def chosen(rows: FloatArray | list[int]) -> PosePairs:
        poses = problem.motion.base_T_flange[rows]
        seen = problem.sensor_T_object[rows]
        found: PosePairs = replace(
            problem, motion=replace(problem.motion, base_T_flange=poses), sensor_T_object=seen
        )
        return found

    assert {Cause.TOO_FEW, Cause.ONE_AXIS} <= causes(solve(chosen([0, 1])))
    assert causes(solve(chosen([0]))) >= {Cause.TOO_FEW}
    assert Cause.DUPLICATED in causes(solve(chosen([0, 0, 0, 0])))
    assert solve(chosen([0, 1, 2])).status is Status.OK


def test_a_pose_that_was_not_waited_for_is_left_out() -> None:
    cell = pose_pairs_beside(np.random.default_rng(9))
    seen = cell.problem.sensor_T_object.copy()
    seen[4, :3, 3] += 100 * SENSOR_STD[0]
    result = solve(replace(cell.problem, sensor_T_object=seen))
    assert causes(result) == {Cause.OUTLIER}
    assert np.flatnonzero(result.rejected).tolist() == list(range(24, 30))
    error, freedoms = normalised_error(result, cell.truth)
    assert error < freedoms + 5.0 * np.sqrt(2.0 * freedoms)


def test_poses_in_a_plane_are_flagged_and_solved() -> None:
    rng = np.random.default_rng(11)
    cell = pose_pairs(rng)
    poses = cell.problem.motion.base_T_flange.copy()
    poses[:, 2, 3] = 0.5
    seen = np.linalg.inv(poses @ cell.truth["sensor"]) @ cell.truth["object"]
    motion = replace(cell.problem.motion, base_T_flange=poses)
    result = solve(replace(cell.problem, motion=motion, sensor_T_object=noisy(rng, seen)))
    assert result.status is Status.FLAGGED
    assert causes(result) == {Cause.COPLANAR_POSES}
    error, freedoms = normalised_error(result, cell.truth)
    assert error < freedoms + 5.0 * np.sqrt(2.0 * freedoms)


@pytest.mark.parametrize("make", [pose_pairs, pose_pairs_beside, move_pairs])
def test_derivatives_by_the_geometry_of_an_arm(make: Callable[..., Any]) -> None:
    rng = np.random.default_rng(12)
    joints = Joints(arm(), rng.uniform(-1.0, 1.0, (5, 6)), std_rad=1e-4, kinematics_std=1e-3)
    problem = replace(make(rng, 5).problem, motion=joints)
    values = values_of(problem.belief().started(problem.starts()[0]))
    model = problem.model().weighed_at(values)
    analytic = model.rows(values).jacobian["kinematics"]
    for column in range(analytic.shape[1]):
        step = 1e-6 * np.eye(analytic.shape[1])[column]
        sides = [model.rows({**values, "kinematics": sign * step}).residual_m for sign in (1.0, -1.0)]
        numeric = (sides[0] - sides[1]) / 2e-6
        assert analytic[:, column] == pytest.approx(numeric, abs=1e-6 * np.abs(analytic).max())


def test_moves_that_share_a_pose_share_its_error() -> None:
    """Three moves round a triangle are two and no news from the arm: its noise is not averaged by them."""
    problem = move_pairs(np.random.default_rng(10), 6).problem
    precise = replace(problem, std_m=1e-9, std_rad=1e-9)
    again = precise.first_T_second[:-1] @ precise.first_T_second[1:]
    more = replace(
        precise,
        first=np.concatenate([precise.first, precise.first[:-1]]),
        second=np.concatenate([precise.second, precise.second[1:]]),
        first_T_second=np.concatenate([precise.first_T_second, again]),
    )
    std = []
    for each in (precise, more):
        start = each.belief().started(each.starts()[0])
        std.append(predicted_belief(start, each.model()).std("sensor"))
    assert std[1] == pytest.approx(std[0], rel=1e-3)
