"""The arm on its bus: worked frames, state machine, process data."""

import struct

import pytest

from simulators.robots.canopen_arm import SimulatedArm
from simulators.robots.drive_states import TRANSITIONS, Command, DriveState, command_of
from simulators.world.world_file import WorldFile
from tests.simulators.can_master import Master

ABSENT = [0x603F, *range(0x605A, 0x605F), 0x6067, 0x6068, 0x6084, 0x6085, 0x6099, 0x6071, 0x60FF]


def test_worked_frames(master: Master) -> None:
    assert master.sdo(3, "2F 60 60 00 07 00 00 00") == "60 60 60 00 00 00 00 00"
    assert master.sdo(3, "40 99 60 00 00 00 00 00") == "80 99 60 00 00 00 02 06"
    assert master.sdo(3, "40 41 60 00 00 00 00 00") == "4B 41 60 00 50 02 00 00"
    master.write(3, 0x1017, 0, 100, 2)
    master.send(0x000, "01 03")
    beats = [frame for frame in master.wait(0.25) if frame.can_id == 0x703]
    assert [frame.data for frame in beats] == [b"\x05", b"\x05"]


def test_position_and_status_travel_as_in_the_manual(arm: SimulatedArm, master: Master) -> None:
    master.enable()
    master.move(45_678, 90_000)
    master.wait(2.0)
    master.send(0x000, "01 03")
    frames = {frame.can_id: frame.data.hex(" ").upper() for frame in master.sync()}
    assert frames[0x383] == "6E B2 00 00 00 00 00 00"
    assert frames[0x183] == "37 06 01"
    assert frames[0x283] == "00 00 00 00 00 00 00 00"


@pytest.mark.parametrize("index", ABSENT)
def test_what_the_device_file_does_not_have_is_aborted(master: Master, index: int) -> None:
    assert master.sdo(5, struct.pack("<BHB4x", 0x40, index, 0).hex()).endswith("00 00 02 06")


def test_refusals_name_their_reason(master: Master) -> None:
    assert master.write(3, 0x6041, 0, 1, 2).endswith("02 00 01 06")  # read only
    assert master.write(3, 0x6060, 0, 8, 1).endswith("30 00 09 06")  # 6502h = 43h: modes 1, 2, 7
    assert master.write(3, 0x6040, 0, 6, 4).endswith("10 00 07 06")  # length
    assert master.sdo(3, "40 18 10 09 00 00 00 00").endswith("11 00 09 06")  # subindex
    assert master.sdo(3, "60 00 00 00 00 00 00 00").startswith("80")  # segment of nothing
    assert master.read(3, 0x6502) == 0x43


def test_a_text_comes_in_segments(master: Master) -> None:
    assert master.sdo(4, "40 0A 10 00 00 00 00 00").startswith("41 0A 10 00")
    text = b""
    for toggle in (0, 1, 0, 1, 0):
        answer = bytes.fromhex(master.sdo(4, f"{0x60 | toggle << 4:02x}" + "00" * 7))
        assert answer[0] >> 4 & 1 == toggle
        text += answer[1 : 8 - (answer[0] >> 1 & 7)]
        if answer[0] & 1:
            break
    assert text.decode("ascii").endswith("simulated")


def test_who_restarts_forgets_and_does_not_hear_until_boot_up(master: Master, world_file: WorldFile) -> None:
    master.write(3, 0x6060, 0, 1, 1)
    master.write(3, 0x1017, 0, 100, 2)
    master.send(0x000, "81 03")
    master.send(0x000, "01 03")  # lost: the drive has not booted
    assert not master.wait(world_file.arm.boot_time_s - 0.01)
    (boot,) = master.wait(0.05)
    assert (boot.can_id, boot.data) == (0x703, b"\x00")
    assert not master.sync()  # not started, so no process data
    assert master.read(3, 0x6060) == 7 and master.read(3, 0x1017) == 0
    assert master.read(4, 0x6060) == 7


STATE_WORDS = {
    Command.DISABLE_VOLTAGE: 0x00,
    Command.QUICK_STOP: 0x02,
    Command.SHUTDOWN: 0x06,
    Command.SWITCH_ON: 0x07,
    Command.ENABLE: 0x0F,
}
WAY = {
    DriveState.SWITCH_ON_DISABLED: [],
    DriveState.READY_TO_SWITCH_ON: [0x06],
    DriveState.SWITCHED_ON: [0x06, 0x07],
    DriveState.OPERATION_ENABLED: [0x06, 0x07, 0x0F],
}


@pytest.mark.parametrize("state", WAY)
@pytest.mark.parametrize("command", Command)
def test_every_row_of_the_state_machine(master: Master, state: DriveState, command: Command) -> None:
    assert command_of(STATE_WORDS[command]) is command
    for word in WAY[state]:
        master.write(3, 0x6040, 0, word, 2)
        master.wait(0.1)
    assert master.status(3) & 0x6F == state | (0x40 if state.value == 0x40 else 0)
    master.write(3, 0x6040, 0, STATE_WORDS[command], 2)
    master.wait(0.1)
    expected = TRANSITIONS.get((state, command), state)
    if expected is DriveState.QUICK_STOP_ACTIVE:  # which ends by itself once at rest
        expected = DriveState.SWITCH_ON_DISABLED
    assert master.status(3) & 0x6F & (0x4F if expected.value == 0x40 else 0x6F) == expected


