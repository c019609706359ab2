"""The DL-RS1A driver on the simulated unit, in virtual time; the manual's lines and traps."""

import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.probes.dlrs1a import GaugePress
from drivers.probes.threshold import ThresholdConfig, ThresholdProbe
from drivers.sensors import dlrs1a_codec as codec
from drivers.sensors.dlrs1a import DlRs1a, DlRs1aConfig
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray
from simulators.sensors.dlrs1a import Amplifier, AmplifierSpec
from simulators.sensors.dlrs1a import DlRs1a as SimulatedUnit
from simulators.virtual import VirtualByteLink, VirtualClock

IL = DlRs1aConfig(head="IL", zero_m=0.1, towards=True, response_s=0.01, noise_m=2e-6)
GT2 = DlRs1aConfig(head="GT2", response_s=0.003, baud=38400)
GAUGE = AmplifierSpec(kind="GT2", zero_m=0.0, span_m=0.012, towards=False, response_s=0.003)


class Target:
    """At `m` metres; nothing there if nan; moving from an instant on if it has a speed."""

    def __init__(self, m: float) -> None:
        self.m, self.m_s, self.from_s = m, 0.0, 0.0

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return self.m + self.m_s * np.maximum(times_s - self.from_s, 0.0)


class Bench:
    """Driver, line and unit with some amplifiers of one kind."""

    def __init__(self, config: DlRs1aConfig, spec: AmplifierSpec, m: float, amplifiers: int = 1) -> None:
        self.clock, self.target = VirtualClock(), Target(m)
        rng = np.random.default_rng(4)
        heads = [Amplifier(spec, self.target, 0.0, 0.0, rng) for _ in range(amplifiers)]
        self.unit = SimulatedUnit(heads, config.baud, config.data_bits)
        self.link = VirtualByteLink("laser", self.clock, lambda: self.unit)
        self.gauge = DlRs1a(self.link, config, self.clock)

    def measure(self, minimum: int = 5) -> FloatArray:
        self.gauge.begin_window()
        return self.gauge.end_window(minimum).distance_m


@pytest.fixture
def laser() -> Bench:
    bench = Bench(IL, AmplifierSpec(noise_m=2e-6), 0.11)
    bench.gauge.connect()
    return bench


def test_values_of_the_manual() -> None:
    assert codec.parse_all(b"M0,+012.3456") == ["+012.3456"]
    assert codec.parse_value("+012.3456") == pytest.approx(12.3456e-3)
    assert codec.parse_item(b"SR,01,134,1", b"SR,01,134") == "1"
    with pytest.raises(DeviceError, match=r"refused SR,06,101: no such amplifier \(65\)"):
        codec.parse_item(b"ER,SR,65", b"SR,06,101")


@pytest.mark.parametrize(
    "data", ["+EE.EEE", "+99.999", "-99.999", "-99.998", "+999.9999", "-999.9998", "", "12.345", "+1.2"]
)
def test_what_is_no_measured_value(data: str) -> None:
    assert codec.parse_value(data) is None


@given(st.integers(-9_998_999, 9_998_999))
def test_any_value_in_between_is_read_as_it_stands(steps: int) -> None:
    value = codec.parse_value(f"{steps / 1e4:+09.4f}")
    assert value == pytest.approx(steps * 1e-7, abs=1e-12)


@given(st.binary(max_size=40))
def test_any_line_is_read_or_refused(line: bytes) -> None:
    for parse in (lambda: codec.parse_item(line, b"SR,00,002"), lambda: codec.parse_all(line)):
        with contextlib.suppress(DeviceError):
            parse()


def test_distance_of_a_laser(laser: Bench) -> None:
    identity = laser.gauge.connect()
    assert identity.settings == (("head", "IL"), ("amplifier", "0"))
    assert laser.measure() == pytest.approx(0.11, abs=1e-5)


