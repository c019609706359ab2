"""One pair in virtual time: device, wires with faults, driver."""

import contextlib

import numpy as np

from drivers.capabilities import Device
from estimation.errors import DeviceError
from simulators.faults import FaultyCan
from simulators.registry import DEVICES
from simulators.virtual import VirtualClock, VirtualPorts, virtual_links
from tests.conformance.pairs import Pair

SETTINGS = {
    "adam-6052": {"period_s": 0.5},  # slow enough for every touch to be told apart
    "robotiq-ft300": {"noise_n": 0.0},
}
PAUSE_S = 0.5
HEALS_IN = 6  # attempts to connect


class Rig:
    def __init__(self, pair: Pair, seed: int = 0) -> None:
        self.pair, self.kind, self.clock = pair, DEVICES[pair.kind], VirtualClock()
        self.clock.sleep(10.0)  # it was switched on long ago
        self.settings = SETTINGS.get(pair.kind, {})
        self.device = self.kind.simulated(seed, **self.settings)
        self.rng = np.random.default_rng(seed)
        links = virtual_links("robot", self.clock, lambda: self.device)
        self.links = list(links.values())
        for number, link in enumerate(self.links):
            link.faults.reseed(seed + number)
        self.driver: Device = pair.driver(VirtualPorts(links), self.clock)

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
        self.device = self.kind.simulated(1, **{**self.settings, **self.kind.other})
        if self.device.can is not None:
            self.links[0]._device = FaultyCan(self.device.can, self.links[0].faults)  # type: ignore[assignment]
        self.unplug(False)

    def unplug(self, out: bool) -> None:
        for link in self.links:
            link.unplugged = out
