"""One pair in virtual time: device, wires with faults, driver."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drivers.capabilities import Device
from estimation.errors import DeviceError
from simulators.device_kind import Setting, Simulated
from simulators.faults import FaultyCan
from simulators.interfaces import ByteDevice
from simulators.registry import DEVICES
from simulators.virtual import VirtualClock, VirtualPorts, virtual_links
from tests.conformance.pairs import Pair
from tests.conformance.refusals import Refusal, RefusingBytes, RefusingCan

SETTINGS = {
    "adam-6052": {"period_s": 0.5},  # slow enough for every touch to be told apart
    "robotiq-ft300": {"noise_n": 0.0},
}
PAUSE_S = 0.5
MOST_IN_CONVERTER = 64  # bytes
GAP_BYTES = 2  # of silence, which end a message
HEALS_IN = 6  # attempts to connect


class WatchedClock(VirtualClock):
    """Lets somebody look before time passes."""

    def __init__(self) -> None:
        super().__init__()
        self.look: Callable[[], None] = lambda: None

    def sleep(self, duration_s: float) -> None:
        self.look()
        super().sleep(duration_s)

    def advance_to(self, time_s: float) -> None:
        self.look()
        super().advance_to(time_s)


class Converter:
    """A USB converter at a serial device: bytes that come without a pause are handed over together."""

    def __init__(self, device: ByteDevice, gap_s: float) -> None:
        self._device, self._gap_s = device, gap_s
        self._data, self._last_s = b"", 0.0

    def receive(self, data: bytes, time_s: float) -> None:
        self._device.receive(data, time_s)

    def next_output_s(self) -> float:
        """The end of the pause that would end the burst, if nothing more comes in it."""
        if self._data:
            return self._last_s + self._gap_s
        return self._device.next_output_s() + self._gap_s

    def take(self, time_s: float) -> bytes:
        while (due_s := self._device.next_output_s()) <= time_s:
            if self._data and due_s > self._last_s + self._gap_s:
                break
            self._data += self._device.take(due_s)
            self._last_s = max(due_s, self._last_s)
            if len(self._data) > MOST_IN_CONVERTER:
                break
        if time_s < self._last_s + self._gap_s and len(self._data) <= MOST_IN_CONVERTER:
            return b""
        data, self._data = self._data, b""
        return data

    def discard(self, time_s: float) -> None:
        self._device.discard(time_s)
        self._data = b""


class Rig:
    """`converter` bundles what a serial device sends, so that a fault hits whole messages."""

    def __init__(self, pair: Pair, seed: int = 0, *, converter: bool = False) -> None:
        self._converter = converter
        self.refusal: Refusal | None = None  # which the device gives from now on
        self.pair, self.kind, self.clock = pair, DEVICES[pair.kind], WatchedClock()
        self.noticed_s = math.nan  # when the driver counted something as bad or missing
        self.clock.sleep(10.0)  # it was switched on long ago
        self.settings = SETTINGS.get(pair.kind, {})
        self.device = self._simulated(seed, **self.settings)
        self.rng = np.random.default_rng(seed)
        links = virtual_links("robot", self.clock, lambda: self.device)
        self.links = list(links.values())
        for number, link in enumerate(self.links):
            link.faults.reseed(seed + number)
        self.driver: Device = pair.driver(VirtualPorts(links), self.clock)

    def _simulated(self, seed: int, **settings: Setting) -> Simulated:
        device = self.kind.simulated(seed, **settings)
        if device.can is not None:
            return replace(device, can=RefusingCan(device.can, lambda: self.refusal))

        def refusing(connect: Callable[[], ByteDevice]) -> Callable[[], ByteDevice]:
            return lambda: RefusingBytes(connect(), lambda: self.refusal)

        if not self._converter or device.baud is None:
            return replace(device, connect={name: refusing(found) for name, found in device.connect.items()})
        gap_s = GAP_BYTES * 10 / device.baud()

        def bundled(connect: Callable[[], ByteDevice]) -> Callable[[], ByteDevice]:
            return lambda: Converter(connect(), gap_s)

        return replace(device, connect={name: bundled(found) for name, found in device.connect.items()})

    def watch(self) -> None:
        """Look from now on for the first thing that the driver counts as bad or missing."""
        before = self._complaints()

        def look() -> None:
            if self._complaints() != before:
                self.noticed_s, self.clock.look = self.clock.now_s(), lambda: None

        self.noticed_s, self.clock.look = math.nan, look

    def _complaints(self) -> tuple[int, int]:
        health = self.driver.health()
        return health.bad_frames, health.timeouts

    def work(self) -> None:
        self.pair.work(self.driver, self.device, self.clock, self.rng)

    def timed_work(self) -> bool:
        """Whether the work was done; it must end in time either way, and fail in a way that is documented."""
        begun_s = self.clock.now_s()
        try:
            self.work()
            return True
        except DeviceError:
            return False
        finally:
            assert self.clock.now_s() - begun_s < self.pair.delay_s, "it took too long to fail"

    def release(self) -> None:
        """What an operator does after a robot was stopped."""
        if hasattr(self.driver, "release"):
            self.driver.release()

    def heal(self) -> None:
        """Once nothing goes wrong any more, connecting anew is enough."""
        for _ in range(HEALS_IN):
            with contextlib.suppress(DeviceError):
                self.release()
                self.driver.connect()
                self.work()
                return
            self.clock.sleep(self.pair.boot_s / HEALS_IN + PAUSE_S)
        self.release()
        self.driver.connect()
        self.work()

    def swap(self) -> None:
        """Another device of the same kind takes the place of this one."""
        self.unplug(True)
        self.device = self._simulated(1, **{**self.settings, **self.kind.other})
        if self.device.can is not None:
            self.links[0]._device = FaultyCan(self.device.can, self.links[0].faults)  # type: ignore[assignment]
        self.unplug(False)

    def unplug(self, out: bool) -> None:
        for link in self.links:
            link.unplugged = out
