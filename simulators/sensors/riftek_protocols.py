"""The three protocols of a RIFTEK head: binary of nibbles, ASCII, and Modbus RTU."""

from collections.abc import Sequence
from functools import partial
from typing import Final, Protocol

from simulators.modbus_pdu import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Refused
from simulators.modbus_slave import answer
from simulators.sensors.riftek_head import (
    ADDRESS,
    AVERAGES,
    BAUD,
    BINARY,
    FACTORY,
    HOLD,
    PERIOD,
    PROTOCOL,
    RiftekHead,
)

BROADCAST: Final = 0
SAVE: Final = 0xAA
RESTORE: Final = 0x69
IDENTIFY, READ, WRITE, FLASH, LATCH, RESULT, STREAM, STOP = range(1, 9)
MESSAGE_NIBBLES: Final = {READ: 2, WRITE: 4, FLASH: 2}
LONGEST_LINE: Final = 16
FUNCTIONS: Final = (3, 4, 6, 16)  # the manual names none
# Register as the manual counts, parameter, bytes, largest value (pages 18 and 19).
REGISTERS: Final[dict[int, tuple[int, int, int]]] = {
    10: (0x00, 1, 1),
    11: (0x01, 1, 1),
    12: (0x02, 1, 0xFF),
    13: (ADDRESS, 1, 127),
    14: (BAUD, 1, 192),
    15: (AVERAGES, 1, 128),
    16: (PERIOD, 2, 0xFFFF),
    17: (0x0A, 2, 3200),
    18: (0x0C, 2, 16383),
    19: (0x0E, 2, 16383),
    20: (HOLD, 1, 255),
    21: (0x17, 2, 16383),
    39: (PROTOCOL, 1, 2),
}
FLASH_REGISTER: Final = 40
LATCH_REGISTER: Final = 41


