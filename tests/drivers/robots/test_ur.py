"""The UR driver: what only this robot does, and an independent RTDE client on the simulator's port."""

import json
import struct
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from simulators.outlets import Loop, TcpOutlet
from simulators.robots.ur import UrRobot
from tests.drivers.robots.rig import UR, RobotRig, TimedProbe

DEG = np.pi / 180


@pytest.fixture
def rig(cache: Path) -> RobotRig:
    rig = RobotRig(cache, UR)
    identity = rig.robot.connect()
    assert (identity.model, identity.serial_number) == ("UR5", "20235500123")
    return rig


def test_a_contact_is_interpolated_not_read_after_the_stop(rig: RobotRig) -> None:
    """At 20 deg/s the arm runs on for half a degree; the joints at the contact are known to 0.3."""
    speed = 20 * DEG
    probe = TimedProbe(rig, rig.clock.now_s() + 1.0)
    start = rig.truth_rad()
    contact = rig.robot.move_until_contact(start + 60 * DEG, speed, probe)
    assert contact is not None and contact.late_s == pytest.approx(0.006 + 0.008)
    late_s = (contact.joints_rad - rig.arm.joints_at(probe.contact_s)) / speed
    noise_s = 6 * rig.table.joint_noise_rad / speed
    assert (late_s > -noise_s).all() and (late_s < contact.late_s + noise_s).all()
    assert 1.0 <= contact.readings <= 2.0
    assert np.max(rig.truth_rad() - rig.arm.joints_at(probe.contact_s)) > 0.5 * DEG


def test_the_stream_is_paused_while_nobody_asks(rig: RobotRig) -> None:
    """Hours between two questions leave nothing behind that could be taken for new."""
    rig.robot.read_joints(1)
    asked_s = rig.clock.now_s() + 3600.0
    rig.clock.sleep(3600.0)
    reading = rig.robot.read_joints(1)
    assert asked_s <= reading.time_s[0] <= rig.clock.now_s()
    assert rig.clock.now_s() - asked_s < 0.02


def test_readings_are_sampled_after_the_question(rig: RobotRig) -> None:
    """Also while a move streams packages: the joints are those of the time that stands on them."""
    rig.robot._controller.start_move(rig.truth_rad() + 40 * DEG, 20 * DEG)  # type: ignore[attr-defined]
    for _ in range(5):
        rig.clock.sleep(0.3)
        asked_s = rig.clock.now_s()
        reading = rig.robot.read_joints(1)
        ahead_s = (reading.joints_rad[0, 0] - rig.arm.joints_at(reading.time_s[0])[0]) / (20 * DEG)
        assert reading.time_s[0] >= asked_s
        assert abs(ahead_s) < 0.001 + 6 * rig.table.joint_noise_rad / (20 * DEG)


def test_a_controller_in_local_mode_is_named(cache: Path) -> None:
    rig = RobotRig(cache, UR)
    rig.change(remote=False)
    with pytest.raises(DeviceTimeout, match=r"did not begin a program within 1 s.*remote control"):
        rig.robot.connect()


def test_a_program_from_elsewhere_is_not_ours(rig: RobotRig) -> None:
    """Somebody starts a program during our move: ours has not ended at its target."""
    probe = TimedProbe(rig, np.inf)
    poll = probe.touched_at_s

    def poll_and_intrude() -> float | None:
        if 3.0 < rig.clock.now_s() < 3.1:
            rig.arm.run(["set_tcp(p[0, 0, 0, 0, 0, 0])"], rig.clock.now_s())  # type: ignore[attr-defined]
        return poll()

    probe.touched_at_s = poll_and_intrude  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"Joint \d is at .* instead of"):
        rig.robot.move_until_contact(rig.truth_rad() + 20 * DEG, 2 * DEG, probe)


def test_a_protective_stop_is_named_and_unlocked_by_a_reset(rig: RobotRig) -> None:
    rig.arm.fault(0, 0, rig.clock.now_s())
    with pytest.raises(DeviceError, match="protective stop"):
        rig.robot.move_joints(rig.truth_rad() + 1 * DEG)
    with pytest.raises(DeviceError, match="stays: Cannot unlock protective stop until 5s"):
        rig.robot.connect()
    rig.clock.sleep(5.0)
    rig.robot.connect()
    rig.robot.move_joints(rig.truth_rad() + 1 * DEG)


def test_an_emergency_stop_at_connection_is_named(cache: Path) -> None:
    rig = RobotRig(cache, UR)
    rig.arm.permit(False, 0.0)
    with pytest.raises(DeviceError, match="robot emergency stop"):
        rig.robot.connect()


@pytest.mark.parametrize(
    ("changed", "words"),
    [({"model": "UR10"}, "model 'UR10'"), ({"serial_number": "20230000001"}, "serial number '20230000001'")],
)
def test_another_robot_is_refused(cache: Path, changed: dict[str, str], words: str) -> None:
    rig = RobotRig(cache, UR)
    rig.change(**changed)
    with pytest.raises(IdentityMismatch, match=words):
        rig.robot.connect()


