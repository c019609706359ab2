"""Every error answer that the facts name for a device, in place of its own: what the driver says of it."""

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from drivers.sensors.dlrs1a_codec import ERRORS as KEYENCE_ERRORS
from simulators.interfaces import ByteDevice, CanDevice, Frame
from simulators.modbus_slave import crc

Answer = Callable[[bytes], bytes | None]  # to bytes of the driver; None leaves it to the device
ANSWER_S = 0.005


@dataclass(frozen=True)
class Refusal:
    """One error answer, from a piece of work on, or from `connect` on where work asks nothing."""

    name: str
    said: str  # by the driver, as a pattern
    answer: Answer = lambda request: None
    at_connect: bool = False
    frame: tuple[int, bytes] | None = None  # of a CAN device: comes by itself
    abort: bytes = b""  # of a CAN device: to every SDO


class RefusingBytes:
    """A byte device, some of whose answers are errors once `refusal` is set."""

    def __init__(self, device: ByteDevice, find: Callable[[], Refusal | None]) -> None:
        self._device, self._find = device, find
        self._due = list[tuple[float, bytes]]()

    def receive(self, data: bytes, time_s: float) -> None:
        refusal = self._find()
        answer = None if refusal is None else refusal.answer(data)
        if answer is None:
            self._device.receive(data, time_s)
        else:
            self._due.append((time_s + ANSWER_S, answer))

    def next_output_s(self) -> float:
        return min([self._device.next_output_s(), *(due_s for due_s, _ in self._due)])

    def take(self, time_s: float) -> bytes:
        data = b"".join(answer for due_s, answer in self._due if due_s <= time_s)
        self._due = [(due_s, answer) for due_s, answer in self._due if due_s > time_s]
        return data + self._device.take(time_s)

    def discard(self, time_s: float) -> None:
        self.take(time_s)


class RefusingCan:
    """A CAN device that aborts every SDO, or sends a frame of its own, once `refusal` is set."""

    def __init__(self, device: CanDevice, find: Callable[[], Refusal | None]) -> None:
        self._device, self._find = device, find
        self._due = list[Frame]()
        self._sent = False

    def receive(self, can_id: int, data: bytes, time_s: float) -> None:
        refusal = self._find()
        if refusal is not None and refusal.frame is not None and not self._sent:
            self._sent = True
            self._due.append(Frame(*refusal.frame, time_s + ANSWER_S))
        if refusal is not None and refusal.abort and can_id & 0x780 == 0x600:
            abort = b"\x80" + data[1:4] + refusal.abort
            self._due.append(Frame(0x580 | can_id & 0x7F, abort, time_s + ANSWER_S))
        else:
            self._device.receive(can_id, data, time_s)

    def next_output_s(self) -> float:
        return min([self._device.next_output_s(), *(frame.time_s for frame in self._due)])

    def take(self, time_s: float) -> Frame | None:
        for frame in self._due:
            if frame.time_s <= time_s:
                self._due.remove(frame)
                return frame
        return self._device.take(time_s)

    def next_frames(self, until_s: float) -> list[Frame]:
        if not self._due:
            return self._device.next_frames(until_s)
        while (due_s := self.next_output_s()) <= until_s:
            if (frame := self.take(due_s)) is not None:
                return [frame]
        return []


# --- the tables --------------------------------------------------------------------------------------------

MODBUS = {
    1: "illegal function",
    2: "illegal address",
    3: "illegal value",
    4: "device failure",
    5: "still working",
    6: "busy",
    8: "memory parity",
    10: "no gateway path",
    11: "no answer behind",
}
ABORTS = {
    0x05030000: "toggle",
    0x05040001: "Unknown SDO command",
    0x06010000: "access",
    0x06010001: "write only",
    0x06010002: "read only",
    0x06020000: "does not exist",
    0x06070010: "Data type",
    0x06090011: "[Ss]ubindex",
    0x06090030: "[Rr]ange|[Vv]alue",
    0x08000000: "[Gg]eneral",
    0x08000022: "device state",
}
MELFA = {
    50: "emergency stop", 61: "emergency stop", 70: "emergency stop", 2000: "servo is off",
    2601: "start position", 2602: "target beyond", 2603: "way leads", 2800: "illegal position",
    2802: "illegal position", 2810: "posture flag", 4140: "program not found", 5600: "while in error",
    5610: "while STOP is on", 5640: "already running", 6020: "no operation right",
    9999: "see the list of errors",
}  # fmt: skip


def modbus_tcp() -> Iterator[Refusal]:
    for code, words in MODBUS.items():

        def answer(request: bytes, code: int = code) -> bytes:
            return request[:2] + struct.pack(">HHBBB", 0, 3, request[6], request[7] | 0x80, code)

        yield Refusal(f"exception {code:02X}", words, answer)


