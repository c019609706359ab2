"""What every arm behind a controller of its own must do, whatever protocol it speaks; in virtual time."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.cellfile import load_cell
from drivers.capabilities import StopWay
from estimation.errors import DeviceError, DeviceTimeout, MotionStopped, StillMoving
from estimation.transform import Transform
from tests.drivers.robots.rig import ABB, CELL, IGUS, MELFA_SERIAL, MELFA_TCP, UR, RobotRig, TimedProbe

DEG = np.pi / 180
ROBOTS: list[dict[str, Any]] = [MELFA_TCP, MELFA_SERIAL, IGUS, UR, ABB]


@pytest.fixture(params=ROBOTS, ids=lambda settings: settings["driver"])
def rig(request: pytest.FixtureRequest, cache: Path) -> RobotRig:
    rig = RobotRig(cache, request.param)
    rig.robot.connect()
    return rig


def stop_after(rig: RobotRig, delay_s: float) -> None:
    """Whoever waits, for a while or for an answer, finds the stop requested afterwards."""
    asked_s = rig.clock.now_s() + delay_s
    sleep, advance_to, asked = rig.clock.sleep, rig.clock.advance_to, list[bool]()

    def stop_in_time() -> None:
        if rig.clock.now_s() >= asked_s and not asked:
            asked.append(True)
            rig.robot.stop()

    rig.clock.sleep = lambda duration_s: (sleep(duration_s), stop_in_time())[0]  # type: ignore[func-returns-value, method-assign]
    rig.clock.advance_to = lambda time_s: (advance_to(time_s), stop_in_time())[0]  # type: ignore[func-returns-value, method-assign]


def test_a_move_ends_at_the_target_and_at_rest(rig: RobotRig) -> None:
    """EXEC answers on acceptance; the move begins 30 ms later and is not taken for ended before."""
    target = rig.truth_rad() + np.array([20, -10, 15, 5, -25, 40]) * DEG
    rig.robot.move_joints(target)
    assert not rig.arm.moving(rig.clock.now_s())
    assert rig.truth_rad() == pytest.approx(target, abs=0.0001 * DEG)
    readings = rig.robot.read_joints(5)
    assert readings.joints_rad == pytest.approx(np.tile(target, (5, 1)), abs=0.015 * DEG)
    assert (np.diff(readings.time_s) > 0).all()
    assert rig.robot.is_at_rest()


def test_a_move_within_the_in_position_window_is_waited_for(rig: RobotRig) -> None:
    """The arm is where it shall be before it has begun to move: that is not the end of the move."""
    target = rig.truth_rad() + 0.01 * DEG
    rig.robot.move_joints(target)
    assert rig.truth_rad() == pytest.approx(target, abs=0.0001 * DEG)


def test_a_linear_move_keeps_to_the_line_and_ends_at_its_pose(rig: RobotRig) -> None:
    assert rig.robot.abilities.linear_moves
    rig.robot.move_joints(rig.truth_rad() + np.array([0, 20, -30, 0, -20, 0]) * DEG)
    begin, begun_s = rig.arm.pose_of(rig.truth_rad()), rig.clock.now_s()
    matrix = begin.copy()
    matrix[:3, 3] += (0.03, 0.04, -0.01)
    target = Transform("base", "flange", matrix)
    rig.robot.move_linear(target, 0.05)  # type: ignore[attr-defined]
    assert rig.robot.is_at_rest()
    way = np.array(
        [
            rig.arm.pose_of(rig.arm.joints_at(time_s))[:3, 3] - begin[:3, 3]
            for time_s in np.linspace(begun_s, rig.clock.now_s(), 40)
        ]
    )
    along = (matrix - begin)[:3, 3] / np.linalg.norm((matrix - begin)[:3, 3])
    assert np.max(np.linalg.norm(way - np.outer(way @ along, along), axis=1)) < 6e-4
    assert way[-1] == pytest.approx((matrix - begin)[:3, 3], abs=6e-4)


def test_an_arm_that_does_not_heed_a_stop_is_not_called_stopped(
    rig: RobotRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The halt is lost on its way, and the arm is still under way when it is looked at."""
    arm: Any = rig.robot
    monkeypatch.setattr("drivers.robots.controller_arm.REST_TIMEOUT_S", 0.05)
    monkeypatch.setattr(arm, "_halt", lambda: None)
    monkeypatch.setattr(arm, "is_at_rest", lambda: False)
    stop_after(rig, 0.3)
    with pytest.raises(StillMoving, match=r"not at rest .* Use the emergency stop") as raised:
        rig.robot.move_joints(rig.truth_rad() + np.array([60, 0, 0, 0, 0, 0]) * DEG)
    assert isinstance(raised.value.__cause__, MotionStopped)


