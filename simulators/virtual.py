"""The deterministic cell: virtual time and in-memory links, in one thread.

Nothing runs while nobody waits: a read lets time jump to the device's next output or to its own timeout.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from estimation.errors import DeviceError
from simulators.cell import CellModel
from simulators.probes.adam6052 import ModbusConnection
from simulators.robots.canopen_arm import Frame

_OTHER_CELL = "Simulate the robot that the cell file names"
EPOCH_UTC_S = 1_790_000_000.0  # of virtual time zero, so that records look alike in every run


class VirtualClock:
    """Time that passes only when somebody waits."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        """Seconds since the cell was made."""
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` pass, at no cost."""
        self._now_s += max(duration_s, 0.0)

    def utc_s(self) -> float:
        """A wall time that starts alike in every run."""
        return EPOCH_UTC_S + self._now_s

    def advance_to(self, time_s: float) -> None:
        """Let time pass until then, if that is in the future."""
        if time_s > self._now_s:
            self._now_s = time_s


@dataclass(slots=True)
class LinkFaults:
    """What a test breaks on one link. Times are of the virtual clock."""

    unplugged: bool = False
    unplug_at_s: float = math.inf  # unplugs itself then, also in the middle of a wait
    silent_from_s: float = math.inf  # the device hears, its answers are lost
    silent_until_s: float = math.inf
    late_s: float = 0.0  # everything the device says comes so much later
    garbage: list[bytes] = field(default_factory=list)  # each comes before one of the next answers
    corrupt: int = 0  # so many next answers have one bit flipped
    piecewise: bool = False  # bytes arrive one at a time

    def silent(self, time_s: float) -> bool:
        return self.silent_from_s <= time_s < self.silent_until_s


