"""The drivers on real ports, against the simulators in a process of their own."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import load_cell
from controller.demo_cell import copy_bench_block
from controller.devices import make_devices
from drivers.capabilities import Devices
from drivers.clock import RealClock
from drivers.links.ports import RealPorts

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.wire


@contextmanager
def served(folder: Path, variants: Sequence[str]) -> Iterator[Devices]:
    """Drivers of the cell with these devices, connected to the ports that its cell file names."""
    cell_file = copy_bench_block(folder, variants)
    cell_file.write_text(cell_file.read_text().replace("\npatience = 1 ", "\npatience = 8 "))
    command = [sys.executable, "-m", "simulators", str(folder), "--motion-speed", "4"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as simulators:
        assert simulators.stdout is not None
        assert simulators.stdout.readline() == "ready\n"
        clock = RealClock()
        made = make_devices(load_cell(cell_file), RealPorts(folder, clock), clock, keep_alive_thread=True)
        try:
            for device in made.all():
                device.connect()
            yield made
        finally:
            for device in made.all():
                device.close()
            simulators.terminate()


@pytest.mark.parametrize(
    "variants",
    [
        (),
        ("ur", "keyence-il", "wago-750-337"),
        ("melfa-tcp", "gocator", "keyence-gt2"),
        ("igus-irc", "ams-335i", "robotiq-ft300"),
        pytest.param(("abb-open", "riftek-binary"), marks=pytest.mark.campaign),
        pytest.param(("melfa-serial", "riftek-ascii"), marks=pytest.mark.campaign),
        pytest.param(("riftek-modbus",), marks=pytest.mark.campaign),
    ],
    ids=lambda variants: "+".join(variants) or "bench",
)
def test_move_measure_and_search(variants: Sequence[str], tmp_path: Path) -> None:
    with served(tmp_path, variants) as devices:
        robot, laser, probe = devices.robot, devices.laser, devices.probe
        start = robot.read_joints(1).joints_rad[0]
        robot.move_joints(start + 0.2)
        laser.begin_window()
        readings = robot.read_joints(3)
        window = laser.end_window(10)
        assert readings.joints_rad == pytest.approx(np.tile(start + 0.2, (3, 1)), abs=4e-4)
        assert len(window.distance_m) + window.rejected >= 10
        probe.arm()
        assert robot.move_until_contact(start + 0.22, 0.1, probe) is None
        assert robot.is_at_rest() and probe.is_open()
        for device in devices.all():
            health = device.health()
            assert health.frames > 0 and health.bad_frames == 0
