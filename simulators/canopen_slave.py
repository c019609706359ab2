"""A CANopen device that is no drive: boot-up, NMT, heartbeat, SDO; PDOs by SYNC, event or timer (CiA 301)."""

import math
from abc import ABC, abstractmethod
from collections import deque
from enum import IntEnum
from typing import Final

from simulators.canopen_objects import WRONG_STATE, Entries, Key, SdoAbort, SdoServer, Value, entry_of
from simulators.canopen_pdo import (
    DISABLED,
    SYNCHRONOUS,
    Pdo,
    active_pdos,
    check_pdo_write,
    default_can_ids,
    is_communication,
)
from simulators.interfaces import Frame

DONGLE_S: Final = 0.001  # the CAN dongle hands frames over in bursts
REPLY_S: Final = 0.0004  # an SDO server thinks
BOOT_S: Final = 0.5
KEPT_S: Final = 1.0  # frames of longer ago are lost in the receiving port
LAST_COMMUNICATION: Final = 0x1FFF  # index; from 2000h on objects belong to the application
PRODUCER_HEARTBEAT: Final[Key] = (0x1017, 0)


class Nmt(IntEnum):
    """Network states, as a heartbeat shows them."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 0x7F


class CanopenSlave(ABC):
    """A device of one node number; subclasses say what its objects are worth and when they change."""

    def __init__(self, node: int, entries: Entries, identity: dict[Key, Value]) -> None:
        self.node = node
        self._entries, self._identity = entries, identity
        self._output: deque[Frame] = deque()
        self._now_s = 0.0
        self._sdo = SdoServer(entries, self._read, self._write)
        self._power_on()
        self.nmt = Nmt.PRE_OPERATIONAL  # it was switched on long ago
        self._boot_s = math.inf

    # -- what the device is ----------------------------------------------------------------------

    @abstractmethod
    def live(self, key: Key, time_s: float) -> Value | None:
        """What this object is worth now; None if it is what was written last."""

    def next_change_s(self, time_s: float) -> float:
        """No object that is sent by event changes before this."""
        return math.inf

    def is_event(self, before: bytes, after: bytes) -> bool:
        """Whether this change of process data is sent."""
        return before != after

    # -- life ------------------------------------------------------------------------------------

    def restart(self, time_s: float) -> None:
        """Power comes back."""
        self._advance(time_s)
        self._power_on()
        self._boot_s = time_s + BOOT_S

    def _power_on(self) -> None:
        self.values: dict[Key, Value] = {key: entry.default for key, entry in self._entries.items()}
        default_can_ids(self.values, self.node)
        self.values.update(self._identity)
        self.nmt = Nmt.INITIALISING
        self._heartbeat_s = math.inf
        self._seen = dict[int, bytes]()  # process data by event, at the last look
        self._sent_s = dict[int, float]()
        self._configure()

    def _configure(self) -> None:
        self._receive_pdos = {pdo.can_id: pdo for pdo in active_pdos(self._entries, self.values, True)}
        send = active_pdos(self._entries, self.values, False)
        self._on_sync = [pdo for pdo in send if pdo.kind in SYNCHRONOUS]
        self._by_event = [pdo for pdo in send if pdo.kind not in SYNCHRONOUS]
        self._inhibit_s = {
            int(self.values[index, 1]) & 0x7FF: int(self.values[index, 3]) * 1e-4
            for index, sub in self.values
            if index >= 0x1800 and is_communication(index) and sub == 1
        }

    # -- bus -------------------------------------------------------------------------------------

    def receive(self, can_id: int, data: bytes, time_s: float) -> None:
        """A frame from the master."""
        self._advance(time_s)
        if can_id == 0x000 and len(data) == 2 and data[1] in (0, self.node):
            self._network(data[0])
        elif can_id == 0x080 and self.nmt is Nmt.OPERATIONAL:
            for pdo in self._on_sync:
                self._emit(time_s, pdo.can_id, self._packed(pdo))
        elif can_id == 0x600 + self.node and self.nmt not in (Nmt.INITIALISING, Nmt.STOPPED):
            answer = self._sdo.answer(data)
            if answer:
                self._emit(time_s + REPLY_S, 0x580 + self.node, answer)
        elif can_id in self._receive_pdos and self.nmt is Nmt.OPERATIONAL:
            self._take_over(self._receive_pdos[can_id], data)

    def next_output_s(self) -> float:
        """Nothing comes before this, if the master stays silent."""
        return self._output[0].time_s if self._output else self._next_event_s()

    def take(self, time_s: float) -> Frame | None:
        """The oldest frame that was on the bus by then."""
        self._advance(time_s)
        return self._output.popleft() if self._output and self._output[0].time_s <= time_s else None

    def next_frames(self, until_s: float) -> list[Frame]:
        """The frames that come together next, if that is by then; everything before has happened."""
        while not self._output or self._output[0].time_s > self._next_event_s():
            due_s = self._next_event_s()
            if due_s > until_s:
                break
            self._advance(due_s)
        if not self._output or self._output[0].time_s > until_s:
            return []
        first, frames = self._output[0].time_s, list[Frame]()
        while self._output and self._output[0].time_s <= first:
            frames.append(self._output.popleft())
        return frames

    def _emit(self, time_s: float, can_id: int, data: bytes) -> None:
        time_s += DONGLE_S
        if self._output:
            time_s = max(time_s, self._output[-1].time_s)
        self._output.append(Frame(can_id, data, time_s))

    def _network(self, command: int) -> None:
        if command in (0x81, 0x82):
            kept = {key: value for key, value in self.values.items() if key[0] > LAST_COMMUNICATION}
            self._power_on()
            self._boot_s = self._now_s + BOOT_S
            if command == 0x82:  # communication only: what the device does goes on
                self.values.update(kept)
        elif self.nmt is not Nmt.INITIALISING and command in (0x01, 0x02, 0x80):
            self.nmt = {0x01: Nmt.OPERATIONAL, 0x02: Nmt.STOPPED, 0x80: Nmt.PRE_OPERATIONAL}[command]
            self._watch()

    def _watch(self) -> None:
        """The present state is not sent: only what changes from now on, and what the timers repeat."""
        self._seen = {pdo.can_id: self._packed(pdo) for pdo in self._by_event}
        self._sent_s = {pdo.can_id: self._now_s for pdo in self._by_event}

    # -- time ------------------------------------------------------------------------------------

    def _advance(self, time_s: float) -> None:
        if time_s - self._now_s > 2 * KEPT_S:
            self._skip_to(time_s - KEPT_S)
        while (due_s := self._next_event_s()) <= time_s:
            self._now_s = max(self._now_s, due_s)
            self._due()
        self._now_s = max(self._now_s, time_s)

    def _skip_to(self, time_s: float) -> None:
        """Nobody has listened for long."""
        self._output.clear()
        if self._boot_s <= time_s:
            self._now_s = self._boot_s
            self._due()
        self._now_s = time_s
        self._sent_s = dict.fromkeys(self._sent_s, time_s)
        if self._heartbeat_s < time_s:
            self._heartbeat_s = time_s

    def _next_event_s(self) -> float:
        events = min(self._boot_s, self._heartbeat_s)
        if self.nmt is Nmt.OPERATIONAL and self._by_event:
            timers = [self._sent_s[pdo.can_id] + pdo.event_s for pdo in self._by_event if pdo.event_s]
            change_s = self.next_change_s(self._now_s)
            events = min(events, max(change_s, self._now_s), *timers, math.inf)
        return events

    def _due(self) -> None:
        now = self._now_s
        if now >= self._boot_s:
            self._boot_s, self.nmt = math.inf, Nmt.PRE_OPERATIONAL
            self._emit(now, 0x700 + self.node, b"\x00")
        if now >= self._heartbeat_s:
            self._emit(now, 0x700 + self.node, bytes((self.nmt,)))
            self._heartbeat_s += int(self.values[PRODUCER_HEARTBEAT]) / 1000
        if self.nmt is Nmt.OPERATIONAL:
            for pdo in self._by_event:
                self._send_event(pdo, now)

    def _send_event(self, pdo: Pdo, time_s: float) -> None:
        data, since_s = self._packed(pdo), time_s - self._sent_s[pdo.can_id]
        timer = bool(pdo.event_s) and since_s >= pdo.event_s - 1e-9
        inhibited = since_s < self._inhibit_s.get(pdo.can_id, 0.0) - 1e-9
        if not inhibited:
            changed = self.is_event(self._seen[pdo.can_id], data)
            self._seen[pdo.can_id] = data
            if timer or changed:
                self._sent_s[pdo.can_id] = time_s
                self._emit(time_s, pdo.can_id, data)

    # -- objects ---------------------------------------------------------------------------------

    def _packed(self, pdo: Pdo) -> bytes:
        return pdo.layout.pack(*[self._read(key) for key in pdo.keys])

    def _take_over(self, pdo: Pdo, data: bytes) -> None:
        if len(data) >= pdo.layout.size:
            for key, value in zip(pdo.keys, pdo.layout.unpack(data[: pdo.layout.size]), strict=True):
                self.values[key] = value

    def _read(self, key: Key) -> Value:
        entry_of(self._entries, key)
        value = self.live(key, self._now_s)
        return self.values[key] if value is None else value

    def _write(self, key: Key, value: Value) -> None:
        index, sub = key
        if 0x1400 <= index < 0x1C00:
            check_pdo_write(self._entries, self.values, key, value)
            if is_communication(index) and sub > 1 and not int(self.values[index, 1]) & DISABLED:
                raise SdoAbort(WRONG_STATE)
        self.values[key] = value
        if 0x1400 <= index < 0x1C00:
            self._configure()
            self._watch()
        elif key == PRODUCER_HEARTBEAT:
            self._heartbeat_s = self._now_s + int(value) / 1000 if value else math.inf
