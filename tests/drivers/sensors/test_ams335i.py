"""The AMS 335i driver on the simulated sensor, in virtual time."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.sensors.ams335i import Ams335i, AmsConfig
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch
from estimation.transform import FloatArray
from simulators.sensors.ams335i import Ams335i as SimulatedAms
from simulators.sensors.ams335i import AmsSpec
from simulators.virtual import VirtualCanLink, VirtualClock

CONFIG = AmsConfig(node=16, serial_number="335001")


class Target:
    """At `m` metres; nothing there if nan; moving if it has a speed."""

    def __init__(self) -> None:
        self.m, self.m_s = 12.3456, 0.0

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return self.m + self.m_s * times_s


class Bench:
    """Driver, bus and sensor."""

    def __init__(self, config: AmsConfig = CONFIG, **spec: object) -> None:
        self.clock, self.target = VirtualClock(), Target()
        rng = np.random.default_rng(2)
        self.sensor = SimulatedAms(AmsSpec(**spec), self.target, 0.0, 0.0, rng)  # type: ignore[arg-type]
        self.link = VirtualCanLink("laser", self.clock, self.sensor)
        self.laser = Ams335i(self.link, config, self.clock)

    def measure(self, minimum: int = 10) -> FloatArray:
        self.laser.begin_window()
        return self.laser.end_window(minimum).distance_m


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    bench.laser.connect()
    return bench


def test_identity_and_distances(bench: Bench) -> None:
    identity = bench.laser.connect()
    assert (identity.model, identity.serial_number) == ("AMS335i", "335001")
    assert bench.measure() == pytest.approx(12.3456, abs=1e-9)


def test_every_value_was_measured_after_the_window_began(bench: Bench) -> None:
    bench.target.m, bench.target.m_s = 5.0, 0.01
    bench.clock.sleep(1.0)
    begun_s = bench.clock.now_s()
    distances = bench.measure()
    assert distances.min() >= 5.0 + 0.01 * begun_s
    assert np.all(np.diff(distances) >= 1e-4)


def test_a_broken_beam_is_no_value_at_once(bench: Bench) -> None:
    """By default the device repeats the last good position for 100 ms and hides that it does."""
    bench.target.m = math.nan
    bench.laser.begin_window()
    window = bench.laser.end_window(3)
    assert len(window.distance_m) == 0 and window.rejected == 3
    assert window.rejected_kinds == ("implausible value",)


def test_a_laser_that_is_off_gives_no_value(bench: Bench) -> None:
    bench.sensor.extra_status = 1 << 8
    bench.laser.begin_window()
    assert bench.laser.end_window(1).rejected_kinds == ("laser off",)
    bench.sensor.extra_status = 1 << 9
    bench.laser.begin_window()
    assert bench.laser.end_window(1).rejected_kinds == ("preset active",)
    bench.sensor.extra_status = 1 << 13  # a weak signal is still one
    assert len(bench.measure(1)) == 1


def test_a_zero_instead_of_a_value_is_none_whatever_the_status_says(bench: Bench) -> None:
    bench.target.m = math.nan
    bench.sensor.values[0x2070, 0] = 1 | 4 | 8  # hidden again, by whoever else is on the bus
    bench.sensor._good = 0
    bench.clock.sleep(0.05)
    bench.sensor._good_s = bench.clock.now_s()
    bench.laser.begin_window()
    assert bench.laser.end_window(1).rejected_kinds == ("position zero or below",)


def test_a_late_answer_is_not_that_to_the_next_sync(bench: Bench) -> None:
    bench.link.faults.add("late", 0.06)
    with pytest.raises(DeviceTimeout, match=r"no answer to SYNC within 0\.05 s"):
        bench.measure(1)
    bench.link.faults.clear()
    bench.target.m = 3.0
    assert bench.measure() == pytest.approx(3.0)


def test_a_doubled_answer_is_not_that_to_the_next_sync(bench: Bench) -> None:
    bench.target.m_s = 1.0
    bench.link.faults.add("duplicate")
    assert np.all(np.diff(bench.measure()) > 0.01)


def test_a_sensor_that_restarts_is_a_failure_until_connected_again(bench: Bench) -> None:
    bench.sensor.restart(bench.clock.now_s())
    bench.clock.sleep(1.0)
    with pytest.raises(DeviceError, match="node 16 has restarted"):
        bench.measure()
    bench.laser.connect()
    assert bench.measure() == pytest.approx(12.3456)


def test_a_frozen_sensor_is_noticed() -> None:
    bench = Bench(replace(CONFIG, noise_m=1e-3), noise_m=1e-3)
    bench.laser.connect()
    bench.measure(40)
    bench.sensor._measure = lambda time_s: (123_456, 0)  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"frozen at 12345\.600 mm"):
        bench.measure(40)


def test_another_sensor_or_direction_is_refused() -> None:
    with pytest.raises(IdentityMismatch, match="serial number 7, expected is 335001"):
        Bench(serial_number=7).laser.connect()
    bench = Bench()
    bench.sensor.values[0x6000, 0] = 8
    with pytest.raises(DeviceError, match="counting direction is reversed"):
        bench.laser.connect()
