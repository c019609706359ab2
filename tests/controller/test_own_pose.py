"""A robot's own pose against its joints: the same geometry, tool, base and angles, or nothing is measured."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.cellfile import Cell, load_cell
from controller.own_pose import PoseMismatch, pose_gap, require_same_pose
from controller.packml import State
from drivers.capabilities import JointReadings
from drivers.robots.controller_arm import ControllerArm
from estimation.transform import FloatArray, Transform, exp_pose
from tests.support.deterministic import BENCH_BLOCK, DeterministicCell
from tests.test_variants import variant_cell

MM, DEG = 1e-3, np.pi / 180.0
POSTURES = np.radians([[0, 0, -90, 0, -90, 0], [40, -20, -70, 15, -60, 80], [-70, 30, -110, -40, 50, -120]])


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell(BENCH_BLOCK / "cell.toml")


def standing(posture: FloatArray) -> JointReadings:
    return JointReadings(np.zeros(3), np.tile(posture, (3, 1)))


@pytest.mark.parametrize("posture", POSTURES)
def test_a_pose_of_the_same_geometry_agrees_whatever_its_decimals(cell: Cell, posture: FloatArray) -> None:
    arm = cell.robot.arm_model()
    pose = arm.flange_pose(posture[None])[0]
    pose[:3, 3] = np.round(pose[:3, 3], 5)
    gap = pose_gap(cell, arm, standing(posture), Transform("base", "flange", pose))
    assert gap.agrees
    assert 0.1 * MM < gap.distance_limit_m < 1.5 * MM
    assert gap.angle_limit_rad < 0.2 * DEG


MISTAKES = {
    "active tool": exp_pose(np.array([0.0, 0.0, 0.120, 0.0, 0.0, 0.0])),
    "base": exp_pose(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2])),
    "two millimetres": exp_pose(np.array([0.0, 2.0 * MM, 0.0, 0.0, 0.0, 0.0])),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_another_tool_or_base_is_refused_with_both_gaps(cell: Cell, mistake: str) -> None:
    arm, posture = cell.robot.arm_model(), POSTURES[1]
    reported = Transform("base", "flange", arm.flange_pose(posture[None])[0] @ MISTAKES[mistake])
    with pytest.raises(
        PoseMismatch, match=r"mm and .* deg away from where its joints have it, limits 0\.\d\d mm"
    ):
        require_same_pose(cell, arm, standing(posture), reported)


def test_angles_in_another_order_are_refused(cell: Cell) -> None:
    arm, posture = cell.robot.arm_model(), POSTURES[1]
    pose = arm.flange_pose(posture[None])[0]
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
    pose[:3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    with pytest.raises(PoseMismatch):
        require_same_pose(cell, arm, standing(posture), Transform("base", "flange", pose))


@pytest.fixture
def robot_cell(tmp_path: Path) -> Iterator[DeterministicCell]:
    cell = variant_cell(1, tmp_path, ("ur",))
    yield cell
    cell.close()


def test_a_job_is_held_before_it_calibrates_when_another_tool_is_active(
    robot_cell: DeterministicCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = ControllerArm.read_pose

    def with_tool(arm: ControllerArm) -> Transform:
        pose = own(arm)
        return Transform(pose.target, pose.source, pose.matrix @ MISTAKES["active tool"])

    monkeypatch.setattr(ControllerArm, "read_pose", with_tool)
    assert robot_cell.run() is State.HELD
    fault = robot_cell.engine.status()["fault"]
    assert fault["code"] == "R7"
    assert "120.0" in fault["text"]
    assert robot_cell.results() == {}
