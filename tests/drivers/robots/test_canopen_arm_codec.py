"""Worked frames of the arm, both directions, and the tables of CiA 402."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.robots import canopen_arm_codec as codec
from drivers.robots.canopen_arm_codec import DriveState


def test_worked_rpdo1_of_the_device_file_carries_the_unused_velocity() -> None:
    sent = bytes.fromhex("1F 00 00 00 6E B2 00 00")
    assert codec.FILE_RPDO1.pack(0x1F, 0, 45_678) == sent
    assert codec.FILE_RPDO1.unpack(sent) == (0x1F, 0, 45_678)
    skipped = struct.unpack_from("<Hi", sent)  # the trap: without 6042h the set-point is two bytes off
    assert skipped[1] != 45_678


@pytest.mark.parametrize(
    ("layout", "values", "sent"),
    [
        (codec.FILE_TPDO1, (0x1237, 7), "37 12 07"),
        (codec.FILE_TPDO3, (45_678, 0), "6E B2 00 00 00 00 00 00"),
        (codec.TPDO1, (0x1237, -1), "37 12 FF FF FF FF"),
        (codec.RPDO1, (0x3F, 200_000), "3F 00 40 0D 03 00"),
        (codec.RPDO2, (45_678, 10_000), "6E B2 00 00 10 27 00 00"),
    ],
)
def test_worked_process_data(layout: codec.PdoLayout, values: tuple[int, ...], sent: str) -> None:
    assert layout.pack(*values) == bytes.fromhex(sent)
    assert layout.unpack(bytes.fromhex(sent)) == values
    assert layout.size == len(bytes.fromhex(sent))


def test_mapping_words_are_index_subindex_and_bits() -> None:
    assert codec.TPDO1.mapping == (0x60410010, 0x60640020)
    assert codec.FILE_RPDO1.mapping == (0x60400010, 0x60420010, 0x60C10120)
    assert codec.RPDO2.mapping == (0x607A0020, 0x60810020)


def test_worked_emergency() -> None:
    emergency = codec.parse_emergency(bytes.fromhex("11 86 21 00 00 00 00 00"))
    assert emergency == codec.Emergency(0x8611, 0x21, bytes(5))
    assert emergency.words == "following error"
    assert not emergency.is_reset
    assert codec.parse_emergency(b"\x11\x86") is None


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0, "error gone"),
        (0x8130, "heartbeat of the controller missing"),
        (0x7305, "position sensor"),
        (0x2399, "current"),
        (0xFF01, "device specific"),
        (0xA123, "unknown error"),
    ],
)
def test_error_codes_in_words(code: int, words: str) -> None:
    assert codec.emergency_words(code) == words


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0200, DriveState.NOT_READY),
        (0x0250, DriveState.SWITCH_ON_DISABLED),
        (0x0231, DriveState.READY),
        (0x0233, DriveState.SWITCHED_ON),
        (0x1237, DriveState.OPERATION_ENABLED),
        (0x0217, DriveState.QUICK_STOP_ACTIVE),
        (0x021F, DriveState.FAULT_REACTION),
        (0x0218, DriveState.FAULT),
    ],
)
def test_states_by_statusword(statusword: int, state: DriveState) -> None:
    assert codec.drive_state(statusword) is state


@given(st.integers(0, 0xFFFF))
def test_no_statusword_is_ambiguous(statusword: int) -> None:
    matching = [s for mask, value, s in codec._STATE_TESTS if statusword & mask == value]
    assert len(matching) <= 1


@given(st.integers(0, 0xFFFF), st.integers(-(2**31), 2**31 - 1))
def test_process_data_survive_the_wire(statusword: int, counts: int) -> None:
    assert codec.TPDO1.unpack(codec.TPDO1.pack(statusword, counts)) == (statusword, counts)
