"""RTDE frames, programs and dashboard answers of the UR driver, by their bytes."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.robots import ur_codec as codec
from estimation.errors import FrameError


def test_the_worked_frames_of_a_session() -> None:
    """Version 2, start, and what the controller says to them."""
    assert codec.encode(codec.VERSION, codec.PROTOCOL) == bytes.fromhex("0005 56 0002")
    assert codec.encode(codec.START) == bytes.fromhex("0003 53")
    reader = codec.FrameReader()
    reader.feed(bytes.fromhex("0004 56 01  0004 53 01"))
    assert reader.next_frame() == (codec.VERSION, b"\x01")
    assert reader.next_frame() == (codec.START, b"\x01")
    assert reader.next_frame() is None


def test_the_set_up_of_outputs_is_the_worked_one_with_our_fields() -> None:
    """125 Hz as a double, then names with commas between them."""
    frame = codec.encode(codec.OUTPUTS, codec.Recipe(24).request(125.0))
    assert frame[2:11] == bytes.fromhex("4F 405F400000000000")
    assert frame[11:].startswith(b"timestamp,actual_q,actual_TCP_pose,")
    assert int.from_bytes(frame[:2], "big") == len(frame)
    worked = codec.encode(codec.OUTPUTS, struct.pack(">d", 125.0) + b"timestamp,actual_TCP_pose")
    assert worked[:11] == bytes.fromhex("0024 4F 405F400000000000")


@given(st.lists(st.binary(max_size=40), max_size=6), st.integers(1, 7))
def test_frames_do_not_depend_on_how_bytes_are_split(payloads: list[bytes], size: int) -> None:
    wire = b"".join(codec.encode(codec.DATA, payload) for payload in payloads)
    reader, found = codec.FrameReader(), list[bytes]()
    for start in range(0, len(wire), size):
        reader.feed(wire[start : start + size])
        while (frame := reader.next_frame()) is not None:
            found.append(frame[1])
    assert found == payloads


@given(st.binary(max_size=200))
def test_any_bytes_are_frames_or_refused(data: bytes) -> None:
    reader = codec.FrameReader()
    reader.feed(data)
    try:
        while reader.next_frame() is not None:
            pass
    except FrameError:
        pass


TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,INT32,UINT32,UINT32,INT32,INT32"


def package(q1: float = 0.5, timestamp: float = 12.5) -> bytes:
    joints, pose = (q1, -0.5, 0.25, 0.0, 1.0, -2.0), (0.1, 0.2, 0.3, 0.0, 3.0, 0.0)
    return b"\x01" + struct.pack(">d6d6diIIii", timestamp, *joints, *pose, 7, 1, 3, 17, 16)


def test_a_package_by_its_bytes() -> None:
    recipe = codec.Recipe(24)
    recipe.accept(b"\x01" + TYPES)
    found = recipe.parse(package())
    assert (found.timestamp_s, found.begun, found.ended, found.mode) == (12.5, 17, 16, 7)
    assert found.joints_rad.tolist() == [0.5, -0.5, 0.25, 0.0, 1.0, -2.0]
    assert found.base_T_tcp.tolist() == [0.1, 0.2, 0.3, 0.0, 3.0, 0.0]
    assert found.program_runs and found.obstacle == ""


@pytest.mark.parametrize(
    "payload",
    [package()[:-1], package() + b"\0", b"\x02" + package()[1:], package(np.nan), package(50.0), b""],
    ids=["short", "long", "another recipe", "no number", "no angle", "empty"],
)
def test_what_is_no_package_is_refused(payload: bytes) -> None:
    recipe = codec.Recipe(24)
    recipe.accept(b"\x01" + TYPES)
    with pytest.raises(FrameError):
        recipe.parse(payload)


def test_a_field_that_the_controller_does_not_have_is_named() -> None:
    with pytest.raises(FrameError, match="output_int_register_25 is NOT_FOUND, expected INT32"):
        codec.Recipe(24).accept(b"\x00" + TYPES[:-5] + b"NOT_FOUND")


@pytest.mark.parametrize(
    ("safety", "mode", "words"),
    [
        (1 << 6 | 1 << 7 | 1 << 10, 7, "emergency stop at the robot"),
        (1 << 2 | 1 << 10, 7, "protective stop"),
        (1, 5, "robot mode IDLE"),
        (1, 99, "robot mode 99"),
        (1, 7, ""),
    ],
)
def test_what_keeps_the_robot_from_moving_is_named(safety: int, mode: int, words: str) -> None:
    nothing = np.zeros(6)
    assert codec.Package(0.0, nothing, nothing, mode, safety, 1, 0, 0).obstacle == words


def test_a_program_as_it_is_sent() -> None:
    move = codec.move_joints(np.array([0.1, 0, 0, 0, 0, -1.5]), 0.5, 3.0)
    assert codec.program("truecell", [codec.set_register(24, 7), move, codec.set_register(25, 7)]) == (
        b"def truecell():\n"
        b"  write_output_integer_register(24, 7)\n"
        b"  movej([0.100000000, 0.000000000, 0.000000000, 0.000000000, 0.000000000, -1.500000000], "
        b"a=3.000000, v=0.500000)\n"
        b"  write_output_integer_register(25, 7)\n"
        b"end\n"
    )


def test_an_answer_of_the_dashboard_belongs_to_its_command() -> None:
    assert codec.value_of("Robotmode: RUNNING", "Robotmode") == "RUNNING"
    with pytest.raises(FrameError, match="'Powering on', not Robotmode"):
        codec.value_of("Powering on", "Robotmode")
