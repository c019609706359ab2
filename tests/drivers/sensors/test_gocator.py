"""The Gocator driver on the simulated head, in virtual time."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.links.modbus_tcp import ModbusTcp
from drivers.sensors.gocator import Gocator, GocatorConfig
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch
from estimation.transform import FloatArray
from simulators.sensors.gocator import Gocator as SimulatedGocator
from simulators.sensors.gocator import GocatorSpec
from simulators.virtual import VirtualByteLink, VirtualClock
from tests.drivers.fakes import FakeByteLink
from tests.drivers.fakes import VirtualClock as FakeClock

CONFIG = GocatorConfig(zero_m=0.3, rate_hz=200.0, job="block")


class Target:
    """At `m` metres; nothing there if nan; moving if it has a speed."""

    def __init__(self) -> None:
        self.m, self.m_s = 0.287655, 0.0

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return self.m + self.m_s * times_s


class Bench:
    """Driver, connection and head."""

    def __init__(self, config: GocatorConfig = CONFIG, **spec: object) -> None:
        self.clock, self.target = VirtualClock(), Target()
        rng = np.random.default_rng(2)
        self.head = SimulatedGocator(GocatorSpec(**spec), self.target, 0.0, 0.0, rng)  # type: ignore[arg-type]
        self.link = VirtualByteLink("laser", self.clock, self.head.connect)
        self.laser = Gocator(self.link, config, self.clock)

    def measure(self, minimum: int = 10) -> FloatArray:
        self.laser.begin_window()
        return self.laser.end_window(minimum).distance_m


@pytest.fixture(params=[False, True], ids=["live", "buffered"])
def bench(request: pytest.FixtureRequest) -> Bench:
    bench = Bench(buffered=request.param)
    bench.laser.connect()
    return bench


def test_frames_of_the_manual() -> None:
    """Start, and a measurement with and without a value, byte for byte."""
    link = FakeByteLink(FakeClock())
    modbus = ModbusTcp(link, link.clock, name="Laser")
    link.on_write = lambda data: link.later(0.001, data)
    modbus.write_register(0, 1)
    link.on_write = lambda data: link.later(
        0.001, bytes.fromhex("00 02 00 00 00 09 01 03 06 00 00 30 39 00 01")
    )
    assert modbus.read_holding_registers(1000, 3) == [0, 12345, 1]
    assert link.sent == [
        bytes.fromhex("00 01 00 00 00 06 01 06 00 00 00 01"),
        bytes.fromhex("00 02 00 00 00 06 01 03 03 E8 00 03"),
    ]


def test_it_starts_the_head_and_measures(bench: Bench) -> None:
    identity = bench.laser.connect()
    assert identity.settings == (("job", "block"), ("measurement", "0"))
    assert bench.head.running
    assert bench.measure() == pytest.approx(0.287655, abs=1e-9)


def test_another_job_is_loaded_and_a_missing_one_refused() -> None:
    bench = Bench(replace(CONFIG, job="other"))
    bench.laser.connect()
    assert bench.head.job == "other" and bench.head.running
    with pytest.raises(IdentityMismatch, match="its job is 'block', not 'absent'"):
        Bench(replace(CONFIG, job="absent")).laser.connect()


def test_values_are_of_different_profiles_after_the_window_began(bench: Bench) -> None:
    bench.target.m, bench.target.m_s = 0.3, 1e-3
    bench.clock.sleep(5.0)  # a buffer is full of old results by now
    begun_s = bench.clock.now_s()
    distances = bench.measure()
    assert distances.min() >= 0.3 + 1e-3 * begun_s - 1e-6
    assert np.all(np.diff(distances) >= 4e-6)


def test_nothing_below_the_head_is_no_value(bench: Bench) -> None:
    bench.target.m = math.nan
    bench.laser.begin_window()
    window = bench.laser.end_window(3)
    assert (len(window.distance_m), window.rejected, window.rejected_kinds) == (0, 3, ("invalid value",))


def test_a_measurement_that_is_not_set_up_is_no_value() -> None:
    bench = Bench(replace(CONFIG, measurement=4))
    bench.laser.connect()
    bench.laser.begin_window()
    assert bench.laser.end_window(2).rejected == 2


def test_a_head_that_stands_is_noticed_by_its_frame_index(bench: Bench) -> None:
    bench.laser.begin_window()
    bench.head.running = False
    with pytest.raises(DeviceTimeout, match=r"no new profile for 0\.5 s, index \d+"):
        bench.laser.end_window(100)
    bench.laser.connect()
    assert len(bench.measure()) == 10


def test_another_job_after_a_failure_is_found(bench: Bench) -> None:
    bench.link.faults.add("late", 0.25)
    with pytest.raises(DeviceTimeout):
        bench.measure()
    bench.link.faults.clear()
    bench.head.job = "other"
    with pytest.raises(IdentityMismatch, match="its job is 'other', not 'block'"):
        bench.measure()


def test_a_start_that_was_refused_is_repeated_by_way_of_zero(bench: Bench) -> None:
    bench.head.running = False  # stopped on its own page; its command register is still at 1
    bench.laser.connect()
    assert bench.head.running


def test_a_head_that_boots_refuses_and_works_afterwards(bench: Bench) -> None:
    bench.head.restart(bench.clock.now_s())
    with pytest.raises(DeviceError):
        bench.measure()
    bench.clock.sleep(6.0)
    bench.laser.connect()
    assert len(bench.measure()) == 10


def test_a_measurement_out_of_reach_is_refused() -> None:
    with pytest.raises(DeviceError, match="Give the measurement an id of 0 to 33"):
        Bench(replace(CONFIG, measurement=34))


def test_away_from_the_head() -> None:
    bench = Bench(replace(CONFIG, towards=False))
    bench.laser.connect()
    assert bench.measure(1) == pytest.approx(0.312345)
