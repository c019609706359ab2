"""Postures that the planner takes for clear, against collisions found by fcl."""

from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import Cell, load_cell
from controller.planning.keepout import Keepout, ToolOutline
from controller.planning.paths import carrying
from tests.controller.planning.independent import LIMITS_RAD, forearm, frames, overlaps, sensors
from tests.controller.planning.planned import CELL

POSTURES = 1500


def keepout_of(cell: Cell, forearm_m: float) -> Keepout:
    mounts = cell.laser.mount.transform(), cell.probe.mount.transform()
    arm = cell.robot.arm_model()
    return Keepout(arm, ToolOutline.of(*mounts, float(arm.d[-1])), (), forearm_m)


def in_forearm(cell: Cell, joints_rad: np.ndarray) -> np.ndarray:
    links = [frames(posture) for posture in joints_rad]
    return np.array(
        [any(overlaps(body, forearm(at)) for body in sensors(cell, at[-1]).values()) for at in links]
    )


def test_no_clear_posture_has_a_sensor_in_the_forearm(cell: Cell) -> None:
    joints = np.random.default_rng(21).uniform(-LIMITS_RAD, LIMITS_RAD, (POSTURES, 6))
    met, clear = in_forearm(cell, joints), keepout_of(cell, cell.robot.forearm_m).clear(joints)
    assert met.sum() > 100
    assert clear.sum() > 500
    assert not np.any(met & clear)


def test_any_way_between_carrying_postures_keeps_the_sensors_off_the_forearm(cell: Cell) -> None:
    random = np.random.default_rng(22)
    start, end = random.uniform(-LIMITS_RAD, LIMITS_RAD, (2, 100, 6))
    carry = [carrying(keepout_of(cell, cell.robot.forearm_m), joints) for joints in (start, end)]
    shares = np.linspace(0.0, 1.0, 9)[:, None, None]
    assert in_forearm(cell, (start + shares * (end - start)).reshape(-1, 6)).any()
    assert not in_forearm(cell, (carry[0] + shares * (carry[1] - carry[0])).reshape(-1, 6)).any()


def test_the_cell_file_may_say_how_thick_the_forearm_is(cell: Cell, tmp_path: Path) -> None:
    assert cell.robot.forearm_m == pytest.approx(0.045, abs=5e-4)  # 0.147 of 307 mm
    text = (CELL / "cell.toml").read_text(encoding="utf-8")
    thick = text.replace('model = "PRBT"', 'model = "PRBT"\nforearm_radius = "80 mm"')
    (tmp_path / "cell.toml").write_text(thick, encoding="utf-8")
    (tmp_path / "block.step").write_bytes((CELL / "block.step").read_bytes())
    radius_m = load_cell(tmp_path).robot.forearm_m
    assert radius_m == pytest.approx(0.08)
    joints = np.random.default_rng(21).uniform(-LIMITS_RAD, LIMITS_RAD, (POSTURES, 6))
    slim, stout = (keepout_of(cell, m).clear(joints) for m in (cell.robot.forearm_m, radius_m))
    assert np.all(slim | ~stout) and slim.sum() > stout.sum()
