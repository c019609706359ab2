"""The ABB driver against the simulated open_abb server: what only this robot does, and its traps."""

from pathlib import Path

import numpy as np
import pytest

from drivers.capabilities import StopWay
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from tests.drivers.robots.rig import ABB, RobotRig, TimedProbe

DEG = np.pi / 180


@pytest.fixture
def rig(cache: Path) -> RobotRig:
    rig = RobotRig(cache, ABB)
    identity = rig.robot.connect()
    assert (identity.model, identity.serial_number) == ("IRB 1400", "14-21858")
    return rig


def test_what_it_can_do_is_declared(rig: RobotRig) -> None:
    abilities = rig.robot.abilities
    assert abilities.stop is StopWay.BETWEEN_STEPS
    assert abilities.stop_delay_s == pytest.approx(10 / 60 + 60 / 200)
    assert abilities.contact_delay_s == 0.05
    assert abilities.joint_resolution_rad == pytest.approx(0.01 * DEG)


def test_a_long_move_goes_in_steps_that_a_stop_can_end(rig: RobotRig) -> None:
    start, sent = rig.truth_rad(), rig.sent()
    rig.robot.move_joints(start + np.array([35, 0, 0, 0, 0, 0]) * DEG)
    first = [float(data.split()[1]) for data in sent if data.startswith(b"02")]
    begin = np.degrees(start[0])
    assert first == pytest.approx([begin + 8.75, begin + 17.5, begin + 26.25, begin + 35], abs=0.02)


def test_a_guarded_move_never_goes_farther_than_a_step_beyond_the_contact(rig: RobotRig) -> None:
    probe = TimedProbe(rig, rig.clock.now_s() + 1.5)
    start, speed = rig.truth_rad(), 1 * DEG
    contact = rig.robot.move_until_contact(start + 5 * DEG, speed, probe)
    assert contact is not None and contact.late_s == 0.05
    beyond = np.max(rig.truth_rad() - rig.arm.joints_at(probe.contact_s))
    assert 0.0 <= beyond <= speed * 0.05 + 1e-9


def test_the_speed_of_the_flange_is_told(rig: RobotRig) -> None:
    sent = rig.sent()
    rig.robot.move_joints(rig.truth_rad() + 1 * DEG, speed_fraction=0.5)
    (speed,) = [data for data in sent if data.startswith(b"08")]
    assert speed == b"08 471.2389 30.0000 #"  # 30 deg/s on 900 mm


def test_tool_and_work_object_of_another_program_do_not_matter(cache: Path) -> None:
    """Poses mean the flange in the base, whatever was set before."""
    rig = RobotRig(cache, ABB)
    stranger = rig.arm.connections()[""]()
    stranger.receive(b"06 0 0 150 0 1 0 0 #", 0.0)
    assert stranger.take(1.0) == b"6 1 "
    rig.robot.connect()
    pose = rig.robot._controller.read_pose()  # type: ignore[attr-defined]
    assert pose.origin_m == pytest.approx(rig.arm.pose_of(rig.truth_rad())[:3, 3], abs=2e-4)


def test_a_reply_in_pieces_is_waited_for(rig: RobotRig) -> None:
    rig.link().faults.add("split", from_s=rig.clock.now_s(), value=0.004)
    assert rig.robot.read_joints(2).joints_rad[1] == pytest.approx(rig.truth_rad(), abs=0.012 * DEG)


def test_a_reply_that_lost_its_end_is_not_a_value(rig: RobotRig) -> None:
    """5.1 of 5.12 looks like a number; the reply counts as missing, and is asked for again."""
    rig.link().faults.add("truncate", from_s=rig.clock.now_s(), once=True)
    reading = rig.robot.read_joints(1)
    assert reading.joints_rad[0] == pytest.approx(rig.truth_rad(), abs=0.012 * DEG)
    assert rig.robot.health().timeouts == 1


def test_another_number_of_decimals_is_named(cache: Path) -> None:
    rig = RobotRig(cache, ABB | {"decimals": 4, "encoder_step": "0.0001 deg"})
    rig.robot.connect()
    with pytest.raises(DeviceTimeout, match="request 04"):
        rig.robot.read_joints(1)
    rig.change(decimals=4)
    assert rig.robot.read_joints(1).joints_rad[0] == pytest.approx(rig.truth_rad(), abs=0.01 * DEG)


def test_a_move_goes_on_after_its_client_is_lost(rig: RobotRig) -> None:
    """The connection breaks during a move; the next one waits until the arm stands."""
    start = rig.truth_rad()
    rig.link().write(b"08 20 2 #")
    rig.link().read(1.0)
    rig.link().write(b"02 8 0 -90 0 -90 0 #")
    rig.clock.sleep(0.5)
    rig.robot.connect()
    assert not rig.robot.is_at_rest()
    with pytest.raises(DeviceError, match="moves although it was not told to"):
        rig.robot.move_joints(start)
    rig.clock.sleep(5.0)
    assert rig.robot.is_at_rest()
    rig.robot.move_joints(start)