def test_an_arm_that_is_found_moving_is_brought_to_rest_before_its_motors_are_enabled(
    rig: RobotRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop that was given while the link was down is not lost, and nothing goes on by itself."""
    arm: Any = rig.robot
    if arm.abilities.stop is StopWay.BETWEEN_STEPS:
        pytest.skip("has no stop: each of its short steps ends by itself")
    start = rig.truth_rad()
    arm._start(start + np.array([60, 0, 0, 0, 0, 0]) * DEG, 0.3)
    rig.clock.sleep(0.5)
    rig.robot.connect()
    assert not rig.arm.moving(rig.clock.now_s())
    assert 0.5 * DEG < np.max(rig.truth_rad() - start) < 59 * DEG


def test_a_linear_move_is_stopped_on_request(rig: RobotRig) -> None:
    pose = rig.robot.read_pose()  # type: ignore[attr-defined]
    rig.robot.stop()
    with pytest.raises(MotionStopped):
        rig.robot.move_linear(pose, 0.05)  # type: ignore[attr-defined]
    with pytest.raises(DeviceError, match="Speed 0 m/s"):
        rig.robot.move_linear(pose, 0.0)  # type: ignore[attr-defined]


def test_pose_agrees_with_the_joints_by_a_kinematics_of_another_hand(rig: RobotRig, cache: Path) -> None:
    """Cross-check of the reported pose with the estimator's forward kinematics, at three poses."""

    model = load_cell(CELL).robot.arm_model()
    not_abb = rig.table.driver != "abb-open"  # its quaternions have three decimals
    for turn in (0.0, 0.3, -0.4):
        rig.robot.move_joints(rig.table.start_joints_rad + np.array([turn, turn, -turn, 0.5, turn, 1.0]))
        pose = rig.robot.read_pose()  # type: ignore[attr-defined]
        expected = model.flange_pose(rig.robot.read_joints(1).joints_rad)[0]
        assert pose.origin_m == pytest.approx(expected[:3, 3], abs=3e-4)  # 0.01 deg on 0.7 m, and 0.01 mm
        assert pose.rotation == pytest.approx(expected[:3, :3], abs=8e-4 if not_abb else 2e-3)


@pytest.mark.parametrize("speed_deg_s", [0.15, 1.2])
def test_a_guarded_move_stops_and_says_how_late_its_joints_are(rig: RobotRig, speed_deg_s: float) -> None:
    start = rig.truth_rad()
    probe = TimedProbe(rig, rig.clock.now_s() + 2.0)
    contact = rig.robot.move_until_contact(start + 10 * DEG, speed_deg_s * DEG, probe)
    assert contact is not None and rig.robot.is_at_rest()
    at_contact = rig.arm.joints_at(probe.contact_s)
    passed = (contact.joints_rad - at_contact) / (speed_deg_s * DEG)
    reading_s = 0.0065 / speed_deg_s  # half a step of the reading and its noise, as time
    assert (passed >= -reading_s).all() and (passed <= contact.late_s + reading_s).all()
    assert contact.late_s < 0.25


def test_a_guarded_move_without_contact_ends_at_the_target(rig: RobotRig) -> None:
    target = rig.truth_rad() + 1 * DEG
    assert rig.robot.move_until_contact(target, 5 * DEG, TimedProbe(rig, np.inf)) is None
    assert rig.truth_rad() == pytest.approx(target, abs=0.0001 * DEG)


def test_a_stop_ends_the_move_and_a_release_allows_the_next(rig: RobotRig) -> None:
    start = rig.truth_rad()
    sleep, advance_to = rig.clock.sleep, rig.clock.advance_to
    stop_after(rig, 0.4)
    with pytest.raises(MotionStopped):
        rig.robot.move_joints(start + 60 * DEG)
    rig.clock.sleep, rig.clock.advance_to = sleep, advance_to  # type: ignore[method-assign]
    assert rig.robot.is_at_rest()
    assert 1 * DEG < np.max(rig.truth_rad() - start) < 59 * DEG
    with pytest.raises(MotionStopped):
        rig.robot.move_joints(start)
    rig.robot.release()
    rig.robot.move_joints(start)
    assert rig.truth_rad() == pytest.approx(start, abs=0.01 * DEG)


def test_a_target_beyond_the_limits_is_refused_before_anything_is_sent(rig: RobotRig) -> None:
    frames = rig.robot.health().frames
    with pytest.raises(DeviceError, match=r"joint 2 is 150.000 deg, limits -145.000 to 145.000"):
        rig.robot.move_joints(np.array([0, 150, 0, 0, 0, 0]) * DEG)
    assert rig.robot.health().frames == frames


def test_an_emergency_stop_during_a_move_is_named(rig: RobotRig) -> None:
    probe = TimedProbe(rig, np.inf)
    poll = probe.touched_at_s

    def poll_and_press() -> float | None:
        if rig.clock.now_s() > 3.0:
            rig.arm.permit(False, rig.clock.now_s())
        return poll()

    probe.touched_at_s = poll_and_press  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="emergency stop"):
        rig.robot.move_until_contact(rig.truth_rad() + 20 * DEG, 1 * DEG, probe)


def test_a_late_answer_is_not_taken_for_the_next_one(rig: RobotRig) -> None:
    """The first answer comes after its timeout; every later one must be of its own question."""
    now = rig.clock.now_s()
    late_s = 0.3 if rig.table.driver == "igus-irc" else 0.7
    rig.link().faults.add("late", from_s=now, until_s=now + 0.2, value=late_s)
    first = rig.robot.read_joints(1)
    assert first.time_s[0] > now + 0.2
    rig.robot.move_joints(rig.truth_rad() + 5 * DEG)
    assert rig.robot.read_joints(1).joints_rad[0] == pytest.approx(rig.truth_rad(), abs=0.012 * DEG)
    assert rig.robot.health().timeouts >= 1


def test_silence_is_a_timeout_within_its_bound(rig: RobotRig) -> None:
    now = rig.clock.now_s()
    rig.link().faults.add("drop", from_s=now)
    with pytest.raises(DeviceTimeout, match=r"answer"):
        rig.robot.read_joints(1)
    assert rig.clock.now_s() - now < 3.0
