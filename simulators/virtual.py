"""The deterministic cell: virtual time and in-memory links, in one thread.

Nothing runs while nobody waits: a read lets time jump to the device's next output or to its own timeout.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from estimation.errors import DeviceError
from simulators.cell import CellModel
from simulators.device_kind import Simulated
from simulators.faults import FaultyBytes, FaultyCan, WireFaults
from simulators.interfaces import ByteDevice, CanDevice, Frame

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


class _VirtualLink:
    """What both kinds of link share: being unplugged, and waiting."""

    def __init__(self, name: str, clock: VirtualClock) -> None:
        self.name, self._clock = name, clock
        self.faults = WireFaults()
        self.unplug_at_s = math.inf  # the cable is pulled from then on, also in the middle of a wait
        self.opened = 0  # how often it was reopened

    @property
    def unplugged(self) -> bool:
        """The cable is pulled."""
        return self._clock.now_s() >= self.unplug_at_s

    @unplugged.setter
    def unplugged(self, value: bool) -> None:
        self.unplug_at_s = -math.inf if value else math.inf

    def _check_plugged(self) -> float:
        now = self._clock.now_s()
        if now >= self.unplug_at_s:
            raise DeviceError(f"Port {self.name} is gone", "Check the cable and the power of the device")
        return now

    def _wait(self, output_s: float, deadline_s: float) -> bool:
        """Let time pass to the output or the deadline; True if the output is there."""
        self._clock.advance_to(min(output_s, deadline_s, self.unplug_at_s))
        self._check_plugged()
        return output_s <= self._clock.now_s()

    def reopen(self) -> None:
        self._check_plugged()
        self.opened += 1

    def close(self) -> None:
        """Nothing to release."""


class VirtualCanLink(_VirtualLink):
    """A CanLink onto a simulated device."""

    def __init__(self, name: str, clock: VirtualClock, device: CanDevice) -> None:
        super().__init__(name, clock)
        self._device = FaultyCan(device, self.faults)

    def send(self, can_id: int, data: bytes) -> None:
        self._device.receive(can_id, data, self._check_plugged())

    def receive(self, timeout_s: float) -> Sequence[Frame]:
        until_s = self._check_plugged() + timeout_s
        if until_s > self.unplug_at_s:
            until_s = self.unplug_at_s
        frames = self._device.next_frames(until_s)
        self._clock.advance_to(frames[0].time_s if frames else until_s)
        if until_s == self.unplug_at_s:
            self._check_plugged()
        return frames

    def reopen(self) -> None:
        super().reopen()
        while self._device.take(self._clock.now_s()) is not None:
            pass


class VirtualByteLink(_VirtualLink):
    """A ByteLink onto a simulated device. `connect` makes what each opening finds there."""

    def __init__(self, name: str, clock: VirtualClock, connect: Callable[[], ByteDevice]) -> None:
        super().__init__(name, clock)
        self._connect = connect
        self._device = FaultyBytes(connect(), self.faults)

    def write(self, data: bytes) -> None:
        self._device.receive(data, self._check_plugged())

    def read(self, timeout_s: float) -> bytes:
        deadline_s = self._check_plugged() + timeout_s
        while True:
            if not self._wait(self._device.next_output_s(), deadline_s):
                return b""
            data = self._device.take(self._clock.now_s())
            if data:
                return data

    def discard_input(self) -> None:
        self._device.discard(self._check_plugged())

    def reopen(self) -> None:
        super().reopen()
        self._device = FaultyBytes(self._connect(), self.faults)
        self._device.discard(self._clock.now_s())


VirtualLink = VirtualCanLink | VirtualByteLink


def virtual_links(name: str, clock: VirtualClock, find: Callable[[], Simulated]) -> dict[str, VirtualLink]:
    """A link to each socket of a device, as drivers name them: "robot", "robot.stop".

    `find` gives the device that is there when a byte link is opened.
    """
    device = find()
    if device.can is not None:
        return {name: VirtualCanLink(name, clock, device.can)}

    def link_to(socket: str) -> VirtualByteLink:
        def connect() -> ByteDevice:
            return find().connect[socket]()

        return VirtualByteLink(f"{name}.{socket}" if socket else name, clock, connect)

    return {link.name: link for link in map(link_to, device.connect)}


class VirtualPorts:
    """The links of a cell by name; addresses and settings of real ports mean nothing here."""

    def __init__(self, links: Mapping[str, VirtualLink]) -> None:
        self.links = links
        self.searches: Mapping[str, Any] = {}  # every device is where it is

    def statistics(self) -> dict[str, Any]:
        """None: time passes here only while somebody waits."""
        return {}

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
        robot: str = "canopen-402",
        laser: str = "optoncdt-1420",
        probe: str = "adam-6052",
    ) -> None:
        self.clock = VirtualClock()
        self.model = CellModel(
            world_dir,
            seed,
            scenario,
            motion_speed,
            error_factor,
            noise_factor,
            cache_dir,
            robot,
            laser,
            probe,
        )
        self.truth, self.world = self.model.truth, self.model.world
        self.arm, self.contact = self.model.arm, self.model.contact
        links: dict[str, VirtualLink] = {}
        for name, device in self.model.devices.items():
            links |= virtual_links(name, self.clock, lambda device=device: device)  # type: ignore[misc]
        self.ports = VirtualPorts(links)
        self.laser_link, self.probe_link = links["laser"], links["probe"]

    @property
    def arm_link(self) -> VirtualCanLink:
        """The CAN bus of a CANopen arm."""
        return self.ports.can_bus("robot", "", "", 0)

    def bump(self) -> None:
        """Knock the laser as the scenario says."""
        self.model.bump()
