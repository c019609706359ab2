"""In which order and by which way: short joint travel, clear of everything."""

from typing import Final

import numpy as np

from controller.planning.keepout import Keepout
from controller.planning.poses import BoolArray, choose_joints
from estimation.errors import Unreachable
from estimation.transform import FloatArray

CARRY_Q2_RAD: Final = 0.0  # upper arm upright, forearm level: the tool is above everything in the cell
CARRY_Q3_RAD: Final = np.pi / 2
# Ways out of a posture before carrying: how far up (m), and how far back along the tool (m).
_DETOURS: Final = ((0.0, 0.0), (0.06, 0.0), (0.0, 0.08), (0.12, 0.0), (0.06, 0.08), (0.0, 0.15))

Route = tuple[FloatArray, ...]  # postures (6,) in order


def carrying(keepout: Keepout, joints_rad: FloatArray) -> FloatArray:
    """The carrying postures (m, 6) above postures (m, 6): same direction, same turn of the wrist.

    Axis 5 is not bent so far that a sensor could meet the forearm: from one to another any turn is clear.
    """
    carry = joints_rad.copy()
    carry[:, 1] = CARRY_Q2_RAD
    carry[:, 2] = np.where(joints_rad[:, 2] < 0.0, -CARRY_Q3_RAD, CARRY_Q3_RAD)
    straight = keepout.arm.theta[4]
    carry[:, 4] = np.clip(straight + carry[:, 4], -keepout.folded_rad, keepout.folded_rad) - straight
    return carry


def accesses(keepout: Keepout, joints_rad: FloatArray, touching: str = "") -> list[Route | None]:
    """The way to each posture (m, 6) from its carrying posture, which comes first; None if there is none."""
    routes: list[Route | None] = [None] * len(joints_rad)
    carry = carrying(keepout, joints_rad)
    possible = keepout.clear(joints_rad, touching) & keepout.clear(carry)
    flange = keepout.arm.flange_pose(joints_rad)
    for up_m, back_m in _DETOURS:
        open_rows = np.flatnonzero(possible & np.array([route is None for route in routes]))
        if not len(open_rows):
            break
        near, start = joints_rad[open_rows], carry[open_rows]
        if up_m == back_m == 0.0:
            clear = keepout.path_clear(start, near, touching)
            detour = None
        else:
            poses = flange[open_rows].copy()
            poses[:, 2, 3] += up_m
            poses[:, :3, 3] -= back_m * poses[:, :3, 2]
            detour, found = choose_joints(keepout.arm, poses, near)
            found &= (np.abs(detour - near) < 1.0).all(axis=1)  # the same branch
            clear = found & keepout.clear(detour)
            clear &= keepout.path_clear(detour, near, touching) & keepout.path_clear(start, detour)
        for place, row in enumerate(open_rows):
            if clear[place]:
                routes[row] = (start[place],) if detour is None else (start[place], detour[place])
    return routes


def nearest_order(joints_rad: FloatArray, start_rad: FloatArray) -> list[int]:
    """Order of postures (m, 6) such that each is the nearest of those left, by the joint that moves most."""
    left = list(range(len(joints_rad)))
    order: list[int] = []
    here = start_rad
    while left:
        distance = np.abs(joints_rad[left] - here).max(axis=1)
        order.append(left.pop(int(np.argmin(distance))))
        here = joints_rad[order[-1]]
    return order


def connections(keepout: Keepout, joints_rad: FloatArray, routes: list[Route]) -> list[Route]:
    """What to pass before each of ordered postures (m, 6): nothing, a detour, or over the carrying postures.

    The first is reached from any carrying posture. `routes` are the `accesses` of the postures.
    """
    vias: list[Route] = [routes[0]] if routes else []
    if len(joints_rad) > 1:
        direct: BoolArray = keepout.path_clear(joints_rad[:-1], joints_rad[1:])
        for row in range(1, len(joints_rad)):
            vias.append(() if direct[row - 1] else (*reversed(routes[row - 1]), *routes[row]))
    return vias


def require_all(routes: list[Route | None], what: str) -> list[Route]:
    """The routes, when there is one for each posture; raises Unreachable otherwise."""
    found = [route for route in routes if route is not None]
    if len(found) < len(routes):
        raise Unreachable(
            f"{len(routes) - len(found)} of {len(routes)} postures for {what} have no clear approach",
            "Move what stands in the way, or place the object nearer to the middle of the arm's reach",
        )
    return found
