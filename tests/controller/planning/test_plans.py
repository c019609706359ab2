"""Plans of the example cell: what they promise, and that the arm can do them."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.knowledge import part_corners_m
from controller.planning import Plan, Step, plan_hand_eye
from controller.planning.candidates import occluded, part_candidates, plate_candidates
from controller.planning.estimated import hand_eye_points
from controller.planning.steps import route
from controller.planning.workspace import Workspace, observations_of
from estimation.kinematics import ArmModel
from estimation.measurement import Chain
from estimation.solver import predicted_belief
from estimation.statistics import coverage_factor
from estimation.transform import FloatArray
from tests.controller.planning.planned import SEED, Planned, belief_of

BLOCK_M = np.array([0.100, 0.150, 0.100])  # of the drawing, without bore, boss and rounding
FACES = {
    "left": (0, 0.0, -1.0),
    "right": (0, 0.100, 1.0),
    "front": (1, 0.0, -1.0),
    "back": (1, 0.150, 1.0),
    "top": (2, 0.100, 1.0),
}
BORE, BOSS, ROUND = ((0.035, 0.045), 0.015), ((0.065, 0.105), 0.0125), 0.008


def _walked(plan: Plan) -> FloatArray:
    """All postures in the order in which the arm takes them."""
    postures = [posture for step in plan.steps for posture in (*step.via, step.joints_rad, *step.retreat)]
    return np.array(postures)


def _beams(arm: ArmModel, steps: tuple[Step, ...], flange_T_laser: FloatArray) -> FloatArray:
    return arm.flange_pose(np.array([step.joints_rad for step in steps])) @ flange_T_laser


def _meets_face(part_o: FloatArray, part_d: FloatArray, face: str) -> tuple[bool, float, float]:
    """Whether a ray meets a face of the plain block inside its edges; with distance and incidence (rad)."""
    axis, place, sign = FACES[face]
    facing = -part_d[axis] * sign
    if facing <= 0.0:
        return False, np.inf, np.inf
    distance = float((place - part_o[axis]) / part_d[axis])
    point = part_o + distance * part_d
    others = [i for i in range(3) if i != axis]
    inside = all(0.0 < point[i] < BLOCK_M[i] for i in others)
    if face == "top":
        inside = inside and np.hypot(*(point[:2] - BORE[0])) > BORE[1]
        inside = inside and np.hypot(*(point[:2] - BOSS[0])) > BOSS[1]
        along = np.linspace(0.0, distance, 200)[:, None] * part_d + part_o  # not through the boss either
        beside = np.hypot(*(along[:, :2] - BOSS[0]).T) > BOSS[1]
        inside = inside and bool(np.all(beside | (along[:, 2] > 0.115)))
    if face == "right":
        inside = inside and point[1] < BLOCK_M[1] - ROUND
    if face == "back":
        inside = inside and point[0] < BLOCK_M[0] - ROUND
    return inside, distance, float(np.arccos(facing))


def largest_std_m(judged: FloatArray) -> float:
    """Of gated points with covariances (k, 3, 3)."""
    return float(np.sqrt(np.linalg.eigvalsh(judged).max()))


def test_eighty_planned_poses_reach_the_known_figure(planned: Planned) -> None:
    worst = planned.plans["hand-eye"].worst
    assert worst is not None
    largest_std_mm = worst.U_m * 1e3 / coverage_factor(3)
    assert len(planned.plans["hand-eye"].steps) == 80
    assert largest_std_mm == pytest.approx(0.078, rel=0.15)  # ESTIMATION.md 12: mid, joint
    assert sum(worst.shares.values()) == pytest.approx(1.0)


def test_planned_poses_beat_random_ones(planned: Planned) -> None:
    workspace = Workspace(planned.cell, planned.arm, planned.plate_prior)
    pool = plate_candidates(workspace, SEED)
    points, _ = hand_eye_points(planned.plate_prior, (0.060, 0.085, 0.110))
    random = np.random.default_rng(5)
    drawn = [
        largest_std_m(
            points.covariance(
                predicted_belief(
                    planned.plate_prior,
                    Chain(
                        planned.arm,
                        [observations_of(workspace, pool.take(random.choice(len(pool), 80, replace=False)))],
                    ),
                )
            )
        )
        for _ in range(5)
    ]
    worst = planned.plans["hand-eye"].worst
    assert worst is not None
    assert worst.U_m / coverage_factor(3) < 0.85 * min(drawn)


def test_the_same_input_gives_the_same_plan(planned: Planned) -> None:
    again = plan_hand_eye(planned.cell, planned.plate_prior, planned.arm, 80, SEED)
    assert again.steps == planned.plans["hand-eye"].steps


@pytest.mark.parametrize("name", ["noise", "hand-eye", "bar", "coarse", "localize", "check", "inspect"])
def test_postures_keep_limits_and_stay_above_the_bench(planned: Planned, name: str) -> None:
    postures = _walked(planned.plans[name])
    ids = [step.id for step in planned.plans[name].steps]
    assert planned.arm.within_limits(postures).all()
    assert len(set(ids)) == len(ids)
    between = np.concatenate(
        [postures[:-1] + share * np.diff(postures, axis=0) for share in np.linspace(0.0, 1.0, 15)]
    )
    flange = planned.arm.flange_pose(between)
    ball = flange[:, :3, :3] @ np.array(planned.cell.probe.mount.xyz_m) + flange[:, :3, 3]
    laser = flange[:, :3, :3] @ np.array(planned.cell.laser.mount.xyz_m) + flange[:, :3, 3]
    assert min(flange[:, 2, 3].min(), laser[:, 2].min()) > 0.02
    assert ball[:, 2].min() > 0.02
    # the stylus passes no plate, and the laser's head no part
    plate = planned.cell.plate.transform().inverse().points(ball)
    over = (np.abs(plate[:, :2]) < 0.15).all(axis=1)
    assert plate[over, 2].min(initial=1.0) > planned.cell.probe.ball_radius_m + 0.003
    part = planned.cell.part.transform().inverse().points(laser)
    inside = ((part > [0.0, 0.0, -1.0]) & (part < BLOCK_M)).all(axis=1)
    assert not inside.any()


@pytest.mark.parametrize("name", ["noise", "hand-eye", "bar", "coarse", "localize", "check", "inspect"])
def test_plans_begin_and_end_with_the_tool_above_everything(planned: Planned, name: str) -> None:
    steps = planned.plans[name].steps
    for joints in (steps[0].via[0], steps[-1].end_rad, *(step.access[0] for step in steps)):
        flange = planned.arm.flange_pose(np.array(joints))
        assert flange[2, 3] > 0.35
        assert joints[1] == pytest.approx(0.0)


def test_beams_meet_the_plate_in_range(planned: Planned) -> None:
    steps = planned.plans["hand-eye"].steps
    beams = _beams(planned.arm, steps, planned.cell.laser.mount.transform().matrix)
    plate_T_base = planned.cell.plate.transform().inverse()
    origin, way = plate_T_base.points(beams[:, :3, 3]), plate_T_base.vectors(beams[:, :3, 2])
    distance = -origin[:, 2] / way[:, 2]
    point = origin + distance[:, None] * way
    low, high = planned.cell.laser.working_range_m
    assert np.all((distance > low) & (distance < high))
    assert np.all(np.abs(point[:, :2]) < 0.150 - planned.cell.plate.margin_m)
    assert np.all(np.arccos(-way[:, 2]) < planned.cell.laser.max_incidence_rad)
    np.testing.assert_allclose(distance, [step.expected_m for step in steps], atol=1e-4)


def test_localization_beams_meet_their_faces(planned: Planned) -> None:
    laser = belief_of(planned.plans["localize"]).transform("laser").matrix
    part_T_base = planned.cell.part.transform().inverse()
    low, high = planned.cell.laser.working_range_m
    for name in ("coarse", "localize", "check"):
        steps = planned.plans[name].steps
        for step, beam in zip(steps, _beams(planned.arm, steps, laser), strict=True):
            inside, distance, incidence = _meets_face(
                part_T_base.points(beam[:3, 3]), part_T_base.vectors(beam[:3, 2]), step.feature
            )
            assert inside, step
            assert low < distance < high
            assert incidence < planned.cell.laser.max_incidence_rad


def test_beams_that_graze_the_boss_are_not_taken(planned: Planned) -> None:
    workspace = Workspace(planned.cell, planned.arm, belief_of(planned.plans["coarse"]))
    pool = part_candidates(workspace, ["top"], SEED)
    free = pool.take(~occluded(workspace, pool))
    clear = ~occluded(workspace, free, beside_m=0.004)
    laser, part_T_base = workspace.pose("laser").matrix, workspace.pose("part").inverse()
    beams = workspace.actual_arm.flange_pose(free.joints_rad) @ laser

    def met(beam: FloatArray) -> bool:
        sides = (0.003 * beam[:3, 0], -0.003 * beam[:3, 0], 0.003 * beam[:3, 1], -0.003 * beam[:3, 1])
        origins = [part_T_base.points(beam[:3, 3] + side) for side in sides]
        return all(_meets_face(origin, part_T_base.vectors(beam[:3, 2]), "top")[0] for origin in origins)

    assert all(met(beam) for beam in beams[clear])
    assert 0 < np.sum(~clear) < np.sum(clear)


def test_coarse_beams_meet_their_faces_wherever_the_part_may_lie(planned: Planned) -> None:
    steps = planned.plans["coarse"].steps
    assert {step.feature for step in steps} == set(FACES)
    beams = _beams(planned.arm, steps, planned.cell.laser.mount.transform().matrix)
    random, part = np.random.default_rng(2), planned.cell.part
    nominal = part.transform()
    low, high = planned.cell.laser.working_range_m
    for _ in range(60):
        shift, turn = (vector / np.linalg.norm(vector) for vector in random.normal(size=(2, 3)))
        displaced = np.eye(4)
        displaced[:3, :3] = Rotation.from_rotvec(part.rotation_limit_rad * turn).as_matrix()
        displaced[:3, 3] = part.position_limit_m * shift
        part_T_base = np.linalg.inv(nominal.matrix @ displaced)
        for step, beam in zip(steps, part_T_base @ beams, strict=True):
            inside, distance, _ = _meets_face(beam[:3, 3], beam[:3, 2], step.feature)
            assert inside, step
            assert low < distance < high


def test_localization_is_planned_to_the_known_figure(planned: Planned) -> None:
    worst = planned.plans["localize"].worst
    assert worst is not None
    assert worst.U_m == pytest.approx(0.22e-3, rel=0.15)  # 30 points on five faces after 80 poses
    assert worst.dominating[0] == "kinematics"
    assert len(planned.plans["localize"].gated) == len(part_corners_m(planned.cell)) == 8


def test_check_points_are_fresh_and_on_every_face(planned: Planned) -> None:
    used = [*planned.plans["coarse"].steps, *planned.plans["localize"].steps]
    fresh = planned.plans["check"].steps
    before = np.array([step.object_p_m for step in used])
    for step in fresh:
        assert np.linalg.norm(before - step.object_p_m, axis=1).min() > 5e-3
    assert {step.feature for step in fresh} == set(FACES)


def test_the_bar_is_seen_from_five_orientations_and_the_plate_again(planned: Planned) -> None:
    steps = planned.plans["bar"].steps
    bar = tuple(step for step in steps if step.object == "bar")
    plate = [step for step in steps if step.object == "plate"]
    beams = _beams(planned.arm, bar, planned.cell.laser.mount.transform().matrix)
    turned = beams[:, :3, :3]
    kinds: list[FloatArray] = []
    for rotation in turned:
        if not any(np.allclose(rotation, kind, atol=1e-6) for kind in kinds):
            kinds.append(rotation)
    tilts = sorted(round(float(np.degrees(np.arccos(-kind[2, 2])))) for kind in kinds)
    assert tilts == [0, 0, 45, 45, 45]
    straight = [kind for kind in kinds if kind[2, 2] < -0.99]
    assert straight[0][:, 0] @ straight[1][:, 0] == pytest.approx(-1.0)
    assert [sum(step.feature == name for step in bar) for name in ("bar first", "bar second")] == [20, 20]
    known = {step.joints_rad for step in planned.plans["hand-eye"].steps}
    assert len(plate) == 8
    assert all(step.joints_rad in known for step in plate)


def test_the_noise_patch_is_small_and_seen_with_one_orientation(planned: Planned) -> None:
    steps = planned.plans["noise"].steps
    patch = tuple(step for step in steps if step.kind == "laser")
    still = [step for step in steps if step.kind == "noise"]
    assert len(patch) == 12
    assert len(still) == 3
    assert {step.readings for step in still} == {40}
    rotation = planned.arm.flange_pose(np.array([step.joints_rad for step in patch]))[:, :3, :3]
    np.testing.assert_allclose(rotation, np.broadcast_to(rotation[0], rotation.shape), atol=1e-9)
    assert np.ptp([step.object_p_m for step in patch], axis=0).max() < 0.01


def test_touches_approach_along_the_normal_and_pass_the_surface(planned: Planned) -> None:
    steps = [step for step in planned.plans["inspect"].steps if step.object == "part"]
    belief = belief_of(planned.plans["inspect"])
    ball = belief.transform("probe").origin_m
    part_T_base = belief.transform("part").inverse()

    def ball_at(joints: tuple[float, ...]) -> FloatArray:
        flange = planned.arm.flange_pose(np.array(joints))
        return part_T_base.points(flange[:3, :3] @ ball + flange[:3, 3])

    radius = planned.cell.probe.ball_radius_m
    for step in steps:
        start, end = ball_at(step.joints_rad), ball_at(step.contact_rad)
        if step.feature in ("bore", "boss"):
            middle, size = BORE if step.feature == "bore" else BOSS
            sign = -1.0 if step.feature == "bore" else 1.0
            gaps = [sign * (np.hypot(*(p[:2] - middle)) - size) - radius for p in (start, end)]
        else:
            axis, place, sign = FACES[step.feature]
            gaps = [sign * (p[axis] - place) - radius for p in (start, end)]
        assert gaps[0] > 1e-3
        assert gaps[1] < -1e-3
        assert gaps[0] == pytest.approx(step.expected_m, abs=2e-4)
    counts = {
        name: sum(step.feature == name for step in steps) for name in ("top", "left", "front", "bore", "boss")
    }
    assert counts == {"top": 9, "left": 4, "front": 4, "bore": 8, "boss": 8}


def test_steps_survive_json(planned: Planned) -> None:
    for plan in planned.plans.values():
        for step in plan.steps:
            assert Step.from_dict(json.loads(json.dumps(step.to_dict()))) == step


def test_a_route_goes_over_the_carrying_postures(planned: Planned) -> None:
    done, following = planned.plans["hand-eye"].steps[3], planned.plans["localize"].steps[5]
    way = route(done, following)
    assert way == (*reversed(done.access), *following.access)
    assert route(None, following) == following.access
