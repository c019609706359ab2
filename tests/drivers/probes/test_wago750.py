"""The WAGO probe driver on the simulated station, in virtual time."""

import pytest

from drivers.links.canopen_sdo import SdoAbort
from drivers.probes.wago750 import WagoConfig, WagoProbe
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch
from simulators.interfaces import Frame
from simulators.probes.wago750 import Wago750, WagoSpec
from simulators.virtual import VirtualCanLink, VirtualClock

CONFIG = WagoConfig(node=20, model="750-337")


class Contact:
    """Closes and opens at given instants."""

    def __init__(self) -> None:
        self.closed, self.changes = False, list[float]()

    def update(self, time_s: float) -> None:
        while self.changes and self.changes[0] <= time_s:
            self.closed = not self.closed
            self.changes.pop(0)

    def unchanged_until_s(self, time_s: float) -> float:
        self.update(time_s)
        return self.changes[0] if self.changes else float("inf")


class Bench:
    """Driver, bus and station."""

    def __init__(self, config: WagoConfig = CONFIG, **spec: object) -> None:
        self.clock, self.contact = VirtualClock(), Contact()
        self.station = Wago750(WagoSpec(**spec), self.contact)  # type: ignore[arg-type]
        self.link = VirtualCanLink("probe", self.clock, self.station)
        self.probe = WagoProbe(self.link, config, self.clock)

    def touch(self, after_s: float, for_s: float = 1.0) -> float:
        """The contact closes; returns when."""
        closes_s = self.clock.now_s() + after_s
        self.contact.changes = [closes_s, closes_s + for_s]
        return closes_s

    def wait(self) -> float:
        while (touched_s := self.probe.touched_at_s()) is None:
            pass
        return touched_s


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    bench.probe.connect()
    return bench


def test_identity(bench: Bench) -> None:
    identity = bench.probe.connect()
    assert identity.model == "750-337" and identity.settings == (("node", "20"), ("channel", "0"))
    assert bench.probe.health().reconnects == 1


def test_a_touch_is_seen_when_it_happens_however_short(bench: Bench) -> None:
    bench.probe.arm()
    assert bench.probe.is_open()
    bench.probe.arm()
    touched_s = bench.touch(0.1234, for_s=0.002)
    assert 0.0 <= bench.wait() - touched_s <= bench.probe.poll_uncertainty_s <= 0.02
    assert bench.probe.touched_at_s() == bench.wait()
    bench.clock.sleep(0.1)
    assert bench.probe.is_open()


def test_a_frame_of_a_touch_that_is_lost_is_repeated_by_the_event_timer(bench: Bench) -> None:
    bench.probe.arm()
    touched_s = bench.touch(0.1)
    bench.link.faults.add("drop", from_s=touched_s, until_s=touched_s + 0.005)
    late_s = bench.wait() - touched_s
    assert 0.005 <= late_s <= bench.probe.poll_uncertainty_s


def test_frames_that_lay_in_the_dongle_do_not_make_a_touch_look_fresh(bench: Bench) -> None:
    bench.probe.arm()
    touched_s = bench.touch(0.1)
    bench.link.faults.add("late", 0.05, from_s=touched_s - 0.045)  # those of before too: all come in a burst
    late_s = bench.wait() - touched_s
    assert 0.045 <= late_s <= bench.probe.poll_uncertainty_s <= 0.12


def test_an_input_that_is_not_told_is_a_failure(bench: Bench) -> None:
    bench.probe.arm()
    bench.station._sdo.answer = lambda data: b""  # type: ignore[method-assign]
    with pytest.raises(DeviceTimeout, match=r"not told within 0\.3 s"):
        bench.wait()


def test_a_touch_long_after_the_input_was_open_is_refused(bench: Bench) -> None:
    bench.probe.arm()
    touched_s = bench.touch(0.1, for_s=9.0)
    bench.link.faults.add("drop", from_s=touched_s, until_s=touched_s + 0.1)
    bench.clock.sleep(0.25)  # nobody could poll
    with pytest.raises(DeviceError, match=r"2\d\d ms after the input was last seen open, limit 100 ms"):
        bench.wait()


def test_a_station_that_falls_silent_is_a_failure(bench: Bench) -> None:
    bench.probe.arm()
    bench.link.faults.add("drop")
    with pytest.raises(DeviceTimeout, match=r"no frame for 0\.1 s"):
        bench.wait()


def test_a_station_that_restarts_is_a_failure_until_connected_again(bench: Bench) -> None:
    bench.probe.arm()
    bench.station.restart(bench.clock.now_s())
    bench.clock.sleep(1.0)
    with pytest.raises(DeviceError, match="node 20 has restarted"):
        bench.wait()
    with pytest.raises(DeviceError, match="restarted"):
        bench.probe.is_open()
    bench.probe.connect()
    assert bench.probe.is_open()


def test_frames_of_before_are_forgotten(bench: Bench) -> None:
    bench.touch(0.05, for_s=0.05)
    bench.clock.sleep(0.2)  # touched and released, and nobody has read it yet
    bench.probe.arm()
    assert bench.probe.touched_at_s() is None


def test_nobody_reads_for_minutes(bench: Bench) -> None:
    bench.clock.sleep(600.0)
    bench.probe.arm()
    touched_s = bench.touch(0.1)
    assert 0.0 <= bench.wait() - touched_s <= bench.probe.poll_uncertainty_s


def test_a_tripped_probe_cannot_be_armed(bench: Bench) -> None:
    bench.contact.closed = True
    with pytest.raises(DeviceError, match="tripped before the approach"):
        bench.probe.arm()
    assert not bench.probe.is_open()
    with pytest.raises(DeviceError, match="not armed"):
        bench.probe.touched_at_s()


def test_frames_of_other_nodes_mean_nothing(bench: Bench) -> None:
    bench.probe.arm()
    bench.station._output.append(Frame(0x195, b"\x01", bench.clock.now_s()))
    bench.station._output.append(Frame(0x294, b"\x01", bench.clock.now_s()))
    for _ in range(5):
        assert bench.probe.touched_at_s() is None


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ({"name": "750-338"}, "name 750-338, expected is 750-337"),
        ({"serial_number": 7}, "serial number 7, expected is 4711"),
    ],
)
def test_another_station_is_refused(spec: dict[str, object], said: str) -> None:
    config = WagoConfig(node=20, model="750-337", serial_number="4711" if "serial_number" in spec else "")
    with pytest.raises(IdentityMismatch, match=said):
        Bench(config, **spec).probe.connect()


def test_what_is_not_there_is_said() -> None:
    with pytest.raises(DeviceError, match="channel 9 of a station with 8 inputs"):
        Bench(WagoConfig(node=20, channel=9)).probe.connect()
    with pytest.raises(DeviceError, match="Channel 64"):
        Bench(WagoConfig(node=20, channel=64))
    with pytest.raises(DeviceTimeout, match="Node 21"):
        Bench(WagoConfig(node=21)).probe.connect()
    with pytest.raises(DeviceError, match="not connected"):
        Bench().probe.arm()


def test_settings_of_a_running_pdo_are_refused_by_the_station(bench: Bench) -> None:
    with pytest.raises(SdoAbort):
        bench.probe._node.sdo.write(20, 0x1800, 5, 50, 2)
