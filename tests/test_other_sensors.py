"""The bench-block job with another laser or another probe: only the cell file changes."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from controller.packml import State
from drivers.probes.threshold import ThresholdProbe
from drivers.probes.wago750 import WagoProbe
from drivers.sensors.ams335i import Ams335i
from drivers.sensors.dlrs1a import DlRs1a
from drivers.sensors.gocator import Gocator
from drivers.sensors.riftek import RiftekLaser
from drivers.sensors.riftek_ascii import RiftekAsciiLaser
from drivers.sensors.riftek_modbus import RiftekModbusLaser
from tests.support.deterministic import BENCH_BLOCK, DeterministicCell, edited_cell


class Other(NamedTuple):
    """A device in place of the bench's own."""

    driver: type
    keys: Mapping[str, object]  # of its table, `driver` aside, in place of those of the bench's device
    edits: tuple[tuple[str, str], ...] = ()  # of what every device of its kind has


def _at(rate: str) -> tuple[str, str]:
    return 'rate = "2 kHz"', f'rate = "{rate}"'


def _poll(period: str, touch_speed: str) -> tuple[tuple[str, str], ...]:
    """A slower probe asks for a slower arm."""
    return (
        ('poll_period = "4 ms"', f'poll_period = "{period}"'),
        ('touch_speed = "1 mm/s"', f'touch_speed = "{touch_speed}"'),
        ('search_speed = "8 mm/s"', 'search_speed = "4 mm/s"'),
    )


RIFTEK: Final = {"port": "run/laser", "serial_number": "17185"}
CAN: Final[Mapping[str, object]] = {"interface": "slcan", "bitrate": 1_000_000}

LASERS: Final = {
    "riftek-binary": Other(RiftekLaser, RIFTEK, (_at("200 Hz"),)),
    "riftek-ascii": Other(RiftekAsciiLaser, RIFTEK, (_at("200 Hz"),)),
    "riftek-modbus": Other(RiftekModbusLaser, RIFTEK, (_at("200 Hz"),)),
    "keyence-il": Other(
        DlRs1a, {"port": "run/laser", "response": "10 ms", "zero": "100 mm"}, (_at("200 Hz"),)
    ),
    "gocator": Other(Gocator, {"host": "127.0.0.1", "job": "block", "zero": "100 mm"}, (_at("200 Hz"),)),
    "ams-335i": Other(
        Ams335i,
        {"port": "run/laser", **CAN, "node": 16, "serial_number": "335001", "step": "0.1 mm"},
        (
            _at("50 Hz"),
            ('range_start = "50 mm"', 'range_start = "0 mm"'),
            ('\nrange = "100 mm"', '\nrange = "150 mm"'),
            # Steps of 0.1 mm are noise of 0.03 mm, which hides that of the laser itself.
            ('\nnoise = "0.03 mm"', '\nnoise = "0.05 mm"'),
            ('reading_noise = "0.01 mm"', 'reading_noise = "0.03 mm"'),
        ),
    ),
}
PROBES: Final = {
    "wago-750-337": Other(
        WagoProbe, {"port": "run/probe", **CAN, "node": 20, "model": "750-337", "channel": 0}
    ),
    "robotiq-ft300": Other(
        ThresholdProbe,
        {"port": "run/probe", "threshold_newton": 2.0, "release_newton": 1.0, "free_newton": 10.0},
        _poll("10 ms", "0.5 mm/s"),
    ),
    "keyence-gt2": Other(
        ThresholdProbe,
        {"port": "run/probe", "baud": 38400, "response": "3 ms"}
        | {"threshold": "0.01 mm", "release": "0.005 mm", "free": "1 mm"},
        _poll("15 ms", "0.3 mm/s"),
    ),
}
ALONE: Final = [(laser, "adam-6052") for laser in LASERS] + [("optoncdt-1420", probe) for probe in PROBES]


def _in_place_of(bench: str, until: str, driver: str, other: Other) -> tuple[tuple[str, str], ...]:
    """Edits that put another device where the bench has its own, of which the keys before `until` go."""
    text = (BENCH_BLOCK / "cell.toml").read_text()
    found = re.search(rf'driver = "{bench}".*?(?=^{until} = )', text, re.S | re.M)
    assert found is not None
    keys = {"driver": driver, **other.keys}
    table = "".join(
        f'{key} = "{value}"\n' if isinstance(value, str) else f"{key} = {value}\n"
        for key, value in keys.items()
    )
    return ((found[0], table), *other.edits)


@pytest.mark.parametrize(
    ("laser", "probe"),
    [
        ("riftek-binary", "wago-750-337"),
        *[pytest.param(*pair, marks=pytest.mark.campaign) for pair in ALONE],
    ],
)
def test_the_job_is_done_and_released(tmp_path: Path, laser: str, probe: str) -> None:
    edits = list[tuple[str, str]]()
    if laser in LASERS:
        edits += _in_place_of("optoncdt-1420", "rate", laser, LASERS[laser])
    if probe in PROBES:
        edits += _in_place_of("adam-6052", "poll_period", probe, PROBES[probe])
    cell = DeterministicCell(cell_path=edited_cell(tmp_path, *edits))
    assert laser not in LASERS or isinstance(cell.devices.laser, LASERS[laser].driver)
    assert probe not in PROBES or isinstance(cell.devices.probe, PROBES[probe].driver)
    state = cell.run()
    print(f"{laser}, {probe}: {state.value}", {p: r.verdict for p, r in cell.results().items()})
    assert state is State.COMPLETED
    assert cell.released
    cell.close()