def test_a_register_that_somebody_else_writes_is_found(rig: RobotRig) -> None:
    arm = rig.arm
    assert isinstance(arm, UrRobot)
    begun = arm.state_at(rig.clock.now_s()).registers[24]
    execute = arm._execute
    arm._execute = lambda call, time_s: (  # type: ignore[method-assign]
        time_s if call.name.startswith("write") else execute(call, time_s)
    )
    with pytest.raises(DeviceTimeout, match="register for truecell"):
        rig.robot.move_joints(rig.truth_rad() + 1 * DEG)
    assert arm.state_at(rig.clock.now_s()).registers[24] == begun


def test_a_bad_frame_costs_a_new_connection_and_no_value(rig: RobotRig) -> None:
    """A stream that lost a byte cannot be told apart again: the answer is read on another one."""
    frames = rig.robot.health()
    rig.link().faults.add("lose-byte", from_s=rig.clock.now_s(), once=True)
    reading = rig.robot.read_joints(3)
    assert reading.joints_rad == pytest.approx(np.tile(rig.truth_rad(), (3, 1)), abs=0.01 * DEG)
    now = rig.robot.health()
    assert now.reconnects == frames.reconnects + 1
    assert now.bad_frames + now.timeouts == frames.bad_frames + frames.timeouts + 1


def test_a_port_that_is_not_rtde_is_named(cache: Path) -> None:
    rig = RobotRig(cache, UR)
    link = rig.link()
    link.read = lambda timeout_s: b"Connected: Universal Robots Dashboard Server\n"  # type: ignore[method-assign]
    with pytest.raises(FrameError, match="port is RTDE's, 30004"):
        rig.robot.connect()


def test_a_package_may_come_between_a_question_and_its_answer(rig: RobotRig) -> None:
    rig.robot._controller._rtde.stream()  # type: ignore[attr-defined]
    rig.clock.sleep(0.1)
    link = rig.link()
    link.write(bytes.fromhex("000353"))
    assert link.read(1.0)[2:3] == b"U"
    link.write(bytes.fromhex("000350"))
    rig.robot._controller._rtde._lost = True  # type: ignore[attr-defined]
    assert rig.robot.read_joints(1).joints_rad[0] == pytest.approx(rig.truth_rad(), abs=0.01 * DEG)


def test_the_worked_session_by_its_bytes(rig: RobotRig) -> None:
    """Set-up, start and one package of time and pose, as the maker's client sees them."""
    session = rig.arm.connections()[""]()
    at = rig.clock.now_s()

    def ask(wire: bytes) -> bytes:
        session.receive(wire, at)
        return session.take(at + 0.0015)

    assert ask(bytes.fromhex("0005560002")) == bytes.fromhex("00045601")
    set_up = bytes.fromhex("0024 4F 405F400000000000") + b"timestamp,actual_TCP_pose"
    assert ask(set_up) == bytes.fromhex("0013 4F 01") + b"DOUBLE,VECTOR6D"
    assert ask(bytes.fromhex("000353")) == bytes.fromhex("00045301")
    data = session.take(at + 0.0045)
    assert data[:4] == bytes.fromhex("003C5501") and len(data) == 60
    timestamp, *pose = struct.unpack(">7d", data[4:])
    assert timestamp == pytest.approx(4711.0 + at, abs=0.01)
    assert pose[:3] == pytest.approx(rig.arm.pose_of(rig.truth_rad())[:3, 3], abs=1e-4)


CLIENT = """
import json, sys, rtde_receive
client = rtde_receive.RTDEReceiveInterface(sys.argv[1], 125.0)
print(json.dumps({
    "q": client.getActualQ(), "pose": client.getActualTCPPose(), "mode": client.getRobotMode(),
    "safety": client.getSafetyMode(), "timestamp": client.getTimestamp(),
    "register": client.getOutputIntRegister(12), "status": client.getRobotStatus(),
    "protective": client.isProtectiveStopped(), "emergency": client.isEmergencyStopped(),
}))
client.disconnect()
"""


@pytest.mark.wire
def test_ur_rtde_reads_right_values_over_a_real_port(rig: RobotRig) -> None:
    """An independent client, ur_rtde; its port is fixed, so the address is one of our own."""
    arm = rig.arm
    assert isinstance(arm, UrRobot)
    arm.run(["write_output_integer_register(12, -4242)"], rig.clock.now_s())
    loop = Loop()
    loop.now_s = rig.clock.now_s() + 1.0
    start_s = loop.now_s
    tick = loop._clock.tick
    loop._clock.tick = lambda at_most_s: start_s + tick(at_most_s)  # type: ignore[method-assign]
    TcpOutlet(loop, "127.83.17.4", 30004, arm.connections()[""])
    server = threading.Thread(target=loop.run)
    server.start()
    try:
        done = subprocess.run(
            [sys.executable, "-c", CLIENT, "127.83.17.4"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
    finally:
        loop.quit()
        server.join()
    found = json.loads(done.stdout.splitlines()[-1])
    joints = rig.truth_rad()
    assert found["q"] == pytest.approx(joints.tolist(), abs=6 * rig.table.joint_noise_rad)
    assert found["pose"][:3] == pytest.approx(arm.pose_of(joints)[:3, 3].tolist(), abs=2e-4)
    assert (found["mode"], found["safety"], found["status"] & 1) == (7, 1, 1)
    assert found["register"] == -4242
    assert not found["protective"] and not found["emergency"]
    assert found["timestamp"] == pytest.approx(4711.0 + start_s, abs=60.0)