class ByteDevice(Protocol):
    """A simulated device behind a byte stream."""

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the cell."""

    def next_output_s(self) -> float:
        """Nothing comes before this, if nothing is sent to the device."""

    def take(self, time_s: float) -> bytes:
        """All that was sent by then and not yet taken."""

    def discard(self, time_s: float) -> None:
        """Forget what was sent by then."""


class CanDevice(Protocol):
    """A simulated device on a CAN bus."""

    def receive(self, can_id: int, data: bytes, time_s: float) -> None:
        """A frame from the master."""

    def next_output_s(self) -> float:
        """Nothing comes before this, if the master stays silent."""

    def take(self, time_s: float) -> Frame | None:
        """The oldest frame that was on the bus by then."""

    def next_frame(self, until_s: float) -> Frame | None:
        """The next frame that is on the bus by then, if any; everything before it has happened."""


class _VirtualLink:
    """What both kinds of link share: being unplugged, and waiting."""

    def __init__(self, name: str, clock: VirtualClock) -> None:
        self._name, self._clock = name, clock
        self.faults = LinkFaults()
        self.opened = 0  # how often it was reopened

    @property
    def unplugged(self) -> bool:
        return self.faults.unplugged

    @unplugged.setter
    def unplugged(self, value: bool) -> None:
        self.faults.unplugged = value
        if not value:
            self.faults.unplug_at_s = math.inf

    def _check_plugged(self) -> float:
        now, faults = self._clock.now_s(), self.faults
        if now >= faults.unplug_at_s:
            faults.unplugged = True
        if faults.unplugged:
            raise DeviceError(f"Port {self._name} is gone", "Check the cable and the power of the device")
        return now

    def _wait(self, output_s: float, deadline_s: float) -> bool:
        """Let time pass to the output or the deadline; True if the output is there."""
        until = min(output_s + self.faults.late_s, deadline_s, self.faults.unplug_at_s)
        self._clock.advance_to(until)
        self._check_plugged()
        return output_s + self.faults.late_s <= self._clock.now_s()

    def reopen(self) -> None:
        self._check_plugged()
        self.opened += 1

    def close(self) -> None:
        """Nothing to release."""


class VirtualCanLink(_VirtualLink):
    """A CanLink onto the simulated arm."""

    def __init__(self, name: str, clock: VirtualClock, arm: CanDevice) -> None:
        super().__init__(name, clock)
        self._arm = arm

    def send(self, can_id: int, data: bytes) -> None:
        self._arm.receive(can_id, data, self._check_plugged())

    def receive(self, timeout_s: float) -> Frame | None:
        clock, arm, faults = self._clock, self._arm, self.faults
        now = clock.now_s()
        deadline_s = now + timeout_s
        healthy_until_s = min(faults.unplug_at_s, faults.silent_from_s)
        if deadline_s < healthy_until_s and not (faults.unplugged or faults.late_s):
            frame = arm.next_frame(deadline_s)  # as nearly always: nothing is broken
            clock.advance_to(deadline_s if frame is None else frame.time_s)
            return frame
        self._check_plugged()
        while True:
            output_s = arm.next_output_s()
            if not self._wait(output_s, deadline_s):
                return None
            frame = arm.take(max(clock.now_s() - faults.late_s, output_s))
            if frame is None or faults.silent(frame.time_s):
                continue  # something happened inside the arm, or its answer is lost
            return frame if not faults.late_s else frame._replace(time_s=clock.now_s())

    def reopen(self) -> None:
        super().reopen()
        while self._arm.take(self._clock.now_s()) is not None:
            pass


class VirtualByteLink(_VirtualLink):
    """A ByteLink onto a simulated device."""

    def __init__(self, name: str, clock: VirtualClock, device: ByteDevice) -> None:
        super().__init__(name, clock)
        self._device = device
        self._rest = b""

    def write(self, data: bytes) -> None:
        self._device.receive(data, self._check_plugged())

    def read(self, timeout_s: float) -> bytes:
        deadline_s = self._check_plugged() + timeout_s
        while not self._rest:
            output_s = self._device.next_output_s()
            if not self._wait(output_s, deadline_s):
                return b""
            data = self._device.take(max(self._clock.now_s() - self.faults.late_s, output_s))
            self._rest = self._spoiled(data)
        if not self.faults.piecewise:
            data, self._rest = self._rest, b""
        else:
            data, self._rest = self._rest[:1], self._rest[1:]
        return data

    def _spoiled(self, data: bytes) -> bytes:
        faults = self.faults
        if not data or faults.silent(self._clock.now_s()):
            return b""
        if faults.corrupt:
            faults.corrupt -= 1
            middle = len(data) // 2
            data = data[:middle] + bytes([data[middle] ^ 0x10]) + data[middle + 1 :]
        return faults.garbage.pop(0) + data if faults.garbage else data

    def discard_input(self) -> None:
        self._device.discard(self._check_plugged() - self.faults.late_s)
        self._rest = b""

    def reopen(self) -> None:
        super().reopen()
        self.discard_input()


class VirtualPorts:
    """The links of a cell by name; addresses and settings of real ports mean nothing here."""

    def __init__(self, links: Mapping[str, VirtualCanLink | VirtualByteLink]) -> None:
        self.links = links

    def can_bus(self, name: str, interface: str, port: str, bitrate: int) -> VirtualCanLink:
        """The CAN bus of this name."""
        link = self.links[name]
        if not isinstance(link, VirtualCanLink):
            raise DeviceError(f"{name} of the simulated cell is no CAN bus", _OTHER_CELL)
        return link

    def serial(self, name: str, port: str, baud: int, framing: str = "8N1") -> VirtualByteLink:
        """The serial line of this name."""
        return self._bytes(name)

    def tcp(self, name: str, host: str, port: int) -> VirtualByteLink:
        """The TCP connection of this name."""
        return self._bytes(name)

    def _bytes(self, name: str) -> VirtualByteLink:
        link = self.links[name]
        if not isinstance(link, VirtualByteLink):
            raise DeviceError(f"{name} of the simulated cell is no byte stream", _OTHER_CELL)
        return link


class SimulatedCell:
    """A whole cell in memory: give its links and its clock to the drivers.

    `scenario` and the factors are those of `CellModel`. The cell's own parts are in `model`.
    """

    def __init__(
        self,
        world_dir: Path,
        seed: int,
        scenario: str = "honest",
        motion_speed: float = 1.0,
        error_factor: float = 1.0,
        noise_factor: float = 1.0,
        cache_dir: Path | None = None,
    ) -> None:
        self.clock = VirtualClock()
        self.model = CellModel(world_dir, seed, scenario, motion_speed, error_factor, noise_factor, cache_dir)
        self.truth, self.world = self.model.truth, self.model.world
        self.arm, self.contact = self.model.arm, self.model.contact
        self.arm_link = VirtualCanLink("arm", self.clock, self.model.arm)
        self.laser_link = VirtualByteLink("laser", self.clock, self.model.laser)
        self.probe_link = VirtualByteLink("probe", self.clock, ModbusConnection(self.model.probe))
        self.ports = VirtualPorts(
            {"robot": self.arm_link, "laser": self.laser_link, "probe": self.probe_link}
        )

    def bump(self) -> None:
        """Knock the laser as the scenario says."""
        self.model.bump()
