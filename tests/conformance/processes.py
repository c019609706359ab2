"""One pair on a real port: the device in a process of its own, the driver that a cell file makes."""

import contextlib
import dataclasses
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from controller.cellfile import load_cell
from controller.demo_cell import copy_bench_block, variants
from controller.robots import make_robot
from controller.sensors import make_laser, make_probe
from drivers.capabilities import Device, Identity, Search
from drivers.clock import RealClock
from drivers.links.ports import RealPorts
from drivers.sensors.dlrs1a import DlRs1a
from drivers.sensors.ft300 import Ft300
from estimation.errors import DeviceError
from simulators.device_kind import DeviceKind, Setting
from simulators.endpoints import read_endpoints
from simulators.registry import DEVICES
from simulators.robots.kinds import ROBOTS
from simulators.sensors.kinds import LASERS
from tests.conformance.pairs import GAUGE, ROBOTIQ, Pair
from tests.conformance.rig import SETTINGS

ROOT = Path(__file__).parents[2]
PATIENCE = 4.0  # the processes of all tests share the computer
DEADLINE_S = 30.0
AS_IN_THE_CELL = {"range_start_mm": 50.0, "range_mm": 100.0}  # the device alone measures farther away


class Control:
    """The control socket of a simulator, and what can be known by it: a clock, and true joints."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __call__(self, do: str = "status", **more: Any) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as line:
            line.connect(os.path.relpath(self._path))
            line.sendall(json.dumps({"do": do, **more}).encode() + b"\n")
            answer: dict[str, Any] = json.loads(line.makefile().readline())
        assert answer["ok"], answer
        return answer

    def now_s(self) -> float:
        """Simulated time."""
        return float(self()["time_s"])

    def sleep(self, duration_s: float) -> None:
        """Let simulated time pass."""
        until_s = self.now_s() + duration_s
        while (left_s := until_s - self.now_s()) > 0:
            time.sleep(left_s)

    def joints_at(self, time_s: float) -> np.ndarray:
        """The true joints now; the arm rests."""
        return np.array(self()["joints_rad"])


class _SimulatedInstants:
    """A probe that tells its touches in simulated time; at a busy moment the two clocks drift apart."""

    def __init__(self, probe: Any, control: Control) -> None:
        self._probe, self._control = probe, control
        self.poll_uncertainty_s = probe.poll_uncertainty_s

    def arm(self) -> None:
        self._probe.arm()

    def touched_at_s(self) -> float | None:
        touched_s = self._probe.touched_at_s()
        if touched_s is None:
            return None
        before_s = time.monotonic()
        simulated_s = self._control.now_s()
        self.poll_uncertainty_s = self._probe.poll_uncertainty_s + time.monotonic() - before_s + 0.03
        return simulated_s - (before_s - touched_s)


class ProcessRig:
    """A pair whose port can be found by a pattern, so that the device may come back under another name."""

    def __init__(self, pair: Pair, folder: Path, control: Control, searched: bool) -> None:
        self.pair, self.control, self.kind = pair, control, DEVICES[pair.kind]
        self.clock = RealClock()
        self.ports = RealPorts(folder, self.clock)
        self.driver = driver_of(pair.kind, folder / "cell.toml", self.ports)
        self.search: Search | None = next(iter(self.ports.searches.values()), None)
        assert (self.search is not None) == searched
        settings = SETTINGS.get(pair.kind, {})
        self.device = dataclasses.replace(
            self.kind.simulated(0, **settings, **in_cell(self.kind)), model=control
        )
        self.rng = np.random.default_rng(0)

    def connect(self) -> Identity:
        return self.driver.connect() if self.search is None else self.search.connect(self.driver)

    def work(self) -> None:
        driver: Any = self.driver
        if hasattr(driver, "touched_at_s"):
            driver = _SimulatedInstants(driver, self.control)
        self.pair.work(driver, self.device, self.control, self.rng)

    def release(self) -> None:
        if hasattr(self.driver, "release"):
            self.driver.release()

    def heal(self) -> Identity:
        """Connect and work, as soon as the device lets us."""
        deadline_s = self.clock.now_s() + DEADLINE_S
        while True:
            try:
                self.release()
                identity = self.connect()
                self.work()
                return identity
            except DeviceError:
                if self.clock.now_s() > deadline_s:
                    raise
            self.clock.sleep(0.2)


def in_cell(kind: DeviceKind[Any]) -> dict[str, Setting]:
    """Settings by which the device alone is the one of the cell file."""
    wanted = {} if kind.name == "ams-335i" else AS_IN_THE_CELL
    return {key: value for key, value in wanted.items() if key in kind.settings}


def driver_of(kind: str, cell_file: Path, ports: RealPorts) -> Device:
    """As the product makes it; of a sensor that serves as a probe, the sensor."""
    cell = load_cell(cell_file)
    clock = RealClock()
    if kind in {robot.name for robot in ROBOTS}:
        return make_robot(cell.robot, ports, clock, patience=PATIENCE)
    if kind in {laser.name for laser in LASERS}:
        return make_laser(cell.laser, ports, clock, PATIENCE)
    port = getattr(cell.probe, "port", "")
    if kind == "robotiq-ft300":
        config = dataclasses.replace(ROBOTIQ, worst_answer_s=0.1 * PATIENCE)
        return Ft300(ports.serial("probe", port, 19200), config, clock)
    if kind == "keyence-gt2":
        return DlRs1a(ports.serial("probe", port, GAUGE.baud), GAUGE, clock)
    return make_probe(cell.probe, ports, clock, PATIENCE)


@contextlib.contextmanager
def process_rig(pair: Pair, folder: Path) -> Iterator[ProcessRig]:
    """The device as `truecell simulate --device` runs it, at the port of a cell file."""
    kind = DEVICES[pair.kind]
    cell_file = copy_bench_block(folder, [pair.kind] if pair.kind in variants() else [])
    role = next(role for role, named in read_endpoints(cell_file).items() if named.driver == pair.kind)
    text = cell_file.read_text()
    endpoint = read_endpoints(cell_file)[role].endpoint
    command = [sys.executable, "-m", "simulators", "--device", pair.kind]
    searched = kind.link != "tcp"
    if searched:
        name = endpoint.ports[""]
        cell_file.write_text(text.replace(f'port = "{name}"', f'port = "{name}[0-9]"', 1))
        command += ["--port", str(folder / f"{name}0")]
    else:
        command += [
            part for socket, port in endpoint.ports.items() for part in ("--port", f"{socket}={port}")
        ]
    for key, value in {**SETTINGS.get(pair.kind, {}), **in_cell(kind)}.items():
        command += ["--set", f"{key}={value}"]
    path = folder / "control.sock"
    with subprocess.Popen(
        [*command, "--control", str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as simulator:
        try:
            assert simulator.stdout is not None
            while (line := simulator.stdout.readline()) != "ready\n":
                assert line, "the simulator ended"
            rig = ProcessRig(pair, folder, Control(path), searched)
            yield rig
            rig.driver.close()
        finally:
            simulator.terminate()
