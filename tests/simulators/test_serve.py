"""The cell across processes: independent clients on a pty with slcan, a pty with a laser, and TCP."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial
from pymodbus.client import ModbusTcpClient

from controller.demo_cell import copy_bench_block
from simulators.ports import PtyPort, garbled
from simulators.slcan import SlcanDongle

pytestmark = pytest.mark.wire


class Simulator:
    """One simulator process and its control socket."""

    def __init__(self, cell_dir: Path, run_dir: Path, *options: str) -> None:
        command = [sys.executable, "-m", "simulators", str(cell_dir), "--run-dir", str(run_dir)]
        self.process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"
        self.run_dir = run_dir
        self.info: dict[str, Any] = json.loads((run_dir / "simulator.json").read_text())
        self.robot = self.info["devices"]["robot"][""]
        self.laser = self.info["devices"]["laser"][""]
        host, _, port = self.info["devices"]["probe"][""].rpartition(":")
        self.probe = host, int(port)

    def control(self, **request: Any) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(os.path.relpath(self.info["control"]))
            connection.sendall(json.dumps(request).encode() + b"\n")
            answer: dict[str, Any] = json.loads(connection.makefile("rb").readline())
        return answer

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(10)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_bench_block(tmp_path_factory.mktemp("cell")).parent


@pytest.fixture(scope="module")
def simulator(home: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulator]:
    simulator = Simulator(home, tmp_path_factory.mktemp("run"), "--motion-speed", "20")
    yield simulator
    assert simulator.end() == 0


def read_until(port: serial.Serial, end: bytes, timeout_s: float = 5.0) -> bytes:
    data, deadline = b"", time.monotonic() + timeout_s
    while end not in data and time.monotonic() < deadline:
        data += port.read(max(1, port.in_waiting))
    return data


def test_the_laser_at_its_own_speed_and_at_another(simulator: Simulator) -> None:
    with serial.Serial(simulator.laser, 921600, timeout=0.05) as port:
        port.write(b"OUTPUT NONE\n")
        read_until(port, b"OUTPUT NONE\r\n->")
        port.write(b"GETINFO\n")
        assert b"Serial: 1420100\r\n" in read_until(port, b"->")
        port.baudrate = 115200
        port.write(b"GETINFO\n")
        assert read_until(port, b"->", 0.5) == b""  # it did not understand
        port.baudrate = 921600
        port.write(b"\n")
        read_until(port, b"->")
        port.write(b"MEASRATE 2\nOUTPUT RS422\n")
        read_until(port, b"OUTPUT RS422\r\n->")
        started, count = time.monotonic(), 0
        while time.monotonic() - started < 1.0:
            count += len(port.read(max(1, port.in_waiting)))
        assert 0.5 < count / 6000 < 1.1  # a busy machine makes the simulated time slower, never faster
        port.baudrate = 115200
        port.reset_input_buffer()
        read_until(port, b"\x00" * 99, 0.1)
        stream = read_until(port, b"\x00" * 99, 0.2)
        low, high = (sum(byte >> 7 == bit for byte in stream) for bit in (0, 1))
        assert high > 20 * low  # framing is lost
        port.baudrate = 921600
        port.write(b"OUTPUT NONE\n")
        read_until(port, b"OUTPUT NONE\r\n->")


def test_the_remote_io_answers_an_independent_client(simulator: Simulator) -> None:
    host, port = simulator.probe
    client = ModbusTcpClient(host, port=port, timeout=5)
    assert client.connect()
    other = ModbusTcpClient(host, port=port, timeout=5)
    assert other.connect()
    assert client.read_holding_registers(210, count=2).registers == [0x6052, 0]
    assert other.read_input_registers(0, count=2).registers == [0, 0]
    assert client.read_discrete_inputs(0, count=8).bits[:8] == [False] * 8
    assert client.read_input_registers(1000, count=1).isError()
    client.close()
    assert other.read_holding_registers(210, count=1).registers == [0x6052]
    other.close()


def test_a_cable_can_be_pulled_and_put_back(simulator: Simulator) -> None:
    port = serial.Serial(simulator.laser, 921600, timeout=0.2)
    answer = simulator.control(do="unplug", device="laser")
    assert answer["ok"] and answer["plugged"] == {"robot": True, "laser": False, "probe": True}
    with pytest.raises((serial.SerialException, OSError)):
        for _ in range(10_000):
            port.read(100)
    port.close()
    assert not Path(simulator.laser).exists()
    assert simulator.control(do="plug", device="laser")["plugged"]["laser"]
    with serial.Serial(simulator.laser, 921600, timeout=0.2) as again:
        again.write(b"OUTPUT NONE\n")
        assert b"->" in read_until(again, b"OUTPUT NONE\r\n->")


def test_the_probe_can_be_unplugged(simulator: Simulator) -> None:
    host, port = simulator.probe
    client = ModbusTcpClient(host, port=port, timeout=1, retries=0)
    assert client.connect()
    simulator.control(do="unplug", device="probe")
    with pytest.raises(OSError):
        socket.create_connection((host, port), 1).close()
    client.close()
    simulator.control(do="plug", device="probe")
    with ModbusTcpClient(host, port=port, timeout=5) as again:
        assert again.read_holding_registers(210, count=1).registers == [0x6052]


def test_control_refuses_what_it_does_not_know(simulator: Simulator) -> None:
    for request in ({"do": "dance"}, {"do": "unplug", "device": "door"}, {}, {"do": "fault"}):
        answer = simulator.control(**request)
        assert not answer["ok"] and answer["error"]
    assert simulator.control(do="status")["ok"]


def test_the_player_can_change_the_world(simulator: Simulator) -> None:
    assert not simulator.control(do="part", present=False)["part_present"]
    assert simulator.control(do="part", present=True)["part_present"]
    assert simulator.control(do="bump", translation_m=[0, 1e-3, 0])["ok"]
    assert simulator.control(do="silence", device="robot", seconds=0.01)["ok"]


def test_the_truth_is_written_for_those_who_compare(simulator: Simulator) -> None:
    truth = json.loads((simulator.run_dir / "truth.json").read_text())
    assert truth["seed"] == 1 and truth["scenario"] == "honest"
    assert len(truth["poses"]["laser"]) == 4


def test_it_ends_cleanly_and_a_scenario_must_exist(simulator: Simulator, tmp_path: Path) -> None:
    shutil.copytree(simulator.run_dir / "cache", tmp_path / "a" / "cache")  # parsing the CAD takes seconds
    home = copy_bench_block(tmp_path / "home").parent
    other = Simulator(home, tmp_path / "a", "--scenario", "part-missing", "--seed", "7")
    assert not other.control(do="status")["part_present"]
    other.control(do="quit")
    assert other.process.wait(10) == 0
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["cache", "truth.json"]
    command = [
        sys.executable,
        "-m",
        "simulators",
        str(home),
        "--run-dir",
        str(tmp_path),
        "--scenario",
        "x",
    ]
    refused = subprocess.run(command, capture_output=True, text=True, check=False)
    assert refused.returncode == 2 and "No scenario 'x'" in refused.stderr


def test_a_client_that_asks_for_parity_can_open_the_port_again(tmp_path: Path) -> None:
    port = PtyPort(tmp_path / "laser")
    for _ in range(3):
        port.stay_settable()
        serial.Serial(str(port.path), 9600, parity=serial.PARITY_EVEN).close()
    port.unplug()


# -- the dongle by itself ------------------------------------------------------------------------


def test_the_dongle_speaks_lawicel() -> None:
    dongle = SlcanDongle()
    assert dongle.receive(b"O\r") == b"\a"  # no speed yet
    assert dongle.receive(b"C\rS9\rS8\r") == b"\a\a\r"
    assert dongle.receive(b"t2034AABBCCDD\r") == b"\a"  # closed
    assert dongle.receive(b"O\rV\rN\r") == b"\rV1013\rNTC01\r"
    assert dongle.receive(b"t2034AABB") == b"" and dongle.receive(b"CCDD\r") == b"\r"
    assert dongle.sent == [(0x203, bytes.fromhex("AABBCCDD"))]
    for bad in (b"t2039AA\r", b"t2G34AABBCCDD\r", b"t2034AABBCC\r", b"?\r", b"\xff\r"):
        assert dongle.receive(bad) == b"\a"
    assert dongle.receive(b"x" * 40) == b"\a"
    assert dongle.receive(b"r0800\rT000002031AA\r") == b"\r\r" and len(dongle.sent) == 1


def test_at_a_wrong_speed_nothing_reads_as_text() -> None:
    assert not any(chr(byte).isascii() for byte in garbled(bytes(range(256))))
