"""The drivers on real ports, against the simulators in a process of their own."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.cellfile import load_cell
from controller.devices import make_devices
from drivers.capabilities import Devices
from drivers.clock import RealClock
from drivers.links.can_bus import PythonCanLink
from drivers.links.serial_port import SerialLink
from drivers.links.tcp import TcpLink

ROOT = Path(__file__).parents[1]
CELL = ROOT / "cells" / "bench-block"
pytestmark = pytest.mark.wire


class _FoundPorts:
    """The ports of a simulator that chose them itself."""

    def __init__(self, where: dict[str, Any]) -> None:
        self._where = where

    def can_bus(self, name: str, interface: str, port: str, bitrate: int) -> PythonCanLink:
        return PythonCanLink(interface, self._where["arm"], bitrate)

    def serial(self, name: str, port: str, baud: int, framing: str = "8N1") -> SerialLink:
        return SerialLink(self._where[name], baud, framing)

    def tcp(self, name: str, host: str, port: int) -> TcpLink:
        return TcpLink(*self._where[name])


@pytest.fixture
def devices(tmp_path: Path) -> Iterator[Devices]:
    command = [sys.executable, "-m", "simulators", str(CELL), "--run-dir", str(tmp_path), "--probe-port", "0"]
    with subprocess.Popen(
        [*command, "--motion-speed", "4"], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as simulators:
        assert simulators.stdout is not None
        assert simulators.stdout.readline() == "ready\n"
        where = json.loads((tmp_path / "simulator.json").read_text())
        made = make_devices(load_cell(CELL), _FoundPorts(where), RealClock(), keep_alive_thread=True)
        try:
            for device in made.all():
                device.connect()
            yield made
        finally:
            for device in made.all():
                device.close()
            simulators.terminate()


def test_move_measure_and_search(devices: Devices) -> None:
    robot, laser, probe = devices.robot, devices.laser, devices.probe
    start = robot.read_joints(1).joints_rad[0]
    robot.move_joints(start + 0.2)
    laser.begin_window()
    readings = robot.read_joints(3)
    window = laser.end_window(40)
    assert readings.joints_rad == pytest.approx(np.tile(start + 0.2, (3, 1)), abs=3e-4)
    assert len(window.distance_m) + window.rejected >= 40
    probe.arm()
    assert robot.move_until_contact(start + 0.22, 0.1, probe) is None
    assert robot.is_at_rest() and probe.is_open()
    for device in devices.all():
        health = device.health()
        assert health.frames > 0 and health.bad_frames == 0