class Port(Protocol):
    """One protocol."""

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the host, the first of which begins to arrive then."""

    def advance(self, time_s: float) -> None:
        """Do what is due by then."""


def store(head: RiftekHead, constant: int) -> bool:
    """Save the parameters, or restore those of the factory. False if the constant is another."""
    if constant == SAVE:
        head.flash = dict(head.parameters)
    elif constant == RESTORE:
        head.flash = dict(FACTORY)
    return constant in (SAVE, RESTORE)


class BinaryPort:
    """Requests of two bytes and nibbles (page 12); only their first byte has bit 7 clear."""

    def __init__(self, head: RiftekHead) -> None:
        self._head, self._request = head, bytearray()

    def receive(self, data: bytes, time_s: float) -> None:
        for byte in data:
            heard_s = self._head.uart.heard_s(1, time_s)
            if byte < 0x80:
                self._request = bytearray([byte])
            elif self._request:
                self._request.append(byte)
                self._complete(heard_s)

    def advance(self, time_s: float) -> None:
        pass

    def _complete(self, heard_s: float) -> None:
        request = self._request
        code = request[1] & 0x0F
        if any(byte & 0x70 for byte in request[1:]):
            self._request = bytearray()  # no request of this protocol
        elif len(request) == 2 + MESSAGE_NIBBLES.get(code, 0):
            self._request = bytearray()
            if request[0] in (self._head.parameters[ADDRESS], BROADCAST):
                nibbles = [byte & 0x0F for byte in request[2:]]
                message = bytes(
                    low | high << 4 for low, high in zip(nibbles[::2], nibbles[1::2], strict=True)
                )
                self._head.do_later(heard_s, partial(self._execute, code, message))

    def _execute(self, code: int, message: bytes, time_s: float) -> None:
        head, spec = self._head, self._head.spec
        head.stop_stream(time_s)
        if code == IDENTIFY:
            words = (spec.serial_number, spec.base_mm, spec.range_mm)
            data = b"".join(word.to_bytes(2, "little") for word in words)
            self._answer(bytes([spec.device_type & 0xFF, spec.firmware]) + data, False, time_s)
        elif code == READ and message[0] in head.parameters:
            self._answer(bytes([head.parameters[message[0]]]), False, time_s)
        elif code == WRITE and message[0] in head.parameters:
            head.parameters[message[0]] = message[1]
            head.settings_changed()
        elif code == FLASH and store(head, message[0]):
            self._answer(message, False, time_s)
        elif code == LATCH:
            head.latch(time_s)
        elif code == RESULT:
            result, fresh = head.result(time_s)
            self._answer(result.to_bytes(2, "little"), fresh, time_s)
        elif code == STREAM:
            head.start_stream(time_s)

    def _answer(self, data: bytes, fresh: bool, time_s: float) -> None:
        top = 0x80 | fresh << 6 | (self._head.next_packet() & 3) << 4
        nibbles = [nibble for byte in data for nibble in (byte & 0x0F, byte >> 4)]
        self._head.say(bytes(top | nibble for nibble in nibbles), time_s)


class AsciiPort:
    """Lines that end with CR LF (pages 19 and 20)."""

    def __init__(self, head: RiftekHead) -> None:
        self._head, self._input = head, b""

    def receive(self, data: bytes, time_s: float) -> None:
        self._input += data
        heard_s = self._head.uart.heard_s(len(data), time_s)
        while b"\r\n" in self._input:
            line, _, self._input = self._input.partition(b"\r\n")
            self._head.do_later(heard_s, partial(self._execute, line))
        if len(self._input) > LONGEST_LINE:
            self._input = b""

    def advance(self, time_s: float) -> None:
        pass

    def _execute(self, line: bytes, time_s: float) -> None:
        head, spec = self._head, self._head.spec
        if line == b"V":
            values = (spec.device_type, spec.firmware, spec.serial_number, spec.base_mm, spec.range_mm)
            head.say("\n".join(str(value) for value in values).encode() + b"\r\n", time_s)
        elif line in (b"W0", b"W1"):
            store(head, SAVE if line == b"W0" else RESTORE)
            head.say(b"OK\r\n", time_s)
        elif line == b"R0":
            head.say(b"%d\r\n" % head.result(time_s)[0], time_s)
        elif line == b"PRT":
            head.say(b"OK\r\n", time_s)
            head.parameters[PROTOCOL] = BINARY
            head.do_later(head.uart.free_s, lambda _: head.settings_changed())


class RegisterPort:
    """Modbus RTU (pages 18 and 19)."""

    def __init__(self, head: RiftekHead) -> None:
        self._head = head

    def receive(self, data: bytes, time_s: float) -> None:
        self._head.gap.receive(data, time_s)

    def advance(self, time_s: float) -> None:
        self._head.gap.due(time_s, self._frame)

    def _frame(self, frame: bytes, time_s: float) -> None:
        head = self._head
        reply = answer(frame, head.parameters[ADDRESS], FUNCTIONS, self, time_s)
        if reply:
            head.say(reply, time_s)
            head.do_later(head.uart.free_s, lambda _: head.settings_changed())
        else:
            head.settings_changed()  # a broadcast may have changed them

    def read(self, function: int, address: int, count: int, time_s: float) -> Sequence[int]:
        first = address - self._head.spec.first_register + 1
        read = self._input if function == 4 else self._holding
        return [read(first + i, time_s) for i in range(count)]

    def _input(self, register: int, time_s: float) -> int:
        head, spec = self._head, self._head.spec
        values = (spec.device_type, spec.firmware, spec.serial_number, spec.base_mm, spec.range_mm)
        if 1 <= register <= 5:
            return values[register - 1]
        if register == 6:
            return head.result(time_s)[0]
        raise Refused(ILLEGAL_ADDRESS)

    def _holding(self, register: int, time_s: float) -> int:
        if register in (FLASH_REGISTER, LATCH_REGISTER):
            return 0
        if register not in REGISTERS:
            raise Refused(ILLEGAL_ADDRESS)
        code, size, _ = REGISTERS[register]
        return self._head.word(code) if size == 2 else self._head.parameters[code]

    def write(self, address: int, words: Sequence[int], time_s: float) -> None:
        first = address - self._head.spec.first_register + 1
        for register in range(first, first + len(words)):
            if register not in (*REGISTERS, FLASH_REGISTER, LATCH_REGISTER):
                raise Refused(ILLEGAL_ADDRESS)
        for register, value in enumerate(words, start=first):
            self._set(register, value, time_s)

    def _set(self, register: int, value: int, time_s: float) -> None:
        head = self._head
        if register == FLASH_REGISTER:
            if not store(head, value):
                raise Refused(ILLEGAL_VALUE)
        elif register == LATCH_REGISTER:
            if value == 1:
                head.latch(time_s)
        else:
            code, size, most = REGISTERS[register]
            if value > most or (value == 0 and register in (ADDRESS + 10, BAUD + 10, AVERAGES + 9)):
                raise Refused(ILLEGAL_VALUE)
            head.parameters[code] = value & 0xFF
            if size == 2:
                head.parameters[code + 1] = value >> 8
