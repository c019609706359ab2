"""The deterministic cell: time that jumps, links that break as told, and one seed, one story."""

from pathlib import Path

import numpy as np
import pytest

from estimation.errors import CellFileError, DeviceError
from simulators.virtual import SimulatedCell, VirtualCanLink


@pytest.fixture
def cell(cell_dir: Path) -> SimulatedCell:
    return SimulatedCell(cell_dir, seed=1)


READ_COUNTER = bytes.fromhex("0001 0000 0006 01 04 0000 0002")


def test_waiting_takes_the_time_of_the_device_or_of_the_wait(cell: SimulatedCell) -> None:
    started = cell.clock.now_s()
    cell.probe_link.write(READ_COUNTER)
    assert cell.probe_link.read(1.0)
    assert cell.clock.now_s() - started == pytest.approx(0.0015)
    assert cell.probe_link.read(1.0) == b""
    assert cell.clock.now_s() - started == pytest.approx(1.0015)
    cell.clock.sleep(2.0)
    assert cell.clock.now_s() - started == pytest.approx(3.0015)
    assert not cell.arm_link.receive(0.5)
    assert cell.clock.now_s() - started == pytest.approx(3.5015)
    assert cell.clock.utc_s() - cell.clock.now_s() == pytest.approx(1_790_000_000)


def test_what_came_in_the_meantime_is_there_at_once(cell: SimulatedCell) -> None:
    cell.laser_link.discard_input()
    cell.clock.sleep(0.1)
    before = cell.clock.now_s()
    assert len(cell.laser_link.read(1.0)) // 3 == pytest.approx(400, abs=20)
    assert cell.clock.now_s() == before


def test_frames_carry_the_time_of_the_clock(cell: SimulatedCell) -> None:
    cell.clock.sleep(5.0)
    cell.arm_link.send(0x603, bytes.fromhex("4041600000000000"))
    (frame,) = cell.arm_link.receive(1.0)
    assert frame.can_id == 0x583
    assert frame.time_s == cell.clock.now_s() == pytest.approx(5.0, abs=0.01)


def test_the_answers_to_one_sync_come_together(cell: SimulatedCell) -> None:
    cell.arm_link.send(0x000, b"\x01\x00")
    cell.arm_link.send(0x080, b"")
    frames = cell.arm_link.receive(1.0)
    assert [frame.can_id & 0x7F for frame in frames if frame.can_id < 0x200] == [3, 4, 5, 6, 7, 8]
    assert {frame.time_s for frame in frames} == {cell.clock.now_s()}


def story(cell_dir: Path, seed: int) -> list[object]:
    cell = SimulatedCell(cell_dir, seed)
    heard: list[object] = []
    cell.arm_link.send(0x000, b"\x01\x00")
    for _ in range(20):
        cell.arm_link.send(0x080, b"")
        while frames := cell.arm_link.receive(0.01):
            heard += frames
        heard.append(cell.laser_link.read(0.1))
    return heard


def test_one_seed_is_one_story(cell_dir: Path) -> None:
    assert story(cell_dir, 3) == story(cell_dir, 3)
    assert story(cell_dir, 3) != story(cell_dir, 4)


# -- faults --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["robot", "laser", "probe"])
def test_an_unplugged_link_is_gone_until_it_is_plugged_in_and_reopened(
    cell: SimulatedCell, name: str
) -> None:
    link = cell.ports.links[name]
    link.unplugged = True
    read = link.receive if isinstance(link, VirtualCanLink) else link.read
    for action in (lambda: read(0.1), link.reopen):
        with pytest.raises(DeviceError, match=f"Port {name} is gone"):
            action()
    link.unplugged = False
    link.reopen()
    read(0.1)
    link.close()
    link.close()


def test_a_link_can_break_in_the_middle_of_a_wait(cell: SimulatedCell) -> None:
    cell.probe_link.unplug_at_s = 0.4
    with pytest.raises(DeviceError):
        cell.probe_link.read(1.0)
    assert cell.clock.now_s() == pytest.approx(0.4)
    cell.probe_link.unplugged = False
    cell.probe_link.write(READ_COUNTER)
    assert cell.probe_link.read(1.0)