@pytest.mark.parametrize(
    ("changed", "words"),
    [({"model": "IRB 140"}, "type 'IRB 140'"), ({"serial_number": "14-1"}, "serial number '14-1'")],
)
def test_another_robot_is_refused(cache: Path, changed: dict[str, str], words: str) -> None:
    rig = RobotRig(cache, ABB | {"serial_number": "14-21858"})
    rig.change(**changed)
    with pytest.raises(IdentityMismatch, match=words):
        rig.robot.connect()


def test_another_robot_after_a_timeout_is_refused(rig: RobotRig) -> None:
    rig.link().faults.add("drop", from_s=rig.clock.now_s(), once=True)
    rig.change(serial_number="14-99999")
    with pytest.raises(IdentityMismatch, match="14-99999"):
        rig.robot.read_joints(1)


def test_what_comes_unasked_is_found_before_the_next_question(rig: RobotRig) -> None:
    """A reply that lies there already must not answer the next question, however alike it looks."""
    rig.arm.move(rig.clock.now_s(), rig.truth_rad() + 3 * DEG, 1.0)
    rig.link().write(b"04 #")
    rig.clock.sleep(2.0)
    assert rig.robot.read_joints(1).joints_rad[0] == pytest.approx(rig.truth_rad(), abs=0.012 * DEG)
    assert rig.robot.health().bad_frames == 1


def test_a_reply_that_comes_twice_answers_once(rig: RobotRig) -> None:
    rig.link().faults.add("duplicate", from_s=rig.clock.now_s(), once=True)
    rig.robot.read_joints(1)
    target = rig.truth_rad() + 3 * DEG
    rig.robot.move_joints(target)
    assert rig.robot.read_joints(1).joints_rad[0] == pytest.approx(target, abs=0.012 * DEG)


def test_a_server_that_talks_something_else_is_named(cache: Path) -> None:
    rig = RobotRig(cache, ABB)
    rig.link().read = lambda timeout_s: b"QoK" if timeout_s > 0.1 else b""  # type: ignore[method-assign]
    with pytest.raises(FrameError, match="open_abb server"):
        rig.robot.connect()


class Client:
    """Sends strings and takes what comes."""

    def __init__(self, rig: RobotRig) -> None:
        self.session, self.time_s = rig.arm.connections()[""](), rig.clock.now_s()

    def say(self, data: bytes, within_s: float = 5.0) -> bytes:
        self.session.receive(data, self.time_s)
        answer = self.session.take(self.time_s + within_s)
        self.time_s += within_s
        return answer


def test_the_server_by_its_characters(rig: RobotRig) -> None:
    """Codes come back without their zero; what cannot be read answers with the number before."""
    rig.robot.move_joints(np.array([1, 2, -90, 0, -90, 3]) * DEG)
    client = Client(rig)
    joints = client.say(b"04 #")
    assert joints.startswith(b"4 1 ") and len(joints.split()) == 8
    assert [len(word.split(b".")[1]) for word in joints.split()[2:]] == [2] * 6
    assert [len(word.split(b".")[1]) for word in client.say(b"03 #").split()[2:]] == [2, 2, 2, 3, 3, 3, 3]
    assert client.say(b"02 1 2 3 #") == b"2 0 "
    assert client.say(b"04") == b"2 0 "
    assert client.say(b"77 #") == b"77 0 "
    assert client.say(b"09 1 0 0 0 #") == b"9 1 "
    assert client.say(b"32 #") == b"32 1 0.00"
    assert client.say(b"98 #") == b"98 1 14-21858*5.15.0122.01*IRB 1400"
    assert client.say(b"99 #") == b""
    assert client.say(b"04 #") == b""


def test_the_server_reads_one_string_when_a_move_has_ended(rig: RobotRig) -> None:
    """Two requests sent during a move lie there as one string, of which the first is read."""
    client = Client(rig)
    client.say(b"08 1000 50 #")
    assert client.say(b"02 10 0 -90 0 -90 0 #", 0.01) == b""
    client.say(b"04 #", 0.0)
    client.say(b"03 #", 0.0)
    answer = client.say(b"", 10.0)
    assert answer.startswith((b"2 1 4 1 10.0", b"2 1 4 1 9.99"))
    assert answer.count(b" 1 ") == 2


def test_an_unreachable_target_ends_the_program(rig: RobotRig) -> None:
    client = Client(rig)
    assert client.say(b"02 500 0 0 0 0 0 #") == b""
    assert client.say(b"04 #") == b""
