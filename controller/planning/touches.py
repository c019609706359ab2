"""Touches with the stylus: approach, contact, and the way in and out from above."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from controller.planning.paths import Route, accesses, connections, nearest_order, require_all
from controller.planning.plan import closed, postures
from controller.planning.poses import BoolArray, IntArray, ball_poses, choose_joints
from controller.planning.steps import Step, as_joints
from controller.planning.workspace import Candidates, Workspace, rows_of
from estimation.inverse_kinematics import refine
from estimation.surfaces import Feature
from estimation.transform import FloatArray

APPROACH_M: Final = 0.0015  # beyond what the place is uncertain by, on either side of the expected contact
APPROACH_SIGMAS: Final = 3.0
HOVER_M: Final = 0.012  # off a surface between two touches of it
ABOVE_M: Final = 0.015  # of the ball over everything of the object, on the way to another feature
_SAME_BRANCH_RAD: Final = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class Aims:
    """Contacts that are wanted; points and directions in the frame of the object unless they say base."""

    object: str
    features: tuple[Feature, ...]
    feature_index: IntArray  # (m,)
    contact_p_m: FloatArray  # (m, 3) ball centre at contact
    normal: FloatArray  # (m, 3) from the surface to the ball
    hover_p_m: FloatArray  # (m, 3) ball centre before the approach
    base_tool: FloatArray  # (m, 3) direction of the stylus, frame base
    spin_rad: FloatArray  # (m,)

    def take(self, rows: IntArray) -> "Aims":
        """Some of them."""
        return Aims(
            self.object,
            self.features,
            self.feature_index[rows],
            self.contact_p_m[rows],
            self.normal[rows],
            self.hover_p_m[rows],
            self.base_tool[rows],
            self.spin_rad[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Touches:
    """Touches that can be made: joints (m, 6) at every station of the way in."""

    contact: Candidates  # rows of the model, at the expected contact
    above_rad: FloatArray
    hover_rad: FloatArray
    start_rad: FloatArray
    end_rad: FloatArray
    approach_m: FloatArray  # (m,) from start to the expected contact

    def take(self, rows: IntArray) -> "Touches":
        """Some of them."""
        return Touches(
            self.contact.take(rows),
            self.above_rad[rows],
            self.hover_rad[rows],
            self.start_rad[rows],
            self.end_rad[rows],
            self.approach_m[rows],
        )


def contacts_of(workspace: Workspace, aims: Aims) -> tuple[FloatArray, BoolArray]:
    """Joints (m, 6) at the contacts alone, and which of them (m,) are reached and clear."""
    flange = _flange(workspace, aims, aims.contact_p_m)
    joints, found = choose_joints(workspace.arm, flange, workspace.start_rad)
    found[found] = workspace.keepout.clear(joints[found], aims.object)
    return joints, found


def touches_of(workspace: Workspace, aims: Aims) -> tuple[Touches, IntArray]:
    """The touches that can be made clear of everything, and their rows in the aims."""
    contact, found = contacts_of(workspace, aims)
    rows = np.flatnonzero(found)
    aims, contact = aims.take(rows), contact[rows]
    contact = _refined(workspace, aims, aims.contact_p_m, contact)
    count = len(rows)
    candidates = Candidates(
        "probe", aims.object, aims.features, contact, np.zeros(count), aims.feature_index, aims.contact_p_m
    )
    dense = rows_of(workspace, candidates).dense(workspace.belief)
    variance = np.einsum("mi,mi->m", dense @ workspace.belief.covariance, dense)
    approach = APPROACH_M + APPROACH_SIGMAS * np.sqrt(np.maximum(variance, 0.0))
    way = approach[:, None] * aims.normal
    stations = [_above(workspace, aims), aims.hover_p_m, aims.contact_p_m + way, aims.contact_p_m - way]
    joints, possible = [], np.ones(count, dtype=np.bool_)
    for station in stations:
        near, here = choose_joints(workspace.arm, _flange(workspace, aims, station), contact)
        possible &= here & (np.abs(near - contact) < _SAME_BRANCH_RAD).all(axis=1)
        joints.append(_refined(workspace, aims, station, np.where(here[:, None], near, contact)))
    above, hover, start, end = joints
    keepout = workspace.keepout
    possible &= keepout.clear(above)
    for posture in (hover, start, end):
        possible &= keepout.clear(posture, aims.object)
    possible[possible] = keepout.path_clear(above[possible], hover[possible], aims.object)
    possible[possible] = keepout.path_clear(hover[possible], start[possible], aims.object)
    touches = Touches(candidates, above, hover, start, end, approach)
    return touches.take(np.flatnonzero(possible)), rows[possible]


def touch_steps(workspace: Workspace, groups: Sequence[tuple[str, Touches]]) -> tuple[Step, ...]:
    """Steps of all groups (note, touches) in turn, each group in an order of short travel.

    Within one group the ball stays at the hovering stations where the straight way between them is
    free: along a plane, inside a bore. Around a boss or a sphere it goes over the top.
    """
    ordered: list[Touches] = []
    notes: list[str] = []
    here = workspace.start_rad
    for note, touches in groups:
        order = np.array(nearest_order(touches.hover_rad, here), dtype=np.intp)
        ordered.append(touches.take(order))
        notes += [note] * len(order)
        here = ordered[-1].hover_rad[-1]
    above = np.concatenate([touches.above_rad for touches in ordered])
    routes = require_all(accesses(workspace.keepout, above), "touches")
    links = connections(workspace.keepout, above, routes)
    steps: list[Step] = []
    for touches in ordered:
        for i in range(len(touches.contact)):
            number = len(steps)
            stays = i > 0 and _may_stay(touches.contact, i - 1, i)
            if stays:
                steps[-1] = replace(steps[-1], retreat=steps[-1].retreat[:1])
            via = (touches.hover_rad[i],) if stays else (*links[number], above[number], touches.hover_rad[i])
            steps.append(_step(touches, i, number, via, routes[number], notes[number]))
    return closed(steps)


def _step(touches: Touches, row: int, number: int, via: Route, route: Route, note: str) -> Step:
    above, hover = touches.above_rad[row], touches.hover_rad[row]
    contact = touches.contact
    return Step(
        id=f"{number + 1:03d}",
        kind="touch",
        object=contact.object,
        feature=contact.features[int(contact.feature_index[row])].name,
        joints_rad=as_joints(touches.start_rad[row]),
        via=postures(via),
        retreat=postures((hover, above)),
        access=postures((*route, above, hover)),
        contact_rad=as_joints(touches.end_rad[row]),
        expected_m=float(touches.approach_m[row]),
        object_p_m=as_joints(contact.object_p_m[row]),
        note=note,
    )


def _may_stay(contact: Candidates, before: int, after: int) -> bool:
    if contact.feature_index[before] != contact.feature_index[after]:
        return False
    feature = contact.features[int(contact.feature_index[after])]
    return feature.kind == "plane" or (feature.kind == "cylinder" and not feature.outward)


def _above(workspace: Workspace, aims: Aims) -> FloatArray:
    """Stations over the hovering ones, as high as the ball is clear of the object; frame of the object."""
    pose = workspace.pose(aims.object)
    base = pose.points(aims.hover_p_m)
    top_m = max(box.top_m for box in workspace.keepout.boxes if box.name == aims.object)
    base[:, 2] = np.maximum(base[:, 2], top_m + ABOVE_M)
    return pose.inverse().points(base)


def _refined(workspace: Workspace, aims: Aims, object_p: FloatArray, joints: FloatArray) -> FloatArray:
    """The same stations with the arm as calibrated: touches are nearer to surfaces than beams."""
    return refine(workspace.actual_arm, _flange(workspace, aims, object_p), joints, tolerance=1e-6)[0]


def _flange(workspace: Workspace, aims: Aims, object_p: FloatArray) -> FloatArray:
    base_p = workspace.pose(aims.object).points(object_p)
    return ball_poses(base_p, aims.base_tool, aims.spin_rad, workspace.pose("probe").origin_m)
