"""Postures that the planner takes for clear, against collisions found by fcl."""

import numpy as np

from controller.cellfile import Cell
from controller.planning.keepout import Keepout, ToolOutline
from tests.controller.planning.independent import LIMITS_RAD, forearm, frames, overlaps, sensors

POSTURES = 1500


def test_no_clear_posture_has_a_sensor_in_the_forearm(cell: Cell) -> None:
    arm = cell.robot.arm_model()
    mounts = cell.laser.mount.transform(), cell.probe.mount.transform()
    keepout = Keepout(arm, ToolOutline.of(*mounts, float(arm.d[-1])), boxes=())
    joints = np.random.default_rng(21).uniform(-LIMITS_RAD, LIMITS_RAD, (POSTURES, 6))
    links = [frames(posture) for posture in joints]
    met = np.array(
        [any(overlaps(body, forearm(at)) for body in sensors(cell, at[-1]).values()) for at in links]
    )
    clear = keepout.clear(joints)
    assert met.sum() > 100
    assert clear.sum() > 500
    assert not np.any(met & clear)