def modbus_rtu(at_connect: bool) -> Iterator[Refusal]:
    for code, words in MODBUS.items():

        def answer(request: bytes, code: int = code) -> bytes | None:
            if len(request) != 8 or crc(request[:-2]) != request[-2:]:
                return None  # what ends a stream is no request
            body = bytes((request[0], request[1] | 0x80, code))
            return body + crc(body)

        yield Refusal(f"exception {code:02X}", words, answer, at_connect)


def aborts() -> Iterator[Refusal]:
    for code, words in ABORTS.items():
        yield Refusal(f"abort {code:08X}", words, at_connect=True, abort=code.to_bytes(4, "little"))


def emergency(node: int, code: int, said: str) -> Refusal:
    frame = struct.pack("<HB5x", code, 0x21)
    return Refusal(f"EMCY {code:04X}", said, frame=(0x80 + node, frame))


def keyence() -> Iterator[Refusal]:
    for number, words in KEYENCE_ERRORS.items():

        def answer(request: bytes, number: str = number) -> bytes:
            return f"ER,{request[:2].decode()},{number}\r\n".encode()

        yield Refusal(f"ER {number}", words, answer)


def melfa() -> Iterator[Refusal]:
    for number, words in MELFA.items():
        for case in "Rr":
            yield Refusal(
                f"Qe{case}{number:04d}", words, lambda request, text=f"Qe{case}{number:04d}\r": text.encode()
            )


def abb() -> Iterator[Refusal]:
    def answer(request: bytes) -> bytes:
        return f"{int(request[:2])} 0 ".encode()

    yield Refusal("not understood", "did not understand request", answer)


def optoncdt() -> Iterator[Refusal]:
    for command in ("GETINFO", "MEASRATE", "OUTREDUCEDEVICE", "OUTADD_RS422", "OUTPUT RS422"):

        def answer(request: bytes, command: str = command) -> bytes | None:
            text = request.decode("latin-1").strip()
            return f"{text}\r\nE104 Timeout\r\n->".encode() if text.startswith(command) else None

        yield Refusal(f"E104 to {command}", "refused .*: E104 Timeout", answer, at_connect=True)


def ur() -> Iterator[Refusal]:
    def refused(kind: bytes) -> Answer:
        return lambda request: b"\x00\x04" + kind + b"\x00" if request[2:3] == kind else None

    yield Refusal("RTDE version refused", "does not speak RTDE version 2", refused(b"V"), at_connect=True)
    yield Refusal("RTDE start refused", "refuses to start", refused(b"S"))
    for word in (b"NOT_FOUND", b"IN_USE"):

        def types(request: bytes, word: bytes = word) -> bytes | None:
            if request[2:3] != b"O":
                return None
            names = request[11:].count(b",") + 1
            payload = b"\x01" + b",".join([word] * names)
            return struct.pack(">HB", 3 + len(payload), ord("O")) + payload

        yield Refusal(f"RTDE {word.decode()}", f"is {word.decode()}, expected", types, at_connect=True)
    for command in ("get robot model", "robotmode", "safetystatus"):

        def line(request: bytes, command: str = command) -> bytes | None:
            text = request.decode("latin-1").strip()
            return f"could not understand: '{text}'\n".encode() if text == command else None

        yield Refusal(f"dashboard, {command}", "could not understand", line, at_connect=True)


REFUSALS: dict[str, list[Refusal]] = {
    "canopen-402": [*aborts(), emergency(5, 0x8611, "EMCY 8611h"), emergency(8, 0x2310, "EMCY 2310h")],
    "abb-open": [*abb()],
    "igus-irc": [*modbus_tcp()],
    "melfa-serial": [*melfa()],
    "melfa-tcp": [*melfa()],
    "ur": [*ur()],
    "optoncdt-1420": [*optoncdt()],
    "riftek-binary": [],  # it has none: what it does not understand it does not answer
    "riftek-ascii": [],
    "riftek-modbus": [*modbus_rtu(False)],
    "ams-335i": [*aborts(), emergency(16, 0xFF01, "reports the error FF01h")],
    "keyence-il": [*keyence()],
    "keyence-gt2": [*keyence()],
    "robotiq-ft300": [*modbus_rtu(True)],
    "gocator": [*modbus_tcp()],
    "adam-6052": [*modbus_tcp()],
    "wago-750-337": [*aborts(), emergency(20, 0x5000, "reports the error 5000h")],
}


def says(refusal: Refusal, message: str) -> bool:
    """Whether a message tells what went wrong."""
    return re.search(refusal.said, message) is not None
