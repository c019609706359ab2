"""`truecell devices probe`: what it shows, what it says of a missing device, and that nothing moves."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from controller.console.app import main
from controller.console.exit_codes import ExitCode
from controller.demo_cell import copy_bench_block
from controller.probing import Seen, probe_devices
from controller.service import STORE_NAME
from controller.store.store import Store
from drivers.robots.canopen_arm_codec import RPDO
from simulators.virtual import VirtualByteLink, VirtualCanLink
from tests.support.deterministic import DeterministicCell

PLACES = {"robot": ("driver", "port"), "laser": ("driver", "port"), "probe": ("driver", "port")}
ROBOTS = ("", "ur", "melfa-tcp", "melfa-serial", "igus-irc", "abb-open")
# What sets an arm in motion, or switches its motors on.
MOTION = {
    "ur": (b"power on", b"brake release", b"movej", b"movel", b"def "),
    "melfa-tcp": (b"SRVON", b"EXEC", b"CNTLON", b"RSTALRM"),
    "melfa-serial": (b"SRVON", b"EXEC", b"CNTLON", b"RSTALRM"),
    "igus-irc": (b"\x01\x05", b"\x01\x06", b"\x01\x10"),  # any write
    "abb-open": (b"01 ", b"02 ", b"30 ", b"35 "),
}


class Wires:
    """A deterministic cell whose sent bytes and frames are kept."""

    def __init__(self, cell: DeterministicCell) -> None:
        self.cell, self.bytes, self.frames = cell, b"", list[tuple[int, bytes]]()
        for name, link in cell.world.ports.links.items():
            if isinstance(link, VirtualCanLink):
                self._keep_frames(link)
            elif name.startswith("robot"):
                self._keep_bytes(link)

    def _keep_bytes(self, link: VirtualByteLink) -> None:
        write = link.write

        def kept(data: bytes) -> None:
            self.bytes += data
            write(data)

        link.write = kept  # type: ignore[method-assign]

    def _keep_frames(self, link: VirtualCanLink) -> None:
        send = link.send

        def kept(can_id: int, data: bytes) -> None:
            self.frames.append((can_id, data))
            send(can_id, data)

        link.send = kept  # type: ignore[method-assign]

    def commanded(self, robot: str) -> bool:
        """Whether something was sent that switches motors on or moves the arm."""
        enables = any(can_id & 0x780 == RPDO[0] and data[0] & 0x0F == 0x0F for can_id, data in self.frames)
        targets = any(can_id & 0x780 == RPDO[1] for can_id, _ in self.frames)
        return enables or targets or any(words in self.bytes for words in MOTION.get(robot, ()))

    def probe(self) -> dict[str, Seen]:
        return {seen.role: seen for seen in probe_devices(self.cell.devices, PLACES, lambda text: None)}


def wires(tmp_path: Path, robot: str = "") -> Wires:
    return Wires(DeterministicCell(cell_path=copy_bench_block(tmp_path, (robot,) if robot else ())))


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_shows_who_answers_and_what_is_measured_and_nothing_moves(robot: str, tmp_path: Path) -> None:
    bench = wires(tmp_path, robot)
    arm, clock = bench.cell.world.arm, bench.cell.world.clock
    before = arm.joints_at(clock.now_s())
    seen = bench.probe()
    assert [one.is_well for one in seen.values()] == [True] * 3
    assert all(one.identity is not None and one.identity.model for one in seen.values())
    assert seen["robot"].values["joints_deg"] == pytest.approx(np.degrees(before), abs=0.02)
    assert seen["laser"].values["cycles"] + seen["laser"].values["rejected"] >= 20
    assert seen["probe"].values["open"] is True
    assert np.array_equal(arm.joints_at(clock.now_s()), before)
    assert not bench.commanded(robot)
    driver = bench.cell.devices.robot
    driver.release()
    driver.connect()
    driver.move_joints(before + 0.01)
    assert bench.commanded(robot)  # what was looked for is what moves this arm


def test_a_device_that_is_not_there_does_not_hide_the_others(tmp_path: Path) -> None:
    bench = wires(tmp_path)
    bench.cell.world.laser_link.unplugged = True
    seen = bench.probe()
    assert {role: one.is_well for role, one in seen.items()} == {"robot": True, "laser": False, "probe": True}
    assert seen["laser"].problem == "Port laser is gone"
    assert json.dumps([one.as_json() for one in seen.values()])


def test_another_device_than_the_cell_file_names_is_said(tmp_path: Path) -> None:
    path = copy_bench_block(tmp_path, ())
    text = path.read_text()
    path.write_text(text.replace('serial_number = "1420100"', 'serial_number = "4711"'))
    assert path.read_text() != text
    seen = Wires(DeterministicCell(cell_path=path)).probe()["laser"]
    assert "its serial number is" in seen.problem and "the cell file says 4711" in seen.problem


@pytest.mark.wire
def test_on_real_ports_and_with_a_wrong_baud_rate(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = copy_bench_block(tmp_path, ())
    command = [sys.executable, "-m", "simulators", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as simulators:
        assert simulators.stdout is not None and simulators.stdout.readline() == "ready\n"
        try:
            code, out, _ = run(capsys, "devices", "probe", str(path), "--json")
            answer = json.loads(out)
            assert code is ExitCode.OK, answer
            assert [seen["role"] for seen in answer["devices"]] == ["robot", "laser", "probe"]
            assert all(sum(seen["answers"]) > 0 for seen in answer["links"].values())
            path.write_text(path.read_text().replace("baud = 921600", "baud = 460800"))
            code, out, _ = run(capsys, "devices", "probe", str(path))
            assert code is ExitCode.FAULT
            assert "Laser: no valid answer at 460800 8N1" in out
        finally:
            simulators.terminate()


def test_the_devices_of_a_daemon_are_left_alone(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """On TCP and SocketCAN nothing else would keep two masters apart."""
    path = copy_bench_block(tmp_path, ())
    store = Store.open(path.parent / ".truecell" / STORE_NAME)
    try:
        code, _, err = run(capsys, "devices", "probe", str(path))
    finally:
        store.close()
    assert code is ExitCode.REFUSED
    assert err.startswith("A daemon has the devices of this cell") and f"process {os.getpid()}" in err


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[ExitCode, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    code = ended.value.code
    assert isinstance(code, int)
    return (ExitCode(code), *capsys.readouterr())


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> tuple[ExitCode, str, str]:
    """Of the command, on a cell whose devices do not exist."""
    return run(capsys, "devices", "probe", str(copy_bench_block(tmp_path, ())))


def test_missing_devices_are_one_sentence_each(printed: tuple[ExitCode, str, str]) -> None:
    code, out, err = printed
    assert code is ExitCode.FAULT and not err
    assert out.count("cannot be opened: No such file") == 2  # the dongle, and the line of the laser
    assert "127.0.0.1 refuses connections to port" in out
    assert "Traceback" not in out
