"""Plans for the phases that estimate: hand-eye and localization, and the part's check."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Final

import numpy as np

from controller.cellfile import Cell, job
from controller.knowledge import part_corners_m
from controller.planning.candidates import (
    EDGE_MARGIN_M,
    mount_offset_m,
    occluded,
    part_candidates,
    plate_candidates,
    surely_in_range,
)
from controller.planning.plan import Plan, accessible, gated_predictions, laser_steps
from controller.planning.poses import BoolArray
from controller.planning.steps import Step, named
from controller.planning.workspace import SIGMAS, Candidates, Workspace, observations_of, rows_of
from estimation import design
from estimation.belief import Belief
from estimation.design import DesignProblem
from estimation.errors import CellError, Unreachable
from estimation.kinematics import ArmModel
from estimation.measurement import Chain, Points, object_point_jacobian, point_jacobian
from estimation.solver import predicted_belief
from estimation.statistics import coverage_factor
from estimation.transform import FloatArray, exp_pose

COARSE_COUNT: Final = 10
COARSE_NOTE: Final = "coarse"
CHECK_SEED: Final = 7919  # draws of its own
_COARSE_MIDDLE: Final = 0.3  # of the working range: the part may be nearer or farther by much
_ROUNDS: Final = 8  # in which check points that turn out to be blocked are replaced
_TRIALS: Final = 5  # choices, in which those that turn out to be hindered are left out
_CORNERS: Final = tuple(f"corner {x}{y}{z}" for x in "-+" for y in "-+" for z in "-+")

Blocked = Callable[[Candidates], BoolArray]


def plan_hand_eye(cell: Cell, belief: Belief, arm: ArmModel, count: int, seed: int) -> Plan:
    """Laser on the plate: the `count` poses that leave the gated points most certain.

    The belief holds the plate's block. The better the belief, the more of the working range is used.
    """
    spec = next((phase for phase in cell.job.phases if isinstance(phase, job.HandEyePhase)), None)
    name = "hand-eye" if spec is None else spec.name
    ranges_m = cell.laser.working_range_m if spec is None else spec.gated_ranges_m
    workspace = Workspace(cell, arm, belief)
    pool = plate_candidates(workspace, seed)
    points, names = hand_eye_points(belief, ranges_m)
    chosen, curve_U_m = choose(workspace, pool, points.jacobian, count)
    predicted = predicted_belief(belief, Chain(arm, [observations_of(workspace, chosen)]), name)
    steps = named(laser_steps(workspace, chosen), name)
    return Plan(steps, gated_predictions(predicted, points, names), predicted, curve_U_m)


def hand_eye_points(belief: Belief, ranges_m: Sequence[float]) -> tuple[Points, tuple[str, ...]]:
    """The gated points of a hand-eye: those of readings at given distances, in the flange."""
    names = tuple(f"{range_m * 1e3:.0f} mm" for range_m in ranges_m)
    return point_jacobian(belief, np.array(ranges_m)), names


def plan_coarse_localize(
    cell: Cell, belief: Belief, arm: ArmModel, spec: job.LocalizePhase, seed: int, count: int = COARSE_COUNT
) -> Plan:
    """The first points on a part that was clamped by hand: each meets its face wherever the part may lie."""
    workspace = Workspace(cell, arm, belief)
    pool = part_candidates(workspace, spec.faces, seed, margin_m=margin_m(workspace), middle=_COARSE_MIDDLE)
    displacements = _displacements(cell)
    pool = pool.take(surely_in_range(workspace, pool, displacements))
    face_limit = -(-count // len(spec.faces)) + 1  # no face may be left out
    return _part_plan(
        workspace,
        pool,
        count,
        f"{spec.name} {COARSE_NOTE}",
        COARSE_NOTE,
        lambda chosen: occluded(workspace, chosen, displacements),
        face_limit,
    )


def plan_localize(
    cell: Cell, belief: Belief, arm: ArmModel, spec: job.LocalizePhase, seed: int, count: int = 0
) -> Plan:
    """The `count` points (0: as the cell file says) that leave the corners of the part most certain.

    The belief has used the coarse points already, so that beams may go near the edges.
    """
    workspace = Workspace(cell, arm, belief)
    pool = part_candidates(workspace, spec.faces, seed, margin_m=margin_m(workspace))
    return _part_plan(workspace, pool, count or spec.measurements, spec.name, "", blocked_beams(workspace))


def blocked_beams(workspace: Workspace) -> Blocked:
    """Which beams meet something else than their face first, if the part is off by what is uncertain."""
    beside_m = margin_m(workspace)
    return lambda chosen: occluded(workspace, chosen, (), beside_m)


def plan_part_check(
    cell: Cell, belief: Belief, arm: ArmModel, spec: job.CheckPhase, steps: Sequence[Step], seed: int
) -> Plan:
    """Points that no fit has used, on all faces in turn, far from those of `steps` and from each other."""
    checked = next(phase for phase in cell.job.phases if phase.name == spec.of)
    faces = checked.faces if isinstance(checked, job.LocalizePhase) else ()
    workspace = Workspace(cell, arm, belief)
    pool = part_candidates(workspace, faces, seed + CHECK_SEED, margin_m=margin_m(workspace))
    used = np.array([step.object_p_m for step in steps if step.object == "part" and step.kind == "laser"])
    blocked = np.zeros(len(pool), dtype=np.bool_)
    for _ in range(_ROUNDS):
        chosen = _spread(pool, spec.points, used.reshape(-1, 3), ~blocked)
        bad = occluded(workspace, pool.take(chosen), (), margin_m(workspace)) | ~accessible(
            workspace, pool.take(chosen)
        )
        if not bad.any():
            return Plan(named(laser_steps(workspace, pool.take(chosen), "check"), spec.name))
        blocked[np.array(chosen)[bad]] = True
    raise _unreachable("check points on the part")


def corner_points(cell: Cell, belief: Belief) -> tuple[Points, tuple[str, ...]]:
    """The gated points of a localization."""
    return object_point_jacobian(belief, "part", part_corners_m(cell)), _CORNERS


def _part_plan(
    workspace: Workspace,
    pool: Candidates,
    count: int,
    name: str,
    note: str,
    blocked: Blocked,
    face_limit: int = 0,
) -> Plan:
    points, names = corner_points(workspace.cell, workspace.belief)
    chosen, curve_U_m = choose(workspace, pool, points.jacobian, count, blocked, face_limit)
    taken = [observations_of(workspace, chosen)]
    predicted = predicted_belief(workspace.belief, Chain(workspace.arm, taken), name)
    steps = named(laser_steps(workspace, chosen, note), name)
    return Plan(steps, gated_predictions(predicted, points, names), predicted, curve_U_m)


def choose(
    workspace: Workspace,
    pool: Candidates,
    gates: FloatArray,
    count: int,
    blocked: Blocked | None = None,
    face_limit: int = 0,
) -> tuple[Candidates, tuple[float, ...]]:
    """The best candidates that can be approached and are not blocked, and `Plan.curve_U_m`."""
    for trial in range(_TRIALS):
        if len(pool) < count:
            break
        rows = rows_of(workspace, pool)
        problem = DesignProblem(
            workspace.belief.covariance, rows.dense(workspace.belief), rows.noise_variance, gates
        )
        selection = design.choose(problem, count, group=pool.feature_index, group_limit=face_limit)
        chosen = pool.take(selection.chosen)
        bad = _hindered(workspace, chosen, blocked)
        if not bad.any():
            return chosen, tuple((coverage_factor(3) * np.sqrt(selection.curve)).tolist())
        if trial < _TRIALS - 2:
            pool = pool.take(np.setdiff1d(np.arange(len(pool)), selection.chosen[bad]))
        else:  # the best ones are hindered again and again: look at all of them
            pool = pool.take(~_hindered(workspace, pool, blocked))
    raise _unreachable(f"{count} measurements of the {pool.object}")


def _hindered(workspace: Workspace, candidates: Candidates, blocked: Blocked | None) -> BoolArray:
    """Which candidates (m,) cannot be approached, or are blocked."""
    bad = ~accessible(workspace, candidates)
    return bad if blocked is None else bad | blocked(candidates)


def _spread(pool: Candidates, count: int, used: FloatArray, open_: BoolArray) -> list[int]:
    """Farthest points first, faces in turn: each far from the used ones and from each other."""
    taken = used
    chosen: list[int] = []
    faces = np.unique(pool.feature_index)
    for i in range(count):
        face = faces[i % len(faces)]
        mine = np.flatnonzero((pool.feature_index == face) & open_)
        mine = mine[~np.isin(mine, chosen)]
        if not len(mine):
            raise _unreachable(f"check points on {pool.features[int(face)].name}")
        distance = (
            np.linalg.norm(pool.object_p_m[mine, None] - taken, axis=2).min(axis=1)
            if len(taken)
            else np.arange(len(mine), 0.0, -1.0)
        )
        best = int(mine[np.argmax(distance)])
        chosen.append(best)
        taken = np.concatenate([taken, pool.object_p_m[best : best + 1]])
    return chosen


def margin_m(workspace: Workspace) -> float:
    """How far inside the edges a beam must aim to meet its face."""
    return EDGE_MARGIN_M + workspace.part_offset_m() + SIGMAS * mount_offset_m(workspace)


def _displacements(cell: Cell) -> list[FloatArray]:
    """Places at the limits of where the part may lie: shifted along axes and diagonals, and turned."""
    part = cell.part
    diagonals = np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3.0)
    turns = np.concatenate([np.eye(3), -np.eye(3)])
    return [
        exp_pose(np.concatenate([part.position_limit_m * side, part.rotation_limit_rad * turn]))
        for side in np.concatenate([turns, diagonals])
        for turn in turns
        if abs(side @ turn) < 0.9  # a shift along the axis that it turns about says little
    ]


def _unreachable(what: str) -> CellError:
    return Unreachable(
        f"Not enough clear poses for {what}",
        "Place it nearer to the middle of the arm's reach, or move what stands in the way",
    )
