"""What can go wrong on a wire, on a schedule or from a seed: faults of messages, whatever they mean.

A message is what a device hands over at one instant: an answer, a burst of a stream, a CAN frame.
"""

import heapq
import math
import re
from dataclasses import dataclass
from itertools import count
from typing import Final

import numpy as np

from estimation.errors import CellFileError
from simulators.interfaces import ByteDevice, CanDevice, Frame

KINDS: Final = {
    "late": "comes VALUE seconds later (0.3), and what follows it waits",
    "drop": "is lost",
    "duplicate": "comes twice",
    "reorder": "changes places with the one that follows it",
    "truncate": "loses its end",
    "corrupt": "has one bit flipped",
    "lose-byte": "loses one byte",
    "double-byte": "has one byte twice",
    "garbage": "comes after VALUE random bytes (5)",
    "split": "comes byte by byte, VALUE seconds apart (0.0005)",
    "echo": "comes after what the client has sent, as on a two-wire RS-485 line",
}
_DEFAULTS: Final = {"late": 0.3, "garbage": 5.0, "split": 0.0005}
_TEXT: Final = re.compile(
    r"(?P<kind>[a-z-]+)(:(?P<value>\d+(\.\d+)?)s?)?"
    r"(@(?P<from>\d+(\.\d+)?)s?(-(?P<until>\d+(\.\d+)?)s?)?)?(%(?P<percent>\d+(\.\d+)?))?"
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One entry of a schedule: one message at `from_s` or later, or every one in a span of time."""

    kind: str  # of KINDS here, or of what a device can be made to do
    value: float | None = None
    from_s: float = -math.inf
    until_s: float = math.inf
    once: bool = False
    chance: float = 1.0  # of each message
    payload: bytes = b""  # garbage that is not random


def parse_fault(text: str) -> Fault:
    """`KIND[:VALUE][@START[-END]][%PERCENT]`, such as `late:0.3@5s` (once) or `corrupt@5s-10s%20`.

    Raises CellFileError.
    """
    match = _TEXT.fullmatch(text.replace(" ", ""))
    if match is None:
        raise CellFileError(
            f"Fault {text!r} cannot be read", "Write KIND[:VALUE][@START[-END]][%PERCENT], as in late:0.3@5s"
        )
    value, start, end, percent = (match[key] for key in ("value", "from", "until", "percent"))
    chance = float(percent) / 100 if percent else 1.0
    if not 0.0 < chance <= 1.0:
        raise CellFileError(f"Fault {text!r} has a chance of {percent} %", "Give more than 0 and at most 100")
    if start and end and float(end) <= float(start):
        raise CellFileError(f"Fault {text!r} ends before it starts", "Give a later end")
    return Fault(
        match["kind"],
        float(value) if value else None,
        float(start) if start else -math.inf,
        float(end) if end else math.inf,
        once=start is not None and end is None,
        chance=chance,
    )


class WireFaults:
    """The faults of one wire. Everything random is drawn from the seed."""

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self._faults = list[Fault]()
        self._held: tuple[bytes, int] | None = None  # changes places with the next message
        self.played = 0  # how often a fault has struck
        self.struck_s = -math.inf  # when one did last

    def __bool__(self) -> bool:
        return bool(self._faults) or self._held is not None

    def reseed(self, seed: int) -> None:
        """Draw what follows from another seed."""
        self._rng = np.random.default_rng(seed)

    def add(self, kind: str, value: float | None = None, **schedule: float | bytes) -> None:
        """One more fault; what `Fault` takes. Raises CellFileError for a kind that no wire has."""
        self.schedule(Fault(kind, value, **schedule))  # type: ignore[arg-type]

    def schedule(self, fault: Fault) -> None:
        """One more fault. Raises CellFileError for a kind that no wire has."""
        if fault.kind not in KINDS:
            raise CellFileError(f"No wire has the fault {fault.kind!r}", f"Choose one of {', '.join(KINDS)}")
        self._faults.append(fault)

    def clear(self) -> None:
        """Nothing goes wrong from now on."""
        self._faults.clear()

    def strikes(self, kind: str, time_s: float) -> Fault | None:
        """The fault of this kind that hits a message now, if one does."""
        for fault in self._faults:
            if fault.kind == kind and fault.from_s <= time_s < fault.until_s:
                if fault.chance < 1.0 and self._rng.random() >= fault.chance:
                    continue
                if fault.once:
                    self._faults.remove(fault)
                self.played += 1
                self.struck_s = time_s
                return fault
        return None

    def spoil(self, time_s: float, data: bytes, channel: int = 0) -> list[tuple[float, bytes, int]]:
        """What becomes of a message: (time, bytes, channel) of everything that comes in its place."""
        if self.strikes("drop", time_s):
            return []
        data = self._mangled(time_s, data)
        if fault := self.strikes("garbage", time_s):
            length = round(fault.value if fault.value is not None else _DEFAULTS["garbage"])
            data = (fault.payload or self._rng.bytes(length)) + data
        messages = [(data, channel)]
        if self.strikes("duplicate", time_s):
            messages *= 2
        if self._held is not None:
            messages, self._held = [*messages, self._held], None
        elif self.strikes("reorder", time_s):
            self._held, messages = messages[0], messages[1:]
        if fault := self.strikes("late", time_s):
            time_s += fault.value if fault.value is not None else _DEFAULTS["late"]
        if fault := self.strikes("split", time_s):
            gap_s = fault.value if fault.value is not None else _DEFAULTS["split"]
            pieces = [(bytes((byte,)), where) for data, where in messages for byte in data]
            return [(time_s + i * gap_s, piece, where) for i, (piece, where) in enumerate(pieces)]
        return [(time_s, data, where) for data, where in messages]

    def _mangled(self, time_s: float, data: bytes) -> bytes:
        if not data:
            return data
        at = int(self._rng.integers(len(data))) if self._faults else 0
        if self.strikes("corrupt", time_s):
            bit = 1 << int(self._rng.integers(8))
            data = data[:at] + bytes((data[at] ^ bit,)) + data[at + 1 :]
        if self.strikes("lose-byte", time_s):
            data = data[:at] + data[at + 1 :]
        if self.strikes("double-byte", time_s):
            data = data[: at + 1] + data[at:]
        if self.strikes("truncate", time_s):
            data = data[:at]
        return data


class FaultyBytes:
    """A byte device behind a wire with faults."""

    def __init__(self, device: ByteDevice, faults: WireFaults) -> None:
        self._device, self._faults = device, faults
        self._queue = list[tuple[float, int, bytes]]()
        self._order = count()
        self._last_s = -math.inf

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client."""
        if self._faults and self._faults.strikes("echo", time_s):
            heapq.heappush(self._queue, (time_s, next(self._order), data))
        self._device.receive(data, time_s)

    def next_output_s(self) -> float:
        """When something may come next."""
        due_s = self._device.next_output_s()
        return min(due_s, self._queue[0][0]) if self._queue else due_s

    def take(self, time_s: float) -> bytes:
        """All that came by then."""
        if not (self._faults or self._queue):
            return self._device.take(time_s)
        self._collect(time_s)
        data = b""
        while self._queue and self._queue[0][0] <= time_s:
            data += heapq.heappop(self._queue)[2]
        return data

    def discard(self, time_s: float) -> None:
        """Forget what came by then."""
        if self._faults or self._queue:
            self.take(time_s)
        else:
            self._device.discard(time_s)

    def _collect(self, time_s: float) -> None:
        while (due_s := self._device.next_output_s()) <= time_s:
            data = self._device.take(due_s)
            if not data and self._device.next_output_s() <= due_s:
                break  # nothing to wait for
            for at_s, message, _ in self._faults.spoil(due_s, data) if data else ():
                self._last_s = max(at_s, self._last_s)  # a wire keeps the order
                heapq.heappush(self._queue, (self._last_s, next(self._order), message))


class FaultyCan:
    """A CAN device behind a bus with faults; a late frame of one identifier lets those of others pass."""

    def __init__(self, device: CanDevice, faults: WireFaults) -> None:
        self._device, self._faults = device, faults
        self._queue = list[tuple[float, int, Frame]]()
        self._order = count()
        self._last_s = dict[int, float]()

    def receive(self, can_id: int, data: bytes, time_s: float) -> None:
        """A frame from the master."""
        self._device.receive(can_id, data, time_s)

    def next_output_s(self) -> float:
        """When something may come next."""
        due_s = self._device.next_output_s()
        return min(due_s, self._queue[0][0]) if self._queue else due_s

    def take(self, time_s: float) -> Frame | None:
        """The oldest frame that came by then."""
        if not (self._faults or self._queue):
            return self._device.take(time_s)
        while (frame := self._device.take(time_s)) is not None:
            for at_s, data, can_id in self._faults.spoil(frame.time_s, frame.data, frame.can_id):
                at_s = self._last_s[can_id] = max(at_s, self._last_s.get(can_id, -math.inf))
                heapq.heappush(self._queue, (at_s, next(self._order), Frame(can_id, data[:8], at_s)))
        if self._queue and self._queue[0][0] <= time_s:
            return heapq.heappop(self._queue)[2]
        return None

    def next_frames(self, until_s: float) -> list[Frame]:
        """The frames that come together next, if that is by then."""
        if not (self._faults or self._queue):
            return self._device.next_frames(until_s)
        while (due_s := self.next_output_s()) <= until_s:
            frame = self.take(due_s)
            if frame is not None:
                return [frame]
        return []
