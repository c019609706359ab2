"""MELFA R-protocol lines: the manual's examples both ways, and what must be refused."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.robots import melfa_codec as codec
from estimation.errors import DeviceError, FrameError

PPOSF = "X;290.62;Y;-0.09;Z;11.26;A;-179.94;B;-0.26;C;179.93;L1;0.00;;6,0;100;0.00;00000000"
JPOSF = "J1;0.00;J2;-12.34;J3;90.00;J4;0.01;J5;-0.01;J6;179.99;;****,****;100;0.00;00000000"
STATE = "2.MB5;100;100;5;A1124220;1;1;;;;;;;;;REP;START;1;0"


def test_a_command_is_robot_slot_and_text() -> None:
    assert codec.encode("STATE") == bytes.fromhex("313B313B53544154450D")
    assert codec.encode("STOP", robot=2, slot=9, terminator=b"\r\n") == b"2;9;STOP\r\n"


def test_a_command_of_more_than_255_bytes_is_refused_before_it_is_sent() -> None:
    assert len(codec.encode("X" * 250)) == 255
    with pytest.raises(DeviceError, match="256 bytes, limit 255"):
        codec.encode("X" * 251)


@pytest.mark.parametrize(
    ("line", "text", "in_error"),
    [
        (b"QoK\r", "", False),
        (b"QoK50\r", "50", False),
        (b"Qok4140;2\r", "4140;2", True),
        (b"Qok" + STATE.encode() + b"\r\n", STATE, True),
    ],
)
def test_the_case_of_the_third_letter_is_the_state_of_the_controller(
    line: bytes, text: str, in_error: bool
) -> None:
    assert codec.parse_answer(line, "?") == codec.Answer(text, in_error)


def test_a_refusal_names_its_error() -> None:
    with pytest.raises(codec.MelfaRefusal, match=r"EXECMOV J1: error 5640 \(already running\)") as refused:
        codec.parse_answer(b"QeR5640\r", "EXECMOV J1")
    assert refused.value.number == 5640
    with pytest.raises(
        codec.MelfaRefusal, match="4140"
    ):  # details may follow, and the controller be in error
        codec.parse_answer(b"Qer4140;1;2\r", "PRGLOAD=X")


@pytest.mark.parametrize("line", [b"", b"oK", b"QxK1", b"QeR12", b"QOK", b"\xff\xfe"])
def test_what_is_no_answer_is_refused(line: bytes) -> None:
    with pytest.raises(FrameError):
        codec.parse_answer(line, "STATE")


def test_state_glues_three_numbers_together() -> None:
    """The manual's example: servo on, right held, not running; stopped; error 4220."""
    state = codec.parse_state(STATE)
    assert (state.run, state.stop, state.error) == (0xA1, 0x12, 4220)
    assert state.run & codec.SERVO_ON and state.run & codec.OPERATION_RIGHT and not state.is_running
    assert state.stop & codec.STOPPED and not state.stop & codec.EMERGENCY_STOP


def test_dstate() -> None:
    assert codec.parse_dstate("09060;17;1") == codec.RunState(0x09, 0x06, 0)
    assert codec.parse_dstate("E1104220;17;1") == codec.RunState(0xE1, 0x10, 4220)
    for text in ("", "0906", "09060", "9060;1", "GG060;1;1"):
        with pytest.raises(FrameError):
            codec.parse_dstate(text)


def test_positions_are_millimetres_and_degrees() -> None:
    position_m, angles_rad = codec.parse_pose(PPOSF)
    assert position_m == pytest.approx([0.29062, -0.00009, 0.01126], abs=1e-12)
    assert np.degrees(angles_rad) == pytest.approx([-179.94, -0.26, 179.93])
    assert np.degrees(codec.parse_joints(JPOSF)) == pytest.approx([0.0, -12.34, 90.0, 0.01, -0.01, 179.99])


@pytest.mark.parametrize(
    "text",
    [
        PPOSF,
        "",
        "J1;0.00",
        JPOSF.replace("J2", "J7"),
        JPOSF.replace("90.00", "nan"),
        JPOSF.replace(";;", ";"),
    ],
)
def test_other_answers_are_not_taken_for_joints(text: str) -> None:
    with pytest.raises(FrameError):
        codec.parse_joints(text)


def test_targets_are_written_with_four_decimals() -> None:
    joints = np.radians([10.0, -20.5, 0.00004, 90.0, -90.0, 179.9])
    assert codec.joint_target("J9", joints) == "J9=(10.0000,-20.5000,0.0000,90.0000,-90.0000,179.9000)"
    pose = codec.pose_target("PCOSIROP", np.array([0.3, 0.0, 0.4]), np.radians([180.0, 0.0, 180.0]))
    assert pose == "PCOSIROP=(300.000,0.000,400.000,180.0000,0.0000,180.0000)"


def test_who_answers() -> None:
    text = "FF;FF;7,0;3,5,A,1E,32,46,64;MB5;PRM;RV-13FLM-D;CRnX-7xx;MELFA;17-10-06;Ver.S7e;ENG;"
    info = codec.parse_info(text + "COPYRIGHT(C)2008-2017;1;3;8;")
    assert info == codec.ControllerInfo("RV-13FLM-D", "CRnX-7xx", "Ver.S7e", "")
    assert codec.parse_info(text + "AC0512034;COPYRIGHT;1;3;8;").serial_number == "AC0512034"
    with pytest.raises(FrameError):
        codec.parse_info("FF;FF")


@given(
    st.lists(st.text(st.characters(codec="ascii", exclude_characters="\r\n"), max_size=20), max_size=5),
    st.integers(1, 9),
    st.sampled_from([b"\r", b"\r\n"]),
)
def test_answers_do_not_depend_on_how_bytes_are_split(texts: list[str], size: int, end: bytes) -> None:
    wire = b"".join(b"QoK" + text.encode() + end for text in texts)
    lines, found = codec.AnswerLines(b"\r"), list[bytes]()
    for start in range(0, len(wire), size):
        lines.feed(wire[start : start + size])
        while (line := lines.next_line()) is not None:
            found.append(line)
    assert found == [b"QoK" + text.encode() for text in texts]


def test_noise_between_answers_is_dropped_and_counted() -> None:
    lines = codec.AnswerLines(b"\r")
    lines.feed(b"\n\xf0\x00\r\nQoK1\r\n")
    assert lines.next_line() == b"QoK1"
    assert lines.bad_frames == 1


@given(st.binary(max_size=120))
def test_no_bytes_raise_anything_but_frame_errors(data: bytes) -> None:
    for parse in (
        codec.parse_joints,
        codec.parse_pose,
        codec.parse_state,
        codec.parse_dstate,
        codec.parse_info,
    ):
        with contextlib.suppress(FrameError):
            parse(codec.parse_answer(b"QoK" + data, "?").text)