def test_position_of_a_gauge() -> None:
    bench = Bench(replace(GT2, amplifiers=3, amplifier=2), GAUGE, 0.0050001, amplifiers=3)
    bench.gauge.connect()
    assert bench.measure() == pytest.approx(0.0050001, abs=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_a_lost_digit_is_found_by_the_width_of_the_value(seed: int) -> None:
    bench = Bench(GT2, GAUGE, 0.0050001)
    bench.gauge.connect()
    bench.link.faults.reseed(seed)
    bench.link.faults.add("lose-byte", chance=0.1)
    for _ in range(5):
        with contextlib.suppress(FrameError, DeviceTimeout, IdentityMismatch):
            assert bench.measure(3) == pytest.approx(0.0050001, abs=1e-9)


def test_every_value_was_measured_after_the_window_began(laser: Bench) -> None:
    laser.target.m, laser.target.m_s = 0.09, 1e-3
    laser.clock.sleep(1.0)
    begun_s = laser.clock.now_s()
    assert laser.measure().min() >= 0.09 + 1e-3 * begun_s - 5e-6


def test_a_held_value_is_not_taken_for_a_live_one() -> None:
    bench = Bench(IL, AmplifierSpec(hold=True), 0.11)
    bench.gauge.connect()
    bench.target.m = 0.105
    bench.clock.sleep(1.0)
    assert bench.measure() == pytest.approx(0.105)


def test_nothing_seen_and_out_of_range_are_no_values(laser: Bench) -> None:
    for laser.target.m in (math.nan, 0.2, 0.01):
        laser.clock.sleep(1.0)
        laser.gauge.begin_window()
        window = laser.gauge.end_window(3)
        assert (len(window.distance_m), window.rejected) == (0, 3)
        assert window.rejected_kinds == ("no target, or out of range",)


def test_an_amplifier_in_error_is_refused_at_connect_and_gives_no_value(laser: Bench) -> None:
    laser.unit.amplifiers[0].error_bits = 33
    laser.gauge.begin_window()
    assert laser.gauge.end_window(1).rejected == 1
    with pytest.raises(DeviceError, match="error bits 00033"):
        laser.gauge.connect()


def test_another_number_of_amplifiers_is_refused() -> None:
    with pytest.raises(IdentityMismatch, match="with 2 amplifiers, the cell file says 1"):
        Bench(IL, AmplifierSpec(), 0.11, amplifiers=2).gauge.connect()
    with pytest.raises(DeviceError, match="no such amplifier"):
        Bench(replace(IL, amplifier=3), AmplifierSpec(), 0.11).gauge.connect()


def test_a_loose_plug_is_found_after_a_failure() -> None:
    bench = Bench(replace(IL, amplifiers=2), AmplifierSpec(), 0.11, amplifiers=2)
    bench.gauge.connect()
    bench.link.faults.add("lose-byte", once=True)
    with pytest.raises(DeviceError):
        bench.measure()
    bench.unit.amplifiers.pop()
    with pytest.raises(IdentityMismatch, match="with 1 amplifiers"):
        bench.measure()


def test_a_late_answer_is_not_that_to_the_next_question(laser: Bench) -> None:
    laser.link.faults.add("late", 1.1)
    with pytest.raises(DeviceTimeout):
        laser.measure()
    laser.link.faults.clear()
    laser.target.m = 0.09
    assert laser.measure() == pytest.approx(0.09, abs=1e-5)


def test_an_answer_to_another_question_is_refused(laser: Bench) -> None:
    laser.link.faults.add("garbage", payload=b"SR,01,038,+00.000\r\n", once=True)
    with pytest.raises(FrameError):
        laser.measure()
    assert laser.measure() == pytest.approx(0.11, abs=1e-5)


def test_a_gauge_is_a_probe_that_trips_when_it_is_pressed() -> None:
    bench = Bench(GT2, GAUGE, 0.001)
    limits = ThresholdConfig(2e-5, 1e-5, free_limit=0.002, unit="m", period_s=0.02, latency_s=0.02)
    probe = ThresholdProbe(GaugePress(bench.gauge, bench.clock, 0.003), limits, bench.clock)
    probe.connect()
    probe.arm()
    assert probe.is_open() and probe.touched_at_s() is None
    bench.target.m_s, bench.target.from_s = 1e-3, bench.clock.now_s() + 0.5
    while (touched_s := probe.touched_at_s()) is None:
        pass
    assert 0.0 <= touched_s - (bench.target.from_s + 0.02) <= probe.poll_uncertainty_s
    assert not probe.is_open()
    bench.target.m, bench.target.m_s = 0.005, 0.0
    with pytest.raises(DeviceError, match=r"shows 0\.005 m before the approach, limit 0\.002 m"):
        probe.arm()
    bench.target.m = math.nan
    with pytest.raises(DeviceError, match="gives no value"):
        probe.is_open()
