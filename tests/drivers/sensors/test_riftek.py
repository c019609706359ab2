"""The RIFTEK drivers on the simulated head, in virtual time: right values, and what makes them refuse."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.capabilities import RangeSensor
from drivers.sensors.riftek import RiftekLaser
from drivers.sensors.riftek_ascii import RiftekAsciiLaser
from drivers.sensors.riftek_modbus import RiftekModbusLaser
from drivers.sensors.riftek_settings import RiftekConfig
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray
from simulators.sensors.riftek import Rf60x
from simulators.sensors.riftek_head import ASCII, BINARY, HOLD, MODBUS_RTU, RiftekSpec
from simulators.virtual import VirtualByteLink, VirtualClock

CONFIG = RiftekConfig(base_m=0.080, range_m=0.050, serial_number="17185", noise_m=1e-5)
DRIVERS = {BINARY: RiftekLaser, MODBUS_RTU: RiftekModbusLaser, ASCII: RiftekAsciiLaser}


class Target:
    """At `m` metres; nothing there if nan."""

    def __init__(self) -> None:
        self.m = 0.1

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return np.full(len(times_s), self.m)


class Bench:
    """A driver and a head on one line."""

    def __init__(self, protocol: int = BINARY, config: RiftekConfig = CONFIG, **spec: object) -> None:
        self.clock, self.target = VirtualClock(), Target()
        settings: dict[str, object] = {"noise_m": 1e-5, "protocol": protocol} | spec
        rng = np.random.default_rng(5)
        self.head = Rf60x(RiftekSpec(**settings), self.target, 0.0, 0.0, rng)  # type: ignore[arg-type]
        self.link = VirtualByteLink("laser", self.clock, lambda: self.head)
        self.laser: RangeSensor = DRIVERS[protocol](self.link, config, self.clock)

    def measure(self, minimum: int = 20) -> FloatArray:
        self.laser.begin_window()
        return self.laser.end_window(minimum).distance_m


@pytest.fixture(params=[BINARY, MODBUS_RTU, ASCII], ids=["binary", "modbus", "ascii"])
def bench(request: pytest.FixtureRequest) -> Bench:
    bench = Bench(request.param)
    bench.laser.connect()
    return bench


def test_identity_and_distances(bench: Bench) -> None:
    identity = bench.laser.connect()
    assert (identity.model, identity.serial_number) == ("RIFTEK type 63", "17185")
    assert dict(identity.settings)["range_mm"] == "50"
    distances = bench.measure()
    assert len(distances) >= 20
    assert float(np.mean(distances)) == pytest.approx(0.1, abs=1e-5)
    assert bench.laser.health().bad_frames == 0 and bench.laser.health().reconnects == 1


def test_a_window_holds_nothing_measured_before_it(bench: Bench) -> None:
    bench.measure()
    bench.clock.sleep(1.0)
    bench.target.m = 0.12
    assert bench.measure() == pytest.approx(0.12, abs=1e-4)


def test_no_target_is_rejected_in_words(bench: Bench) -> None:
    bench.target.m = float("nan")
    bench.clock.sleep(1.0)
    bench.laser.begin_window()
    window = bench.laser.end_window(10)
    assert len(window.distance_m) == 0 and window.rejected >= 10
    assert window.rejected_kinds == ("no target",)


def test_a_frozen_head_is_noticed(bench: Bench) -> None:
    bench.head._noise_m = 0.0
    with pytest.raises(DeviceError, match=r"frozen at 100\.\d\d\d mm: \d+ identical"):
        bench.measure(30)


def test_silence_is_a_timeout_and_a_new_connection_heals_it(bench: Bench) -> None:
    bench.link.faults.add("drop")
    with pytest.raises(DeviceTimeout):
        bench.measure()
    bench.link.faults.clear()
    bench.laser.connect()
    assert bench.measure() == pytest.approx(0.1, abs=1e-4)
    assert bench.laser.health().timeouts == 1


def test_a_head_that_restarted_is_silent_until_connected_again(bench: Bench) -> None:
    bench.head.restart(bench.clock.now_s())
    with pytest.raises(DeviceError):
        bench.measure()
    bench.clock.sleep(2.0)
    bench.laser.connect()
    assert bench.measure() == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (replace(CONFIG, serial_number="4711"), "serial number is 17185, the cell file says 4711"),
        (replace(CONFIG, range_m=0.1), "range is 50 mm, the cell file says 100 mm"),
        (replace(CONFIG, base_m=0.06), "base distance is 80 mm, the cell file says 60 mm"),
    ],
)
@pytest.mark.parametrize("protocol", DRIVERS)
def test_another_head_is_refused(protocol: int, config: RiftekConfig, said: str) -> None:
    with pytest.raises(IdentityMismatch, match=said):
        Bench(protocol, config).laser.connect()


@pytest.mark.parametrize("protocol", [MODBUS_RTU, ASCII])
def test_a_late_answer_is_never_the_value_of_the_next_question(protocol: int) -> None:
    bench = Bench(protocol)
    bench.laser.connect()
    bench.link.faults.add("late", 0.15)
    with pytest.raises(DeviceTimeout):
        bench.measure()
    bench.link.faults.clear()
    bench.target.m = 0.11
    assert bench.measure(40) == pytest.approx(0.11, abs=1e-4)


@pytest.mark.parametrize("protocol", [MODBUS_RTU, ASCII])
def test_another_head_behind_the_line_is_found_after_a_failure(protocol: int) -> None:
    bench = Bench(protocol)
    bench.laser.connect()
    bench.link.faults.add("late", 0.15)
    with pytest.raises(DeviceTimeout):
        bench.measure()
    bench.link.faults.clear()
    bench.head.spec = replace(bench.head.spec, serial_number=1)
    for _ in range(2):
        with pytest.raises(IdentityMismatch, match="serial number is 1"):
            bench.measure()


def test_bytes_before_an_answer_are_refused(bench: Bench) -> None:
    bench.link.faults.add("garbage", payload=b"\x17\x99", once=True)
    if isinstance(bench.laser, RiftekLaser):
        assert bench.measure() == pytest.approx(0.1, abs=1e-4)  # a stream finds its packets again
        return
    with pytest.raises((FrameError, DeviceTimeout)):
        bench.measure()
    assert bench.measure() == pytest.approx(0.1, abs=1e-4)


def test_a_stream_left_over_is_stopped_first() -> None:
    bench = Bench()
    bench.head.start_stream(0.0)
    bench.clock.sleep(3.0)
    bench.laser.connect()
    assert bench.measure() == pytest.approx(0.1, abs=1e-4)


def test_result_hold_is_switched_off_and_read_back() -> None:
    for protocol in (BINARY, MODBUS_RTU):
        bench = Bench(protocol)
        bench.laser.connect()
        assert bench.head.parameters[HOLD] == 0


def test_a_setting_that_is_not_taken_over_is_refused() -> None:
    bench = Bench(BINARY)
    bench.head.settings_changed = lambda: bench.head.parameters.update({HOLD: 2})  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="parameter 10h is 2 after 0 was written"):
        bench.laser.connect()


def test_a_rate_that_the_line_cannot_carry_is_refused() -> None:
    with pytest.raises(DeviceError, match="1000 results/s need 44000 baud, the line has 9600"):
        Bench(BINARY, replace(CONFIG, rate_hz=1000.0)).laser.connect()


def test_windows_in_a_row_are_a_stream_without_gaps() -> None:
    bench = Bench()
    bench.laser.connect()
    bench.laser.begin_window()
    bench.laser.end_window(1)
    config = replace(CONFIG, stale_s=0.0)
    bench.laser._config = config  # type: ignore[attr-defined]
    start = bench.head._packets
    got = sum(len(bench.laser.end_window(50).distance_m) for _ in range(40))
    assert bench.head._packets - start - got in (-1, 0, 1)
    assert bench.laser.health().bad_frames == 0


def test_where_register_one_lies_is_a_setting() -> None:
    bench = Bench(MODBUS_RTU, replace(CONFIG, first_register=0), first_register=0)
    bench.laser.connect()
    assert bench.measure() == pytest.approx(0.1, abs=1e-4)