def test_silence_loses_answers_and_ends(cell: SimulatedCell) -> None:
    cell.probe_link.faults.add("drop", from_s=0.0, until_s=2.0)
    cell.probe_link.write(READ_COUNTER)
    assert cell.probe_link.read(1.0) == b""
    cell.clock.sleep(1.5)
    cell.probe_link.write(READ_COUNTER)
    assert cell.probe_link.read(1.0)


def test_silence_of_the_arm(cell: SimulatedCell) -> None:
    cell.arm_link.faults.add("drop")
    cell.arm_link.send(0x603, bytes.fromhex("4041600000000000"))
    assert not cell.arm_link.receive(0.5)
    assert cell.clock.now_s() == pytest.approx(0.5)


def test_late_answers_come_during_the_next_request(cell: SimulatedCell) -> None:
    cell.probe_link.faults.add("late", 0.3)
    cell.probe_link.write(READ_COUNTER)
    assert cell.probe_link.read(0.2) == b""
    second = READ_COUNTER[:1] + b"\x02" + READ_COUNTER[2:]
    cell.probe_link.write(second)
    assert cell.probe_link.read(0.2)[1] == 1
    assert cell.clock.now_s() == pytest.approx(0.3015)
    assert cell.probe_link.read(0.3)[1] == 2


def test_late_frames_come_late(cell: SimulatedCell) -> None:
    cell.arm_link.faults.add("late", 0.3)
    cell.arm_link.send(0x603, bytes.fromhex("4041600000000000"))
    assert not cell.arm_link.receive(0.2)
    (frame,) = cell.arm_link.receive(0.2)
    assert frame.time_s == pytest.approx(0.3014)


def test_bytes_can_come_one_by_one_with_noise_before_and_a_flipped_bit(cell: SimulatedCell) -> None:
    link = cell.probe_link
    link.write(READ_COUNTER)
    good = link.read(1.0)
    link.faults.add("garbage", payload=b"\xff\xfe", once=True)
    link.write(READ_COUNTER)
    assert link.read(1.0) == b"\xff\xfe" + good
    link.faults.add("corrupt", once=True)
    link.write(READ_COUNTER)
    bad = link.read(1.0)
    assert sum(bin(a ^ b).count("1") for a, b in zip(good, bad, strict=True)) == 1
    link.faults.add("split")
    link.write(READ_COUNTER)
    assert b"".join(link.read(1.0) for _ in good) == good


# -- scenarios -----------------------------------------------------------------------------------


def test_an_unknown_scenario_is_refused(cell_dir: Path) -> None:
    with pytest.raises(CellFileError, match="no-such-thing"):
        SimulatedCell(cell_dir, 1, scenario="no-such-thing")


def test_the_bump_comes_when_it_is_told_to(cell_dir: Path) -> None:
    cell = SimulatedCell(cell_dir, 1, scenario="bumped-laser")
    before = cell.world.flange_T_laser.copy()
    np.testing.assert_array_equal(before, cell.truth.flange_T_laser)
    cell.bump()
    moved = np.linalg.norm(cell.world.flange_T_laser[:3, 3] - before[:3, 3])
    assert moved == pytest.approx(np.linalg.norm([0.3e-3, 0.4e-3, 0.2e-3]))
    assert cell.model.truth_json()["bump"][1] == pytest.approx(-0.4e-3)


def test_scenarios_change_one_thing(cell_dir: Path) -> None:
    honest = SimulatedCell(cell_dir, 1)
    for name in honest.model.file.scenarios:
        cell = SimulatedCell(cell_dir, 1, scenario=name)
        assert cell.truth.to_json() == honest.truth.to_json()
        assert cell.world.part_present == (name != "part-missing")


def test_a_nominal_silent_cell_can_be_had(cell_dir: Path) -> None:
    cell = SimulatedCell(cell_dir, 1, error_factor=0.0, noise_factor=0.0)
    cell.arm_link.send(0x000, b"\x01\x00")
    samples = set()
    for _ in range(5):
        cell.arm_link.send(0x080, b"")
        while frames := cell.arm_link.receive(0.01):
            samples |= {frame.data for frame in frames if frame.can_id == 0x385}
    assert samples == {(-90_000).to_bytes(4, "little", signed=True) + bytes(4)}
