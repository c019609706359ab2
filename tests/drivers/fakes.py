"""Small scripted counterparts in virtual time, no wiser than the tests need; the real thing simulates."""

import heapq
import itertools
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.links.interfaces import CanFrame
from estimation.errors import DeviceError


class VirtualClock:
    """Time passes only when somebody waits."""

    def __init__(self) -> None:
        self.time_s = 100.0

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.time_s += duration_s

    def utc_s(self) -> float:
        return 1.7e9 + self.time_s


class FakeByteLink:
    """Calls `on_write(data)` for what the driver sends; `later(delay, data)` schedules an answer."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.on_write = clock, lambda data: None
        self.sent, self.opened, self.gone = list[bytes](), 0, False
        self._events: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()

    def later(self, delay_s: float, data: bytes) -> None:
        heapq.heappush(self._events, (self.clock.time_s + delay_s, next(self._order), data))

    def write(self, data: bytes) -> None:
        self._require()
        self.sent.append(data)
        self.on_write(data)

    def read(self, timeout_s: float) -> bytes:
        self._require()
        until = self.clock.time_s + timeout_s
        if self._events and self._events[0][0] <= until:
            self.clock.time_s = max(self.clock.time_s, self._events[0][0])
            received = b""
            while self._events and self._events[0][0] <= self.clock.time_s:
                received += heapq.heappop(self._events)[2]
            return received
        self.clock.time_s = until
        return b""

    def discard_input(self) -> None:
        while self._events and self._events[0][0] <= self.clock.time_s:
            heapq.heappop(self._events)

    def reopen(self) -> None:
        self.opened, self.gone = self.opened + 1, False
        self._events.clear()

    def close(self) -> None:
        self._events.clear()

    def _require(self) -> None:
        if self.gone:
            raise DeviceError("Port run/fake is gone", "Plug it in")


@dataclass
class FakeDrive:
    """One joint: SDO dictionary, CiA 402 states, constant-velocity motion at the profile velocity."""

    node: int
    objects: dict[tuple[int, int], bytes] = field(default_factory=dict)
    absent: frozenset[int] = frozenset({0x1006, 0x603F, 0x6084})
    statusword: int = 0x0240
    nmt: int = 0x7F
    position: float = 0.0
    target: int = 0
    pending_target: int = 0
    velocity: int = 0
    controlword: int = 0
    silent: bool = False
    heartbeat: bool = True
    last_s: float = 0.0
    rpdos: list[tuple[int, bytes]] = field(default_factory=list)
    quick_stops: int = 0

    def __post_init__(self) -> None:
        defaults = {
            (0x1000, 0): struct.pack("<I", 0x20192),
            (0x1018, 4): struct.pack("<I", 1000 + self.node),
            (0x1003, 1): struct.pack("<I", 0x8611),
            (0x6061, 0): b"\x07",
            (0x6041, 0): struct.pack("<H", self.statusword),
        }
        self.objects = defaults | self.objects

    def sdo(self, request: bytes) -> bytes:
        command, index, sub = struct.unpack_from("<BHB", request)
        key = (index, sub)
        if index in self.absent:
            return struct.pack("<BHBI", 0x80, index, sub, 0x06020000)
        if command == 0x40:
            value = self.objects.get(key)
            if value is None:
                return struct.pack("<BHBI", 0x80, index, sub, 0x06020000)
            return struct.pack("<BHB", 0x43 | (4 - len(value)) << 2, index, sub) + value.ljust(4, b"\0")
        size = 4 - (command >> 2 & 3)
        self.objects[key] = request[4 : 4 + size]
        if key == (0x6060, 0):
            self.objects[0x6061, 0] = request[4:5]
        return struct.pack("<BHBI", 0x60, index, sub, 0)

    def sync(self, now_s: float) -> bytes:
        self._move(now_s)
        for number, data in self.rpdos:
            if number == 2:
                self.pending_target, self.velocity = struct.unpack("<iI", data)
            else:
                self._control(struct.unpack_from("<H", data)[0])
        self.rpdos.clear()
        return struct.pack("<Hi", self.statusword, round(self.position))

    def _control(self, word: int) -> None:
        old, self.controlword = self.controlword, word
        state = self.statusword & 0x6F
        if word & 0x80 and not old & 0x80 and state & 0x4F == 0x08:
            state = 0x40
        elif state & 0x4F == 0x08:
            pass
        elif not word & 2:
            state = 0x40
        elif not word & 4:
            self.quick_stops += state == 0x27
            state, self.target = (0x07, round(self.position)) if state == 0x27 else (0x40, self.target)
        else:
            state = {
                (0x40, 6): 0x21,
                (0x21, 7): 0x23,
                (0x23, 15): 0x27,
                (0x27, 7): 0x23,
                (0x27, 6): 0x21,
                (0x23, 6): 0x21,
            }.get((state, word & 15), state)
        extra = 0
        if state == 0x27 and word & 0x10:
            extra = 0x1000
            if not old & 0x10:
                self.target = self.pending_target
        if word & 0x100:
            self.target = round(self.position)
        self.statusword = 0x0200 | extra | state

    def _move(self, now_s: float) -> None:
        elapsed_s, self.last_s = now_s - self.last_s, now_s
        if self.statusword & 0x6F == 0x27:
            step = self.velocity * elapsed_s
            self.position += max(-step, min(step, self.target - self.position))
            reached = self.position == self.target
            self.statusword = self.statusword & ~0x400 | (0x400 if reached else 0)


class FakeArmLink:
    """A CAN bus with fake drives."""

    def __init__(self, clock: VirtualClock, nodes: tuple[int, ...] = (3, 4, 5, 6, 7, 8)) -> None:
        self.clock = clock
        self.drives = {node: FakeDrive(node) for node in nodes}
        self.sent: list[tuple[int, bytes]] = []
        self.on_sync: Callable[[int], None] = lambda number: None
        self.syncs = self.opened = 0
        self.answer_delay_s = 0.0005
        self._events: list[tuple[float, int, int, bytes]] = []
        self._order = itertools.count()
        self._beat_s = clock.time_s

    def later(self, delay_s: float, can_id: int, data: bytes) -> None:
        heapq.heappush(self._events, (self.clock.time_s + delay_s, next(self._order), can_id, data))

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, data))
        function, node = can_id & 0x780, can_id & 0x7F
        drive = self.drives.get(node)
        if can_id == 0x000:
            for each in self.drives.values():
                if data[1] in (0, each.node):
                    each.nmt = {1: 0x05, 0x80: 0x7F, 2: 0x04}[data[0]]
        elif can_id == 0x080:
            self.syncs += 1
            self.on_sync(self.syncs)
            for each in self.drives.values():
                if each.nmt == 5 and not each.silent:
                    self.later(self.answer_delay_s, 0x180 + each.node, each.sync(self.clock.time_s))
        elif drive is not None and function == 0x600 and not drive.silent:
            self.later(0.0003, 0x580 + node, drive.sdo(data))
        elif drive is not None and function in (0x200, 0x300) and drive.nmt == 5:
            drive.rpdos.append((1 if function == 0x200 else 2, data))

    def receive(self, timeout_s: float) -> list[CanFrame]:
        until = self.clock.time_s + timeout_s
        while True:
            next_s = self._events[0][0] if self._events else float("inf")
            if self._beat_s <= min(next_s, until):
                for each in self.drives.values():
                    if each.heartbeat and not each.silent:
                        event = (self._beat_s, next(self._order), 0x700 + each.node, bytes([each.nmt]))
                        heapq.heappush(self._events, event)
                self._beat_s += 0.1
                continue
            if next_s <= until:
                time_s, _, can_id, data = heapq.heappop(self._events)
                self.clock.time_s = max(self.clock.time_s, time_s)
                return [CanFrame(can_id, data, time_s)]
            self.clock.time_s = until
            return []

    def reopen(self) -> None:
        self.opened += 1

    def close(self) -> None:
        pass
