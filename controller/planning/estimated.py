"""Plans for the phases that estimate: hand-eye and localization, and the part's check."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from controller.cellfile import Cell
from controller.knowledge import part_corners_m
from controller.planning.candidates import (
    EDGE_MARGIN_M,
    mount_offset_m,
    occluded,
    part_candidates,
    plate_candidates,
)
from controller.planning.plan import Plan, accessible, gated_predictions, laser_steps
from controller.planning.selection import select
from controller.planning.steps import Step
from controller.planning.workspace import SIGMAS, Candidates, Workspace, observations_of, rows_of
from estimation.belief import Belief
from estimation.errors import CellError, Unreachable
from estimation.kinematics import ArmModel
from estimation.measurement import Points, object_point_jacobian, point_jacobian
from estimation.solver import predicted_belief
from estimation.transform import FloatArray, exp_pose

COARSE_COUNT: Final = 10
_ROUNDS: Final = 8  # in which choices that turn out to be blocked are replaced
_CORNERS: Final = tuple(f"corner {x}{y}{z}" for x in "-+" for y in "-+" for z in "-+")

Blocked = Callable[[Candidates], FloatArray]


def plan_hand_eye(cell: Cell, belief: Belief, arm: ArmModel, count: int, seed: int) -> Plan:
    """Laser on the plate: the `count` poses that leave the gated points most certain.

    The belief holds the plate's block. The better the belief, the more of the working range is used.
    """
    return _hand_eye(cell, belief, arm, count, seed, "")


def more_hand_eye(
    cell: Cell, belief: Belief, arm: ArmModel, steps: Sequence[Step], count: int, seed: int
) -> Plan:
    """`count` further poses after those of `steps`, which the belief has used already."""
    return _hand_eye(cell, belief, arm, count, seed + len(steps), "added")


def hand_eye_points(belief: Belief, ranges_m: Sequence[float]) -> tuple[Points, tuple[str, ...]]:
    """The gated points of a hand-eye: those of readings at given distances, in the flange."""
    names = tuple(f"{range_m * 1e3:.0f} mm" for range_m in ranges_m)
    return point_jacobian(belief, np.array(ranges_m)), names


def plan_coarse_localize(
    cell: Cell, belief: Belief, arm: ArmModel, faces: Sequence[str], seed: int, count: int = COARSE_COUNT
) -> Plan:
    """The first points on a part that was clamped by hand: each meets its face wherever the part may lie."""
    workspace = Workspace(cell, arm, belief)
    margin_m = EDGE_MARGIN_M + workspace.part_offset_m() + SIGMAS * mount_offset_m(workspace)
    pool = part_candidates(workspace, faces, seed, margin_m=margin_m)
    displacements = _displacements(cell)
    limit = -(-count // len(faces)) + 1  # no face may be left out
    return _part_plan(
        workspace, pool, count, "coarse", limit, lambda chosen: occluded(workspace, chosen, displacements)
    )


def plan_localize(
    cell: Cell, belief: Belief, arm: ArmModel, faces: Sequence[str], count: int, seed: int
) -> Plan:
    """The `count` points on the faces that leave the corners of the part most certain.

    The belief has used the coarse points already, so that beams may go near the edges.
    """
    workspace = Workspace(cell, arm, belief)
    pool = part_candidates(workspace, faces, seed, margin_m=_fine_margin_m(workspace))
    return _part_plan(workspace, pool, count, "", 0, lambda chosen: occluded(workspace, chosen))


def more_localize(
    cell: Cell,
    belief: Belief,
    arm: ArmModel,
    faces: Sequence[str],
    steps: Sequence[Step],
    count: int,
    seed: int,
) -> Plan:
    """`count` further points after those of `steps`, which the belief has used already."""
    return plan_localize(cell, belief, arm, faces, count, seed + len(steps))


def plan_part_check(
    cell: Cell,
    belief: Belief,
    arm: ArmModel,
    faces: Sequence[str],
    count: int,
    steps: Sequence[Step],
    seed: int,
) -> Plan:
    """`count` points that no fit has used, on all faces, away from the used points and spread out."""
    workspace = Workspace(cell, arm, belief)
    pool = part_candidates(workspace, faces, seed + 7919, margin_m=_fine_margin_m(workspace))
    used = np.array([step.object_p_m for step in steps if step.object == "part" and step.kind == "laser"])
    chosen: list[int] = []
    blocked = np.zeros(len(pool), dtype=np.bool_)
    for _ in range(_ROUNDS):
        chosen = _spread(pool, count, used.reshape(-1, 3), ~blocked)
        bad = occluded(workspace, pool.take(chosen)) | ~accessible(workspace, pool.take(chosen))
        if not bad.any():
            return Plan(laser_steps(workspace, pool.take(chosen), "check"))
        blocked[np.array(chosen)[bad]] = True
    raise _unreachable("check points on the part")


def corner_points(cell: Cell, belief: Belief) -> tuple[Points, tuple[str, ...]]:
    """The gated points of a localization."""
    return object_point_jacobian(belief, "part", part_corners_m(cell)), _CORNERS


def _hand_eye(cell: Cell, belief: Belief, arm: ArmModel, count: int, seed: int, note: str) -> Plan:
    workspace = Workspace(cell, arm, belief)
    pool = plate_candidates(workspace, seed)
    points, names = hand_eye_points(belief, _gated_ranges_m(cell))
    chosen = _choose(workspace, pool, points, count, 0, lambda some: np.zeros(len(some), dtype=np.bool_))
    predicted = predicted_belief(belief, arm, [observations_of(workspace, chosen)], "hand-eye")
    return Plan(laser_steps(workspace, chosen, note), gated_predictions(predicted, points, names), predicted)


def _part_plan(
    workspace: Workspace, pool: Candidates, count: int, note: str, face_limit: int, blocked: Blocked
) -> Plan:
    points, names = corner_points(workspace.cell, workspace.belief)
    chosen = _choose(workspace, pool, points, count, face_limit, blocked)
    predicted = predicted_belief(
        workspace.belief, workspace.arm, [observations_of(workspace, chosen)], "localization"
    )
    return Plan(laser_steps(workspace, chosen, note), gated_predictions(predicted, points, names), predicted)


def _choose(
    workspace: Workspace, pool: Candidates, points: Points, count: int, face_limit: int, blocked: Blocked
) -> Candidates:
    """The best candidates that can be approached and are not blocked."""
    for _ in range(_ROUNDS):
        if len(pool) < count:
            break
        rows = rows_of(workspace, pool)
        selection = select(
            workspace.belief.covariance,
            rows.dense(workspace.belief),
            rows.noise_variance,
            points.jacobian,
            count,
            group=pool.feature_index.astype(np.intp) if face_limit else None,
            group_limit=face_limit,
        )
        chosen = pool.take(selection.chosen)
        bad = blocked(chosen) | ~accessible(workspace, chosen)
        if not bad.any():
            return chosen
        pool = pool.take(np.setdiff1d(np.arange(len(pool)), selection.chosen[bad]))
    raise _unreachable(f"{count} measurements of the {pool.object}")


def _spread(pool: Candidates, count: int, used: FloatArray, open_: FloatArray) -> list[int]:
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


def _fine_margin_m(workspace: Workspace) -> float:
    return EDGE_MARGIN_M + workspace.part_offset_m() + SIGMAS * mount_offset_m(workspace)


def _displacements(cell: Cell) -> list[FloatArray]:
    """Eight places at the limits of where the part may lie: all corners of shift, turned either way."""
    part = cell.part
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3.0)
    return [
        exp_pose(np.concatenate([part.position_limit_m * sign, part.rotation_limit_rad * np.roll(sign, 1)]))
        for sign in signs
    ]


def _gated_ranges_m(cell: Cell) -> tuple[float, ...]:
    for phase in cell.job.phases:
        if phase.kind == "hand_eye":
            return phase.gated_ranges_m
    return cell.laser.working_range_m


def _unreachable(what: str) -> CellError:
    return Unreachable(
        f"Not enough clear poses for {what}",
        "Place it nearer to the middle of the arm's reach, or move what stands in the way",
    )
