"""How long a plan takes: moves by the arm's declared speed and acceleration, and the time of measuring."""

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from controller.cellfile import Cell
from controller.planning.steps import Step
from drivers.robots.motion_profile import synchronize

POSITION_S: Final = 0.3  # from the end of a motion until the drives say so
WINDOW_S: Final = 0.1  # of readings together, beside the settling


def duration_s(cell: Cell, steps: Sequence[Step]) -> float:
    """Seconds from the carrying posture of the first step to that of the last."""
    total, here = 0.0, steps[0].access[0] if steps and steps[0].access else None
    for step in steps:
        way = [*([here] if here else []), *step.via, step.joints_rad]
        total += _moves_s(cell, way) + cell.robot.settle_time_s + WINDOW_S
        if step.kind == "touch":
            slow = step.expected_m / cell.probe.search_speed_m_s  # and the same way back
            total += 2.0 * slow
        if step.kind == "noise":
            total += (step.readings or cell.robot.readings) * WINDOW_S / cell.robot.readings
        total += _moves_s(cell, [step.joints_rad, *step.retreat])
        here = step.end_rad
    return total


def _moves_s(cell: Cell, postures: Iterable[Sequence[float]]) -> float:
    way = np.array(list(postures))
    speed = np.full(way.shape[1], cell.robot.speed_rad_s)
    acceleration = np.full(way.shape[1], cell.robot.acceleration_rad_s2)
    moves = [synchronize(distance, speed, acceleration).duration_s for distance in np.diff(way, axis=0)]
    return sum(move_s + POSITION_S for move_s in moves if move_s > 0.0)
