"""The FT 300 driver on the simulated sensor, in virtual time; frames of the manual in both directions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.probes.ft300 import Ft300Press
from drivers.probes.threshold import ThresholdConfig, ThresholdProbe
from drivers.sensors import ft300_codec as codec
from drivers.sensors.ft300 import Ft300, Ft300Config
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray
from simulators.modbus_slave import crc
from simulators.sensors.ft300 import Ft300 as SimulatedFt300
from simulators.sensors.ft300 import Ft300Spec
from simulators.virtual import VirtualByteLink, VirtualClock

WRENCH = np.array([12.34, -5.67, 98.76, 0.123, -0.456, 1.000])
FRAME = bytes.fromhex("20 4E D2 04 C9 FD 94 26 7B 00 38 FE E8 03 E2 E6")
ANY = Ft300Config()
LIMITS = ThresholdConfig(2.0, 1.0, free_limit=20.0, unit="N", period_s=0.01, latency_s=0.02)


class Load:
    """The same all the time, or with a force added from an instant on."""

    def __init__(self) -> None:
        self.wrench, self.pressed_n, self.from_s = np.zeros(6), np.zeros(3), np.inf

    def wrenches(self, times_s: FloatArray) -> FloatArray:
        wrenches = np.tile(self.wrench, (len(times_s), 1))
        wrenches[times_s >= self.from_s, :3] += self.pressed_n
        return wrenches


class Bench:
    """Driver, line and sensor."""

    def __init__(self, config: Ft300Config = ANY, **spec: object) -> None:
        self.clock, self.load = VirtualClock(), Load()
        rng = np.random.default_rng(3)
        self.sensor = SimulatedFt300(Ft300Spec(**spec), self.load, rng)  # type: ignore[arg-type]
        self.link = VirtualByteLink("probe", self.clock, lambda: self.sensor)
        self.driver = Ft300(self.link, config, self.clock)
        self.probe = ThresholdProbe(Ft300Press(self.driver), LIMITS, self.clock)
        self.clock.sleep(2.0)


@pytest.fixture
def bench() -> Bench:
    bench = Bench(Ft300Config(serial_number="FTD-0417"))
    bench.driver.connect()
    return bench


def test_a_stream_frame_of_the_manual() -> None:
    assert codec.StreamDecoder().feed(FRAME) == pytest.approx(WRENCH[None, :])


def test_registers_of_the_manual() -> None:
    assert codec.wrench([0x04D2, 0xFDC9, 0x2694, 0x007B, 0xFE38, 0x03E8]) == pytest.approx(WRENCH)


@given(
    st.lists(st.integers(-32768, 32767), min_size=6, max_size=60), st.integers(1, 40), st.binary(max_size=20)
)
def test_frames_are_found_however_they_are_split_and_whatever_comes_before(
    counts: list[int], size: int, before: bytes
) -> None:
    groups = [counts[at : at + 6] for at in range(0, len(counts) - 5, 6)]
    bodies = [b"\x20\x4e" + b"".join(c.to_bytes(2, "little", signed=True) for c in group) for group in groups]
    wire = before + b"".join(body + crc(body) for body in bodies)
    decoder, got = codec.StreamDecoder(), list[list[float]]()
    for at in range(0, len(wire), size):
        got += (decoder.feed(wire[at : at + size]) * codec.PER_UNIT).round().tolist()
    assert got == groups


def test_a_header_inside_of_a_frame_does_not_mislead() -> None:
    body = b"\x20\x4e" + b"\x20\x4e" * 6  # six times 20000
    decoder = codec.StreamDecoder()
    assert len(decoder.feed((body + crc(body))[3:] + body + crc(body))) == 1
    assert len(decoder.feed(body + b"\0\0" + FRAME)) == 1
    assert decoder.bad_bytes == 16


def test_identity_and_forces(bench: Bench) -> None:
    identity = bench.driver.connect()
    assert (identity.serial_number, identity.firmware) == ("FTD-0417", "FTS-V1.2.3")
    bench.load.wrench = WRENCH
    bench.driver.begin_window()
    window = bench.driver.end_window(10)
    assert window.force_n == pytest.approx(np.tile(WRENCH[:3], (len(window.force_n), 1)))
    assert window.torque_nm == pytest.approx(np.tile(WRENCH[3:], (len(window.force_n), 1)))
    assert np.diff(window.time_s) == pytest.approx(0.01, abs=1e-3)
    assert bench.driver.health().bad_frames == 0


def test_a_window_holds_nothing_measured_before_it(bench: Bench) -> None:
    bench.clock.sleep(1.0)
    bench.load.wrench = WRENCH
    bench.driver.begin_window()
    assert bench.driver.end_window(1).force_n[:, 0] == pytest.approx(12.34)


def test_a_stream_left_over_is_ended_first() -> None:
    bench = Bench(streams_at_power_on=True)
    assert bench.sensor.streaming
    assert bench.driver.connect().serial_number == "FTD-0417"


def test_an_acknowledge_that_drowns_in_the_stream_is_no_failure(bench: Bench) -> None:
    write = bench.sensor.write

    def drowned(address: int, words: list[int], time_s: float) -> None:
        write(address, words, time_s)
        bench.sensor._next = 1  # frames of long ago come together with the acknowledge

    bench.sensor.write = drowned  # type: ignore[method-assign, assignment]
    bench.driver.connect()
    bench.driver.begin_window()
    assert len(bench.driver.end_window(5).force_n) >= 5


def test_silence_is_a_timeout_and_a_new_connection_heals_it(bench: Bench) -> None:
    bench.sensor.restart(bench.clock.now_s())
    bench.driver.begin_window()
    with pytest.raises(DeviceTimeout, match=r"no valid frame for 0\.16 s"):
        bench.driver.end_window(10)
    bench.clock.sleep(2.0)
    bench.driver.connect()
    assert bench.driver.health().reconnects == 1


def test_unreadable_bytes_are_told_from_silence(bench: Bench) -> None:
    bench.link.faults.add("corrupt")
    bench.driver.begin_window()
    with pytest.raises(FrameError, match="unreadable bytes and no valid frame"):
        bench.driver.end_window(10)


def test_another_sensor_is_refused() -> None:
    with pytest.raises(IdentityMismatch, match="serial number is FTD-0417, the cell file says FTD-0001"):
        Bench(Ft300Config(serial_number="FTD-0001")).driver.connect()
    with pytest.raises(IdentityMismatch, match="calls its firmware 'XTS'"):
        Bench(firmware="XTS").driver.connect()


def test_a_touch_is_the_first_force_over_the_threshold_whatever_the_stylus_weighs(bench: Bench) -> None:
    bench.load.wrench = np.array([0, 0, -8.0, 0, 0, 0])
    probe = bench.probe
    probe.arm()
    assert probe.is_open()
    bench.load.pressed_n, bench.load.from_s = np.array([3.0, 0, 0]), bench.clock.now_s() + 0.5
    while (touched_s := probe.touched_at_s()) is None:
        pass
    assert 0.0 <= touched_s - bench.load.from_s <= probe.poll_uncertainty_s
    assert probe.touched_at_s() == touched_s
    assert not probe.is_open()
    bench.load.pressed_n = np.array([1.5, 0, 0])
    assert not probe.is_open()  # between release and threshold
    bench.load.pressed_n = np.zeros(3)
    assert probe.is_open()


def test_a_probe_that_is_pressed_before_the_approach_is_refused(bench: Bench) -> None:
    bench.load.wrench = np.array([0, 25.0, 0, 0, 0, 0])
    with pytest.raises(DeviceError, match="shows 25 N before the approach, limit 20 N"):
        bench.probe.arm()
    with pytest.raises(DeviceError, match="not armed"):
        bench.probe.touched_at_s()


def test_a_touch_between_values_far_apart_is_refused(bench: Bench) -> None:
    bench.probe.arm()
    bench.load.pressed_n, bench.load.from_s = np.array([0, 0, 5.0]), bench.clock.now_s()
    bench.clock.sleep(0.2)
    bench.link.discard_input()
    with pytest.raises(DeviceError, match=r"Touched between values 2\d\d ms apart, limit 100 ms"):
        while bench.probe.touched_at_s() is None:
            pass


def test_a_probe_that_falls_silent_during_an_approach_is_a_failure(bench: Bench) -> None:
    bench.probe.arm()
    bench.link.faults.add("drop")
    with pytest.raises(DeviceTimeout):
        for _ in range(100):
            bench.probe.touched_at_s()


def test_a_release_above_the_threshold_is_refused(bench: Bench) -> None:
    with pytest.raises(DeviceError, match="releases at 3 N, trips at 2"):
        ThresholdProbe(Ft300Press(bench.driver), ThresholdConfig(2.0, 3.0, 9.0, "N", 0.01, 0.02), bench.clock)
