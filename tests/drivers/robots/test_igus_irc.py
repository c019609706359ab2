"""The igus iRC driver: the map's worked bytes, its traps, and what only this robot does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.robots import igus_irc_codec as codec
from estimation.errors import DeviceError, FrameError, IdentityMismatch
from simulators.robots.igus_irc import IgusRobot
from tests.drivers.robots.rig import IGUS, RobotRig

DEG = np.pi / 180


@pytest.fixture
def rig(cache: Path) -> RobotRig:
    rig = RobotRig(cache, IGUS)
    rig.robot.connect()
    return rig


def test_the_worked_example_of_a_cartesian_target() -> None:
    """X 100, Y 200, Z -40 mm, C 180 deg; low word first."""
    words = codec.length_words(np.array([0.1, 0.2, -0.04])) + codec.angle_words(np.radians([0, 0, 180]))
    assert b"".join(word.to_bytes(2, "big") for word in words) == bytes.fromhex(
        "27100000 4E200000 F060FFFF 00000000 00000000 46500000"
    )


def test_minus_forty_millimetres_is_twos_complement() -> None:
    """A public wiki has low word 61535, ones' complement, which is -40.01 mm."""
    assert codec.pack([-4000]) == [61536, 0xFFFF]
    assert codec.unpack([61535, 0xFFFF]) == [-4001]


@given(st.lists(st.integers(-(2**31), 2**31 - 1), max_size=12))
def test_values_survive_their_registers(values: list[int]) -> None:
    assert codec.unpack(codec.pack(values)) == values


def test_half_a_value_is_refused() -> None:
    with pytest.raises(FrameError):
        codec.unpack([1, 2, 3])


def test_target_speed_and_edge_by_their_bytes(rig: RobotRig) -> None:
    sent = list[bytes]()
    write = rig.link().write
    rig.link().write = lambda data: (sent.append(data), write(data))[1]  # type: ignore[method-assign]
    rig.robot.move_joints(np.array([1, 0, -90, 0, -90, 0]) * DEG)
    writes = [data[7:] for data in sent if data[7] in (5, 6, 16)]
    assert writes == [
        bytes.fromhex("10008E000C18 00640000 00000000 DCD8FFFF 00000000 DCD8FFFF 00000000"),
        bytes.fromhex("0600B4029A"),  # 60 of 90 deg/s are 66.6 %
        bytes.fromhex("050067 0000"),
        bytes.fromhex("050067 FF00"),
    ]


def test_joints_are_read_in_one_request(rig: RobotRig) -> None:
    """Two requests could tear a value between its words."""
    frames = rig.robot.health().frames
    rig.robot.read_joints(3)
    assert rig.robot.health().frames == frames + 3


def test_not_moving_right_after_the_edge_is_not_arrived(rig: RobotRig) -> None:
    arm = rig.arm
    assert isinstance(arm, IgusRobot)
    arm.settings = replace(arm.settings, start_s=0.25)
    target = rig.truth_rad() + 10 * DEG
    rig.robot.move_joints(target)
    assert rig.truth_rad() == pytest.approx(target, abs=0.006 * DEG)


def test_a_move_that_never_begins_is_named(rig: RobotRig) -> None:
    rig.arm.move = lambda *_: None  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"Joint \d is at .* deg instead of"):
        rig.robot.move_joints(rig.truth_rad() + 10 * DEG)


def test_a_speed_below_a_tenth_of_a_percent_is_refused(rig: RobotRig) -> None:
    with pytest.raises(DeviceError, match=r"0.0500 deg/s, the slowest of this robot is 0.0900"):
        rig.robot.move_joints(rig.truth_rad() + 1 * DEG, speed_fraction=0.05 / 60)


@pytest.mark.parametrize(
    ("coil", "words"), [(22, "emergency stop or undervoltage"), (26, "encoder"), (30, "module dead")]
)
def test_errors_of_a_module_are_named(rig: RobotRig, coil: int, words: str) -> None:
    rig.arm.fault(0, coil, rig.clock.now_s())
    with pytest.raises(DeviceError, match=words):
        rig.robot.move_joints(rig.truth_rad() + 1 * DEG)
    rig.robot.connect()  # reset and enable
    rig.robot.move_joints(rig.truth_rad() + 1 * DEG)


def test_an_error_of_the_kinematics_is_named(rig: RobotRig) -> None:
    rig.arm._kinematic_error = 23  # type: ignore[attr-defined]
    with pytest.raises(DeviceError, match=r"kinematic error 23 \(singularity of the wrist\)"):
        rig.robot.is_at_rest()
    rig.robot.connect()
    assert rig.robot.is_at_rest()


def test_who_answers_is_compared(cache: Path) -> None:
    for changed, words in (
        ({"software": 980}, "TinyCtrl, the cell file iRC"),
        ({"software": 7}, "software 7, the cell file iRC"),
        ({"mapping": 2}, "mapping version 2, this driver knows 1"),
    ):
        rig = RobotRig(cache, IGUS)
        rig.arm.settings = replace(rig.arm.settings, **changed)  # type: ignore[attr-defined]
        with pytest.raises(IdentityMismatch, match=words):
            rig.robot.connect()


def test_a_robot_without_reference_is_refused(cache: Path) -> None:
    rig = RobotRig(cache, IGUS)
    rig.arm.referenced = False  # type: ignore[attr-defined]
    with pytest.raises(DeviceError, match="not referenced"):
        rig.robot.connect()


def test_the_worked_frames_on_the_wire(rig: RobotRig) -> None:
    """The manual's example, byte for byte, starts a linear move of the simulated controller."""
    session = rig.arm.connections()[""]()
    pose = rig.arm.pose_of(rig.truth_rad())
    x = round(pose[0, 3] * 1e5) - 1000
    rest = b"".join(
        word.to_bytes(2, "big")
        for word in codec.length_words(pose[1:3, 3]) + codec.angle_words(_angles(pose))
    )
    target = x.to_bytes(4, "big")[2:] + x.to_bytes(4, "big")[:2] + rest
    now = rig.clock.now_s()
    for frame, answer in (
        (bytes.fromhex("00030000001F0110 0082 000C 18") + target, "000300000006 0110 0082 000C"),
        (bytes.fromhex("000400000006 0105 0064 0000"), "000400000006 0105 0064 0000"),
        (bytes.fromhex("000500000006 0105 0064 FF00"), "000500000006 0105 0064 FF00"),
    ):
        session.receive(frame, now)
        assert session.take(now + 1.0) == bytes.fromhex(answer)
    assert rig.arm.moving(now + 0.1)
    moved = rig.arm.pose_of(rig.arm.joints_at(rig.arm.end_s()))
    assert moved[:3, 3] - pose[:3, 3] == pytest.approx([-0.01, 0, 0], abs=2e-5)


def _angles(pose: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(pose[:3, :3]).as_euler("xyz"))
