"""The laser driver against a scripted sensor in virtual time."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drivers.sensors.optoncdt import LaserConfig, OptoncdtLaser
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from tests.drivers.fakes import FakeByteLink, VirtualClock

CONFIG = LaserConfig(
    range_m=0.100, range_start_m=0.050, model="ILD1420-100", serial_number="1420100", noise_m=1e-5
)
INFO = "Name: ILD1420-100\r\nSerial: 1420100\r\nMeasuring range: 100.00 mm\r\nVersion: 004.093"


def encode(code: int) -> bytes:
    return bytes([code & 63, 64 | code >> 6 & 63, 128 | code >> 12 & 63])


class FakeSensor(FakeByteLink):
    """Answers commands; once told OUTPUT RS422, sends `codes` of one block every 10 ms."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__(clock)
        self.on_write = self._answer
        self.info, self.refuse, self.mute, self.deaf = INFO, "", False, 0
        self.streaming, self._next_s = False, math.inf
        self.rng = np.random.default_rng(7)
        self.codes: Callable[[], list[int]] = self._noise

    def _noise(self) -> list[int]:
        return [int(code) for code in 32760 + self.rng.integers(-8, 9, 20)]

    def _answer(self, data: bytes) -> None:
        command = data.decode().strip()
        if self.deaf:
            self.deaf -= 1
            return
        if command == "OUTPUT NONE":
            self.streaming, self._next_s = False, math.inf
        text = INFO_HEAD + self.info if command == "GETINFO" else command
        if self.refuse and command.startswith(self.refuse):
            text += "\r\nE210 Value out of range"
        self.later(0.001, (text + "\r\n->").encode())
        if command == "OUTPUT RS422":
            self.streaming, self._next_s = True, self.clock.time_s + 0.011

    def read(self, timeout_s: float) -> bytes:
        now, until = self.clock.time_s, self.clock.time_s + timeout_s
        while (
            self.streaming
            and not self.mute
            and (self._next_s <= now or (self._next_s <= until and not self._events))
        ):
            self.later(self._next_s - now, b"".join(map(encode, self.codes())))
            self._next_s += 0.010
        return super().read(timeout_s)


INFO_HEAD = "GETINFO\r\n"


def connected(config: LaserConfig = CONFIG) -> tuple[OptoncdtLaser, FakeSensor, VirtualClock]:
    clock = VirtualClock()
    link = FakeSensor(clock)
    laser = OptoncdtLaser(link, config, clock)
    laser.connect()
    link._events.clear()  # what comes next is up to the test
    return laser, link, clock


def test_connect_silences_compares_configures_and_starts() -> None:
    clock = VirtualClock()
    link = FakeSensor(clock)
    link.streaming, link._next_s = True, clock.time_s  # left over from an earlier session
    link.deaf = 2
    identity = OptoncdtLaser(link, CONFIG, clock).connect()
    assert (identity.model, identity.serial_number, identity.firmware) == (
        "ILD1420-100",
        "1420100",
        "004.093",
    )
    assert [line.decode().strip() for line in link.sent] == [
        "OUTPUT NONE", "OUTPUT NONE", "OUTPUT NONE",
        "GETINFO", "MEASRATE 2", "OUTREDUCEDEVICE NONE", "OUTADD_RS422 NONE", "MASTERMV NONE",
        "OUTPUT RS422",
    ]  # fmt: skip


def test_a_window_holds_what_was_measured_in_it() -> None:
    laser, link, clock = connected()
    clock.sleep(1.0)
    link.codes = lambda: list(range(10_000, 10_020))
    laser.begin_window()
    began_s = clock.time_s
    readings = laser.end_window(50)
    assert len(readings.distance_m) >= 50
    assert readings.rejected == 0
    assert readings.distance_m[:20] == pytest.approx(
        0.050 + (np.arange(10_000, 10_020) * 102 / 65520 - 1) / 100 * 0.1, abs=1e-9
    )
    assert np.all(np.diff(readings.time_s) > 0)
    assert readings.time_s[-1] <= clock.time_s
    assert clock.time_s - began_s < 0.1


def test_error_values_are_counted_with_their_kind_and_never_scaled() -> None:
    laser, link, _ = connected()
    link.codes = lambda: [30_000, 262077, 30_010, 262077, 100, 30_020]
    laser.begin_window()
    readings = laser.end_window(6)
    assert readings.rejected == len(readings.distance_m)
    assert readings.rejected_kinds == ("before the measuring range", "peak before the range")
    assert np.all((readings.distance_m > 0.09) & (readings.distance_m < 0.10))


