"""Paths in interpolated position mode, against the simulated drives in virtual time."""

from dataclasses import dataclass

import numpy as np
import pytest

from drivers.capabilities import PathRobot
from estimation.errors import DeviceError, MotionStopped
from estimation.transform import FloatArray
from simulators.registry import DEVICES
from simulators.robots.canopen_arm import SimulatedArm
from simulators.virtual import VirtualClock, VirtualPorts, virtual_links
from tests.conformance.pairs import arm

PERIOD_S = 0.02
DEG = np.pi / 180.0


@dataclass
class Rig:
    clock: VirtualClock
    model: SimulatedArm
    robot: PathRobot


@pytest.fixture
def rig() -> Rig:
    clock = VirtualClock()
    clock.sleep(10.0)
    device = DEVICES["canopen-402"].simulated(1, noise_deg=0.0)
    robot = arm({}, VirtualPorts(virtual_links("robot", clock, lambda: device)), clock)
    robot.connect()
    return Rig(clock, device.model, robot)  # type: ignore[arg-type]


def circle(seconds: float) -> FloatArray:
    """Joints 1 and 2 go round, softly at both ends; (n, 6)."""
    share = np.linspace(0.0, 1.0, round(seconds / PERIOD_S))
    angle = 2.0 * np.pi * (share - np.sin(2.0 * np.pi * share) / (2.0 * np.pi))
    path = np.zeros((len(share), 6))
    path[:, 0], path[:, 1] = 10 * DEG * np.sin(angle), 10 * DEG * (1.0 - np.cos(angle))
    return path


def test_the_arm_is_on_the_path_one_period_behind_each_set_point(rig: Rig) -> None:
    path = circle(4.0)
    began_s = rig.clock.now_s()
    rig.robot.follow_path(path)
    instants = np.arange(began_s, rig.clock.now_s(), 0.005)
    joints = np.array([rig.model.joints_at(t) for t in instants])
    radius = np.hypot(joints[:, 0], joints[:, 1] - 10 * DEG)
    assert np.ptp(joints[:, 0]) == pytest.approx(20 * DEG, rel=1e-3)
    assert np.abs(radius - 10 * DEG).max() < 0.03 * DEG  # chords between set-points
    assert rig.robot.is_at_rest()
    assert rig.robot.read_joints(1).joints_rad[0] == pytest.approx(path[-1], abs=1e-4)


def test_profile_position_works_before_and_after(rig: Rig) -> None:
    rig.robot.move_joints(np.full(6, 0.1))
    rig.robot.follow_path(np.full((5, 6), 0.1))
    rig.robot.move_joints(np.full(6, -0.1))
    assert rig.model.joints_at(rig.clock.now_s()) == pytest.approx(np.full(6, -0.1), abs=1e-4)


def test_a_stop_ends_the_path_and_moves_are_possible_after_release(rig: Rig) -> None:
    sleep = rig.clock.advance_to
    stop_s = rig.clock.now_s() + 2.0

    def advance(time_s: float) -> None:
        sleep(time_s)
        if rig.clock.now_s() > stop_s:
            rig.clock.advance_to = sleep  # type: ignore[method-assign]
            rig.robot.stop()

    rig.clock.advance_to = advance  # type: ignore[method-assign]
    with pytest.raises(MotionStopped):
        rig.robot.follow_path(circle(4.0))
    assert rig.clock.now_s() < stop_s + 1.0
    stood = rig.model.joints_at(rig.clock.now_s())
    rig.clock.sleep(0.5)
    assert rig.model.joints_at(rig.clock.now_s()) == pytest.approx(stood, abs=1e-9)
    rig.robot.release()
    rig.robot.move_joints(np.zeros(6))
    assert rig.model.joints_at(rig.clock.now_s()) == pytest.approx(np.zeros(6), abs=1e-4)


def test_a_path_that_is_too_fast_or_begins_elsewhere_moves_nothing(rig: Rig) -> None:
    for path, point in ((circle(4.0) + 0.1, 1), (circle(0.4), 5)):
        with pytest.raises(DeviceError, match=rf"Point {point} of the path .* in one SYNC period of 20 ms"):
            rig.robot.follow_path(path)
    with pytest.raises(DeviceError, match="limits"):
        rig.robot.follow_path(np.full((3, 6), 10.0))
    assert rig.model.joints_at(rig.clock.now_s()) == pytest.approx(np.zeros(6), abs=1e-6)