def test_a_fault_is_latched_and_stops_one_joint_alone(arm: SimulatedArm, master: Master) -> None:
    for node in (3, 4):
        master.enable(node)
        master.move(60_000, 20_000, node)
    arm.fault(0, 0x8611, master.time_s)
    emergency = next(frame for frame in master.wait(0.01) if frame.can_id == 0x083)
    assert emergency.data.hex(" ").upper() == "11 86 21 00 00 00 00 00"
    master.wait(0.5)
    rest = master.joint_counts(0)
    master.wait(0.5)
    assert master.joint_counts(0) == rest and master.status(3) & 0x4F == 0x08
    assert master.status(4) & 0x6F == 0x27 and arm.standstill(master.time_s) is None
    assert master.read(3, 0x1003, 1) == -0x10000 + 0x8611 + 0x10000
    master.write(3, 0x6040, 0, 0x0F, 2)
    assert master.status(3) & 0x4F == 0x08
    master.write(3, 0x6040, 0, 0x80, 2)
    assert master.status(3) & 0x4F == 0x40


# -- process data --------------------------------------------------------------------------------


def map_position_and_status(master: Master, node: int = 3) -> None:
    """TPDO1: statusword and position; the others off."""
    for pdo in range(4):
        cob = 0x180 + 0x100 * pdo + node
        master.write(node, 0x1800 + pdo, 1, cob | 1 << 31, 4)
    assert master.write(node, 0x1A00, 0, 0, 1).startswith("60")
    assert master.write(node, 0x1A00, 1, 0x60410010, 4).startswith("60")
    assert master.write(node, 0x1A00, 2, 0x60640020, 4).startswith("60")
    assert master.write(node, 0x1A00, 0, 2, 1).startswith("60")
    assert master.write(node, 0x1800, 1, 0x180 + node, 4).startswith("60")


def test_process_data_can_be_mapped_at_run_time(master: Master) -> None:
    map_position_and_status(master)
    master.send(0x000, "01 03")
    (frame,) = master.sync()
    assert frame.can_id == 0x183 and len(frame.data) == 6


def test_the_order_of_mapping_matters(master: Master) -> None:
    assert master.write(3, 0x1A00, 0, 0, 1).endswith("22 00 00 08")  # the PDO is in use
    master.write(3, 0x1800, 1, 0x183 | 1 << 31, 4)
    assert master.write(3, 0x1A00, 1, 0x60640020, 4).endswith("22 00 00 08")  # count is not zero
    master.write(3, 0x1A00, 0, 0, 1)
    assert master.write(3, 0x1A00, 1, 0x60650020, 4).endswith("41 00 04 06")  # not mappable
    assert master.write(3, 0x1A00, 1, 0x60840020, 4).endswith("00 00 02 06")  # not there
    for sub in (1, 2, 3):
        master.write(3, 0x1A00, sub, 0x60640020, 4)
    assert master.write(3, 0x1A00, 0, 3, 1).endswith("42 00 04 06")  # 12 bytes


def test_the_unused_word_of_the_first_receive_pdo_counts(master: Master) -> None:
    master.enable(3)
    master.write(3, 0x6060, 0, 7, 1)
    master.send(0x000, "01 03")
    start = round(master.joint_counts())
    for step in range(1, 6):
        master.send(0x203, struct.pack("<Hhi", 0x1F, -1, start + 100 * step))
        master.sync()
    master.sync()
    assert master.joint_counts() == pytest.approx(start + 500)


def test_a_process_data_object_can_have_a_timer(master: Master) -> None:
    for sub, value, size in ((1, 1 << 31 | 0x183, 4), (2, 255, 1), (5, 50, 2), (1, 0x183, 4)):
        assert master.write(3, 0x1800, sub, value, size).startswith("60")
    assert master.write(3, 0x1800, 2, 2, 1).endswith("30 00 09 06")  # every second SYNC: not offered
    master.send(0x000, "01 03")
    assert [frame.can_id for frame in master.wait(1.0)].count(0x183) == 20
    assert 0x183 not in [frame.can_id for frame in master.sync()]


def test_set_points_act_at_the_next_sync_only(master: Master) -> None:
    master.enable(3)
    master.send(0x000, "01 03")
    master.send(0x303, struct.pack("<iI", 5000, 50_000))
    master.send(0x203, struct.pack("<Hhi", 0x1F, 0, 0))
    master.wait(0.2)
    assert master.joint_counts() == 0
    answered = master.sync()
    assert next(f for f in answered if f.can_id == 0x183).data[1] & 0x10 == 0  # sampled before
    acknowledged = master.sync()
    assert next(f for f in acknowledged if f.can_id == 0x183).data[1] & 0x14 == 0x10
    master.sync(40)
    assert master.joint_counts() == 5000


def test_a_set_point_with_values_of_the_same_frame_uses_them(master: Master) -> None:
    master.enable(3)
    master.write(3, 0x1400, 1, 0x203 | 1 << 31, 4)
    master.write(3, 0x1600, 0, 0, 1)
    master.write(3, 0x1600, 1, 0x60400010, 4)  # controlword first
    master.write(3, 0x1600, 2, 0x607A0020, 4)
    master.write(3, 0x1600, 0, 2, 1)
    master.write(3, 0x1400, 1, 0x203, 4)
    master.send(0x000, "01 03")
    master.send(0x203, struct.pack("<Hi", 0x1F, 7000))
    master.sync(200)
    assert master.joint_counts() == 7000