def test_a_window_of_error_values_only_is_empty_not_an_error() -> None:
    laser, link, _ = connected()
    link.codes = lambda: [262076] * 20
    laser.begin_window()
    readings = laser.end_window(20)
    assert readings.distance_m.size == 0 and readings.rejected >= 20
    assert readings.rejected_kinds == ("no peak",)


def test_distances_outside_the_working_range_are_rejected() -> None:
    laser, link, _ = connected(replace(CONFIG, working_range_m=(0.055, 0.090)))
    link.codes = lambda: [30_000, 10_000]
    laser.begin_window()
    readings = laser.end_window(10)
    assert np.all(readings.distance_m < 0.090)
    assert readings.rejected_kinds == ("outside the working range of 55 to 90 mm",)


def test_silence_is_a_timeout_within_a_quarter_second() -> None:
    laser, link, clock = connected()
    link.mute = True
    clock.sleep(0.1)
    laser.begin_window()
    began_s = clock.time_s
    with pytest.raises(DeviceTimeout, match=r"no value for 0\.25 s\. Check cable and power"):
        laser.end_window(10)
    assert clock.time_s - began_s < 0.27


def test_unreadable_bytes_are_a_frame_error() -> None:
    laser, link, _ = connected()
    laser.begin_window()
    link.mute = True
    for delay_ms in range(300):
        link.later(delay_ms * 1e-3, b"\xff\xff\xff")
    with pytest.raises(FrameError, match=r"unreadable bytes and no value in 0\.25 s"):
        laser.end_window(10)
    assert laser.health().bad_frames > 100


def test_a_frozen_value_is_refused_where_the_noise_makes_it_improbable() -> None:
    laser, link, _ = connected()
    link.codes = lambda: [32760] * 20
    laser.begin_window()
    with pytest.raises(DeviceError, match=r"frozen at 10[0-9.]+ mm: \d+ identical values"):
        laser.end_window(40)
    quiet, link, _ = connected(replace(CONFIG, noise_m=0.0))
    link.codes = lambda: [32760] * 20
    quiet.begin_window()
    assert quiet.end_window(40).rejected == 0


@pytest.mark.parametrize(
    ("info", "message"),
    [
        (INFO.replace("1420100", "1420999"), "serial number is 1420999, the cell file says 1420100"),
        (INFO.replace("100.00 mm", "50.00 mm"), "measuring range is 50.00 mm, the cell file says 100 mm"),
        (INFO.replace("ILD1420-100", "ILD1420-50"), "model is ILD1420-50, the cell file says ILD1420-100"),
        ("Name: ILD1420-100", "serial number is not told"),
    ],
)
def test_another_sensor_than_calibrated_is_refused(info: str, message: str) -> None:
    clock = VirtualClock()
    link = FakeSensor(clock)
    link.info = info
    with pytest.raises(IdentityMismatch, match=message):
        OptoncdtLaser(link, CONFIG, clock).connect()


def test_wrong_baud_rate_and_dead_line_are_told_apart() -> None:
    clock = VirtualClock()
    link = FakeSensor(clock)
    link.on_write = lambda data: link.later(0.001, b"\xf0\x80\xff\xfe")
    with pytest.raises(FrameError, match="no valid answer at 921600 8N1, but 12 unreadable bytes"):
        OptoncdtLaser(link, CONFIG, clock).connect()
    link.on_write = lambda data: None
    with pytest.raises(DeviceTimeout, match="no valid answer at 921600 8N1"):
        OptoncdtLaser(link, CONFIG, clock).connect()


def test_a_refused_command_is_told_with_the_words_of_the_sensor() -> None:
    clock = VirtualClock()
    link = FakeSensor(clock)
    link.refuse = "MEASRATE"
    with pytest.raises(DeviceError, match="refused MEASRATE 2: E210 Value out of range"):
        OptoncdtLaser(link, CONFIG, clock).connect()


def test_a_rate_that_the_line_cannot_carry_is_refused() -> None:
    clock = VirtualClock()
    with pytest.raises(DeviceError, match="240000 baud, the line has 115200"):
        OptoncdtLaser(FakeSensor(clock), replace(CONFIG, rate_hz=8000.0, baud=115200), clock).connect()


def test_close_switches_the_stream_off_and_is_safe_twice() -> None:
    laser, link, _ = connected()
    laser.close()
    laser.close()
    assert link.sent[-1] == b"OUTPUT NONE\n" and not link.streaming
    with pytest.raises(DeviceError, match="not connected"):
        laser.begin_window()
