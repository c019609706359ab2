"""Kinematic parameters: gauge freedoms, an independent solver, coverage, compliance, refusals."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimation.loads import GravityLoad
from estimation.solver import update
from estimation.tasks.camera import Tracker, beam_covariance
from estimation.tasks.findings import Cause, Status
from estimation.tasks.kinematics import KinematicTask, calibrate
from estimation.tasks.laser import PointLaserOnPlane, PointLaserOnPlanes
from estimation.tasks.motion import Joints, Poses
from estimation.transform import FloatArray, Transform
from tests.estimation.tasks.arm_cells import (
    JOINT_RAD,
    NOMINAL,
    deviations,
    drawn_table,
    everywhere,
    random_arm,
    tracker_cell,
)
from tests.estimation.tasks.cells import RANGE_STD_M, TRACKER_STD_M, to_plane
from tests.estimation.twin import (
    DEG,
    FREE,
    LASER,
    NAMES,
    PART_M,
    PLATE_M,
    TABLE,
    face_features,
    forward,
)
from tests.estimation.twin import pose as exp
from tests.estimation.twin_poses import part_poses, plate_poses

EIGHTEEN = tuple(f"{name}{joint + 1}" for joint, name in FREE)  # ESTIMATION.md, section 12


def test_points_of_a_tracker_scatter_more_across_the_beam_the_farther_they_are() -> None:
    rng, point = np.random.default_rng(1), np.array([[1.0, -2.0, 2.0]])  # 3 m away
    turns = Rotation.from_rotvec(rng.normal(size=(20_000, 3)) * 1e-5)
    sampled = np.cov((turns.apply(point[0]) + rng.normal(size=(20_000, 3)) * 1e-5).T)
    stated = beam_covariance(point, 1e-5, 1e-5)[0]
    assert sampled == pytest.approx(stated, abs=0.05 * np.trace(stated))
    assert np.sqrt(np.linalg.eigvalsh(stated)) == pytest.approx([1e-5, *[np.sqrt(10.0) * 1e-5] * 2])


def held(problem: KinematicTask) -> dict[str, str]:
    return {gauge.held.rpartition(".")[2]: gauge.words for gauge in problem.gauges}


def nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def test_a_tracker_sees_eighteen_parameters_and_the_others_are_named() -> None:
    cell = tracker_cell(np.random.default_rng(1))
    words = held(cell.problem)
    assert set(words) == {"theta1", "d1", "theta6", "d6", "a6", "alpha6", "d2"}
    assert words["theta1"] == "theta1 of kinematics cannot be told apart from the pose of the tracker"
    assert words["a6"] == "a6 of kinematics cannot be told apart from the reflectors"
    assert words["d2"] == "d2 of kinematics cannot be told apart from d3 of kinematics"
    found = calibrate(cell.problem)
    assert found.status is Status.OK, found.findings
    assert found.belief.block("kinematics").freedoms == EIGHTEEN
    assert found.rank is not None and found.rank.complete
    error = found.belief.vector("kinematics") - deviations(cell.problem, cell.table)
    assert nees(error, found.covariance("kinematics")) < 18 + 5 * np.sqrt(36)
    assert found.arm is not None
    table = np.column_stack([getattr(found.arm, name) for name in NAMES])
    free = tuple(zip(*[(joint, NAMES.index(name)) for joint, name in FREE], strict=True))
    assert table[free] == pytest.approx(cell.table[free], abs=2e-4)


def test_the_same_as_least_squares_of_scipy() -> None:
    cell = tracker_cell(np.random.default_rng(4), count=40, joint_rad=0.0, angle_std_rad=0.0)
    measured = cell.problem.measured
    assert isinstance(measured, Tracker) and isinstance(measured.motion, Joints)
    joints, points = measured.motion.joints_rad, measured.points_m

    def residuals(x: FloatArray) -> FloatArray:
        table = TABLE.copy()
        for (joint, name), value in zip(FREE, x[9:], strict=True):
            table[joint, NAMES.index(name)] += value
        flange = forward(table, joints)
        seen = flange[:, :3, :3] @ x[6:9] + flange[:, :3, 3]
        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        return np.asarray((points @ turn.T + x[:3] - seen) / TRACKER_STD_M).reshape(-1)

    truth = np.concatenate(
        [
            cell.tracker[:3, 3],
            Rotation.from_matrix(cell.tracker[:3, :3]).as_rotvec(),
            cell.reflectors[0],
            deviations(cell.problem, cell.table),
        ]
    )
    other = least_squares(residuals, truth, method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    result = calibrate(cell.problem)
    covariance = np.linalg.inv(other.jac.T @ other.jac)[9:, 9:]
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs(result.belief.vector("kinematics") - other.x[9:]) / sigma == pytest.approx(
        np.zeros(18), abs=1e-3
    )
    assert result.belief.std("kinematics") == pytest.approx(sigma, rel=1e-3)
    assert result.chi2 == pytest.approx(2.0 * other.cost, rel=1e-6)


def replica_errors(seeds: range) -> tuple[FloatArray, int]:
    """NEES (r,) of all that is estimated, over cells that share only the nominal arm; and its freedoms."""
    motion = tracker_cell(np.random.default_rng(0)).problem.motion
    found = []
    for seed in seeds:
        cell = tracker_cell(np.random.default_rng(seed))
        # The gauge is that of the nominal arm, whatever the cell: once is enough.
        assert isinstance(cell.problem.measured.motion, Joints)
        joints = cell.problem.measured.motion.joints_rad
        task = replace(cell.problem.measured, motion=replace(motion, joints_rad=joints))
        start = {
            "tracker": Transform("base", "tracker", cell.tracker),
            "reflectors": cell.reflectors[0],
            "kinematics": np.zeros(18),
        }
        posterior = update(task.belief().started(start), task.model()).belief
        gap = np.linalg.inv(posterior.transform("tracker").matrix) @ cell.tracker
        error = np.concatenate(
            [
                gap[:3, 3],
                Rotation.from_matrix(gap[:3, :3]).as_rotvec(),
                cell.reflectors[0] - posterior.vector("reflectors"),
                deviations(cell.problem, cell.table) - posterior.vector("kinematics"),
            ]
        )
        found.append(nees(error, posterior.marginal(start).covariance))
    return np.array(found), 27


def test_the_truth_lies_in_the_stated_region_as_often_as_it_should() -> None:
    squares, freedoms = replica_errors(range(100, 112))
    assert np.mean(squares) == pytest.approx(freedoms, abs=3.3 * np.sqrt(2 * freedoms / len(squares)))
    inside = int(np.sum(squares < 40.113))  # chi-square of 27, 95 %
    assert inside >= 9


@pytest.mark.campaign
def test_coverage_of_the_whole_task_without_a_start() -> None:
    inside, total = 0, 300
    squares = []
    for seed in range(total):
        cell = tracker_cell(np.random.default_rng(10_000 + seed))
        result = calibrate(cell.problem)
        assert result.status is not Status.REFUSED
        error = deviations(cell.problem, cell.table) - result.belief.vector("kinematics")
        squares.append(nees(error, result.covariance("kinematics")))
        inside += squares[-1] < 28.869  # chi-square of 18, 95 %
    print(f"kinematics-tracker: {inside} of {total} inside 95 %, mean NEES/m {np.mean(squares) / 18:.4f}")
    assert 273 <= inside <= 294
    assert np.mean(squares) == pytest.approx(18, abs=3.3 * np.sqrt(36 / total))


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), joints=st.integers(3, 7))
def test_law_without_parallel_axes_only_base_and_flange_are_a_matter_of_frames(
    seed: int, joints: int
) -> None:
    rng = np.random.default_rng(seed)
    arm = random_arm(rng, joints)
    q = rng.uniform(-2.5, 2.5, (40, joints))
    flange, sits, tracker = arm.flange_pose(q), np.array([0.05, 0.03, 0.1]), exp(rng.normal(size=6))
    points = (flange[:, :3, :3] @ sits + flange[:, :3, 3] - tracker[:3, 3]) @ tracker[:3, :3]
    index = np.zeros(40, dtype=np.intp)
    measured = Tracker(
        motion=Joints(arm, q), points_m=points, pose_index=np.arange(40), marker_index=index, std_m=1e-5
    )
    problem = KinematicTask(measured=measured)
    assert set(held(problem)) == {
        "theta1",
        "d1",
        *(f"{name}{joints}" for name in ("theta", "d", "a", "alpha")),
    }


def test_law_what_is_held_changes_no_prediction() -> None:
    """Other values of the held parameters: another base and flange frame, the same fit of the points."""
    cell = tracker_cell(np.random.default_rng(6))
    table = np.column_stack([getattr(NOMINAL, name) for name in NAMES])
    for parameter, amount in (
        ((0, 0), 0.3),
        ((0, 1), 0.02),
        ((5, 0), -0.4),
        ((5, 1), 0.01),
        ((5, 2), 0.03),
        ((5, 3), 0.2),
    ):
        table[parameter] += amount
    moved = type(NOMINAL)(*table.T, NOMINAL.lower_rad, NOMINAL.upper_rad)
    measured = cell.problem.measured
    assert isinstance(measured.motion, Joints)
    other = replace(cell.problem, measured=replace(measured, motion=replace(measured.motion, arm=moved)))
    one, two = calibrate(cell.problem), calibrate(other)
    assert two.chi2 == pytest.approx(one.chi2, rel=1e-6)
    assert two.belief.vector("kinematics") == pytest.approx(one.belief.vector("kinematics"), abs=1e-7)
    assert two.covariance("kinematics") == pytest.approx(one.covariance("kinematics"), rel=1e-3)


def test_the_faces_of_a_part_calibrate_the_arm_together_with_the_laser() -> None:
    rng, (q, face) = np.random.default_rng(3), part_poses(200)
    table, faces = drawn_table(rng), face_features(False)
    beam = forward(table, q + rng.normal(size=q.shape) * JOINT_RAD) @ exp(np.array([*LASER, 0, 0, 0]))
    point, normal = np.array([f.point_m for f in faces]), np.array([f.axis for f in faces])
    reading = to_plane(beam[:, :3, 3], beam[:, :3, 2], PART_M + point[face], normal[face])
    measured = PointLaserOnPlanes(
        motion=Joints(NOMINAL, q, std_rad=JOINT_RAD),
        reading_m=reading + rng.normal(size=len(q)) * RANGE_STD_M,
        std_m=RANGE_STD_M,
        faces=faces,
        face_index=face,
    )
    problem = KinematicTask(measured=measured)
    words = held(problem)
    assert set(words) == {"theta1", "d1", "theta6", "d6", "a6", "alpha6", "d2"}
    assert words["alpha6"] == "alpha6 of kinematics cannot be told apart from the pose of the laser"
    result = calibrate(problem)
    assert result.status is Status.OK, result.findings
    error = result.belief.vector("kinematics") - deviations(problem, table)
    assert nees(error, result.covariance("kinematics")) < 18 + 5 * np.sqrt(36)
    # Without a mount to estimate, what is left of the last link is seen as well.
    mount = Transform("flange", "laser", exp(np.array([*LASER, 0, 0, 0])))
    alone = KinematicTask(measured=replace(measured, mount=mount, mount_std=np.zeros(5)))
    assert set(held(alone)) == {"theta1", "d1", "d2"}
    assert calibrate(alone).status is Status.OK


def plate_task() -> PointLaserOnPlane:
    rng, q = np.random.default_rng(2), plate_poses(160)
    beam = forward(drawn_table(rng), q) @ exp(np.array([*LASER, 0, 0, 0]))
    reading = to_plane(beam[:, :3, 3], beam[:, :3, 2], PLATE_M, np.array([0.0, 0.0, 1.0]))
    reading = reading + rng.normal(size=len(q)) * RANGE_STD_M
    return PointLaserOnPlane(motion=Joints(NOMINAL, q), reading_m=reading, std_m=RANGE_STD_M)


def test_one_level_plate_leaves_parameters_open_that_get_no_number_or_only_their_prior() -> None:
    flat = calibrate(KinematicTask(measured=plate_task()), explain=False)
    assert flat.status is Status.REFUSED and flat.arm is None
    assert "a1 of kinematics is not seen by the measurements" in flat.findings[0].problem
    assert "give a prior" in flat.findings[0].remedy
    known = replace(NOMINAL, free=tuple(NOMINAL.every_parameter))
    std = [1e-3 if name in ("a", "d") else 0.1 * DEG for _, name in known.free]
    measured = plate_task()
    assert isinstance(measured.motion, Joints)
    motion = replace(measured.motion, arm=known, kinematics_std=std)
    prior = KinematicTask(measured=replace(measured, motion=motion))
    assert prior.gauges == ()
    found = calibrate(prior)
    assert found.status is Status.OK, found.findings
    said = [direction.words for direction in found.prior_only]
    assert "a1 of kinematics is known from the prior only" in said
    assert "theta1 of kinematics is known from the prior only" in said
    assert not any("a4" in words for words in said)
    note = found.notes[-1].removeprefix("Known from priors only: ").removesuffix(".")
    ends = {"theta1", "d1", "theta6", "d6", "a6", "alpha6"}
    assert set(note.split(", ")) == {*ends, "a1", "d2", "d3"}


def test_a_laser_of_unknown_scale_leaves_the_size_of_the_arm_open() -> None:
    problem = KinematicTask(measured=replace(plate_task(), scale_std=np.inf))
    words = held(problem)
    assert words["a2"] == "a2 says how large the arm is: nothing of known length is seen"


def test_a_joint_that_stands_still_is_named() -> None:
    rng = np.random.default_rng(5)
    joints = everywhere(rng, 60)
    joints[:, 3] = 0.4
    found = calibrate(tracker_cell(rng, joints=joints).problem, explain=False)
    assert found.status is Status.REFUSED
    assert found.values == {}
    assert [finding.cause for finding in found.findings] == [Cause.STILL_JOINT, Cause.UNDETERMINED]
    assert "Joint 4 moves by 0 deg, limit 20 deg" in found.findings[0].problem
    assert "cannot be told apart" in found.findings[1].problem
    # The offsets of the others can be had when nothing else is asked for.
    cell = tracker_cell(rng, joints=joints, table=TABLE)
    offsets = replace(cell.problem, identify=tuple((joint, "theta") for joint in range(6) if joint != 3))
    result = calibrate(offsets, explain=False)
    assert result.status is Status.OK, result.findings
    assert result.belief.block("kinematics").freedoms == ("theta2", "theta3", "theta5")


def refusal(problem: KinematicTask) -> tuple[Cause, str]:
    result = calibrate(problem, explain=False)
    assert result.status is Status.REFUSED
    return result.findings[0].cause, result.findings[0].problem


def test_what_cannot_be_calibrated_is_refused_at_sight() -> None:
    cell = tracker_cell(np.random.default_rng(5))
    measured = cell.problem.measured
    assert isinstance(measured, Tracker)
    poses = replace(cell.problem, measured=replace(measured, motion=Poses(np.tile(np.eye(4), (60, 1, 1)))))
    assert refusal(poses) == (Cause.WRONG_SHAPE, "Poses of the flange say nothing of single joints")
    assert "kinematic parameter 'a' of joint 7" in refusal(replace(cell.problem, identify=((6, "a"),)))[1]
    assert refusal(replace(cell.problem, identify=()))[0] is Cause.TOO_FEW
    few = tracker_cell(np.random.default_rng(5), count=9).problem
    assert refusal(few)[0] is Cause.TOO_FEW
    load = GravityLoad(5.0, link_kg=[1.0, 2.0], link_m=np.zeros((2, 3)))
    assert isinstance(measured.motion, Joints)
    loaded = replace(measured, motion=replace(measured.motion, load=load))
    assert "Masses of shape (2,)" in refusal(replace(cell.problem, measured=loaded))[1]


def test_joints_that_yield_under_gravity_are_told_from_their_offsets() -> None:
    rng = np.random.default_rng(8)
    load = GravityLoad(6.0, (0.02, 0.03, 0.15), [0, 8.0, 5.0, 3.0, 2.0, 0.5], np.full((6, 3), 0.03))
    true = np.array([0.0, 4e-6, 6e-6, 2e-5, 2e-5, 5e-5])  # rad/Nm
    joints = everywhere(rng, 80)
    soft = joints + true * load.torque_nm(NOMINAL, joints)
    table = drawn_table(rng)
    cell = tracker_cell(rng, joints=soft, table=table)
    measured = cell.problem.measured
    assert isinstance(measured, Tracker)
    motion = Joints(NOMINAL, joints, std_rad=JOINT_RAD, load=load)
    problem = KinematicTask(measured=replace(measured, motion=motion))
    # The axis of joint 1 is upright: no torque of gravity, nothing to yield to.
    assert held(problem)["joint1"] == "joint1 of compliance is not seen by such measurements"
    result = calibrate(problem)
    assert result.status is Status.OK, result.findings
    assert result.belief.block("compliance").freedoms == ("joint2", "joint3", "joint4", "joint5", "joint6")
    assert result.belief.block("compliance").units == ("rad/Nm",) * 5
    links = result.belief.vector("kinematics") - deviations(problem, table)
    error = np.concatenate([result.belief.vector("compliance") - true[1:], links])
    covariance = result.belief.marginal(("compliance", "kinematics")).covariance
    assert nees(error, covariance) < 23 + 5 * np.sqrt(46)
    rigid = KinematicTask(measured=replace(measured, motion=replace(motion, load=None)))
    assert calibrate(rigid, explain=False).status is not Status.OK


def test_exchanged_joints_are_recognised_whatever_the_arm_is_like() -> None:
    cell = tracker_cell(np.random.default_rng(9), count=40)
    measured = cell.problem.measured
    assert isinstance(measured.motion, Joints)
    swapped = replace(measured.motion, joints_rad=measured.motion.joints_rad[:, [0, 1, 2, 4, 3, 5]])
    result = calibrate(replace(cell.problem, measured=replace(measured, motion=swapped)))
    assert result.status is Status.REFUSED
    assert result.findings[-1].cause is Cause.SWAPPED_JOINTS


Change = Callable[[Tracker, Joints], dict[str, Any]]
HOSTILE: dict[str, tuple[Change, set[Cause]]] = {
    "noise is no number": (lambda t, m: {"std_m": np.nan}, {Cause.NOISE}),
    "noise below zero": (lambda t, m: {"angle_std_rad": -1e-6}, {Cause.NOISE}),
    "points of another arm": (
        lambda t, m: {"points_m": t.points_m[::-1]},
        {Cause.NO_SOLUTION, Cause.CLUSTERED_OUTLIERS, Cause.INCONSISTENT},
    ),
    "a joint short": (
        lambda t, m: {"motion": replace(m, joints_rad=m.joints_rad[:, :5])},
        {Cause.WRONG_SHAPE},
    ),
    "no joints": (lambda t, m: {"motion": replace(m, joints_rad=np.nan * m.joints_rad)}, {Cause.NOT_FINITE}),
    "degrees": (
        lambda t, m: {"motion": replace(m, joints_rad=np.degrees(m.joints_rad))},
        {Cause.WRONG_UNITS},
    ),
    "two payloads": (
        lambda t, m: {"motion": replace(m, load=GravityLoad(1.0, (0.0, 0.0)))},
        {Cause.WRONG_SHAPE},
    ),
    "two compliances": (
        lambda t, m: {"motion": replace(m, load=GravityLoad(1.0), compliance_std=[1e-5, 1e-5])},
        {Cause.WRONG_SHAPE},
    ),
    "prior is no number": (
        lambda t, m: {"motion": replace(m, arm=replace(m.arm, free=((1, "a"),)), kinematics_std=np.nan)},
        {Cause.WRONG_SHAPE},
    ),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", HOSTILE)
def test_bad_data_are_refused_without_a_warning(name: str) -> None:
    cell = tracker_cell(np.random.default_rng(5), count=40)
    measured, (change, cause) = cell.problem.measured, HOSTILE[name]
    assert isinstance(measured, Tracker) and isinstance(measured.motion, Joints)
    changed = replace(measured, **change(measured, measured.motion))
    assert refusal(replace(cell.problem, measured=changed))[0] in cause
