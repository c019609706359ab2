"""The bench-block job with another laser and another probe: only their tables in the cell file change."""

import re
from pathlib import Path

from controller.packml import State
from drivers.probes.wago750 import WagoProbe
from drivers.sensors.riftek import RiftekLaser
from tests.support.deterministic import BENCH_BLOCK, DeterministicCell, edited_cell

RIFTEK = """driver = "riftek-binary"
port = "run/laser"
serial_number = "17185"
"""
WAGO = """driver = "wago-750-337"
port = "run/probe"
interface = "slcan"
bitrate = 1000000
node = 20
model = "750-337"
channel = 0
"""


def _device(driver: str, until: str) -> str:
    """What the cell file says of a device up to a key."""
    found = re.search(
        rf'driver = "{driver}".*?(?=^{until} = )', (BENCH_BLOCK / "cell.toml").read_text(), re.S | re.M
    )
    assert found is not None
    return found[0]


def test_a_riftek_laser_and_a_probe_on_canopen_do_the_job(tmp_path: Path) -> None:
    path = edited_cell(
        tmp_path,
        (_device("optoncdt-1420", "rate"), RIFTEK),
        ('rate = "2 kHz"', 'rate = "200 Hz"'),
        (_device("adam-6052", "poll_period"), WAGO),
    )
    cell = DeterministicCell(cell_path=path)
    assert isinstance(cell.devices.laser, RiftekLaser) and isinstance(cell.devices.probe, WagoProbe)
    assert cell.run() is State.COMPLETED
    assert cell.released
    cell.close()
