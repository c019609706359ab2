"""Modbus registers (Application Protocol V1.1b3), and an RTU slave: frames end with 3.5 bytes of silence.

Written without the library that the drivers use. Silent on wrong CRC, on another unit and after a broadcast.
"""

import math
import struct
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from simulators.uart import Uart

ILLEGAL_FUNCTION: Final = 1
ILLEGAL_ADDRESS: Final = 2
ILLEGAL_VALUE: Final = 3
BROADCAST: Final = 0
LONGEST_FRAME: Final = 256
SHORTEST_GAP_S: Final = 0.00175  # above 19200 baud
MOST_READ: Final = 125
MOST_WRITTEN: Final = 123
READS: Final = (3, 4)


class Refused(Exception):
    """The request gets an exception answer with this code; never leaves the simulator."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


class Registers(Protocol):
    """What a device holds; both raise Refused. Addresses are those on the wire."""

    def read(self, function: int, address: int, count: int, time_s: float) -> Sequence[int]:
        """Words of 16 bits."""

    def write(self, address: int, words: Sequence[int], time_s: float) -> None:
        """Take over words."""


def crc(data: bytes) -> bytes:
    """CRC-16 of Modbus, as sent: low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return struct.pack("<H", value)


def answer(frame: bytes, unit: int, functions: Sequence[int], registers: Registers, time_s: float) -> bytes:
    """The answer frame to a frame; b"" where a slave stays silent."""
    if not 4 <= len(frame) <= LONGEST_FRAME or crc(frame[:-2]) != frame[-2:]:
        return b""
    if frame[0] not in (unit, BROADCAST):
        return b""
    if frame[0] == BROADCAST and frame[1] in READS:
        return b""
    reply = bytes([unit]) + answer_pdu(frame[1:-2], functions, registers, time_s)
    return b"" if frame[0] == BROADCAST else reply + crc(reply)


def answer_pdu(pdu: bytes, functions: Sequence[int], registers: Registers, time_s: float) -> bytes:
    """The answer to a function with its parameters, good or refused."""
    function = pdu[0]
    try:
        if function not in functions:
            raise Refused(ILLEGAL_FUNCTION)
        return bytes([function]) + _execute(function, pdu[1:], registers, time_s)
    except Refused as refused:
        return bytes([function | 0x80, refused.code])


def _execute(function: int, body: bytes, registers: Registers, time_s: float) -> bytes:
    if len(body) < 4:
        raise Refused(ILLEGAL_VALUE)
    address, count = struct.unpack_from(">HH", body)
    if function in READS:
        if len(body) != 4 or not 1 <= count <= MOST_READ:
            raise Refused(ILLEGAL_VALUE)
        words = registers.read(function, address, count, time_s)
        return bytes([2 * count]) + struct.pack(f">{count}H", *words)
    if function == 6:
        if len(body) != 4:
            raise Refused(ILLEGAL_VALUE)
        registers.write(address, [count], time_s)
        return body
    if not 1 <= count <= MOST_WRITTEN or len(body) != 5 + 2 * count or body[4] != 2 * count:
        raise Refused(ILLEGAL_VALUE)
    registers.write(address, struct.unpack_from(f">{count}H", body, 5), time_s)
    return body[:4]


class FrameGap:
    """Collects bytes into frames by the silence between them."""

    def __init__(self, uart: Uart) -> None:
        self._uart, self._frame, self._last_s = uart, bytearray(), 0.0

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the line; call `due` up to `time_s` first."""
        self._frame += data
        self._last_s = self._uart.heard_s(len(data), time_s)

    @property
    def end_s(self) -> float:
        """When the silence is long enough to end the present frame; infinity if there is none."""
        if not self._frame:
            return math.inf
        fast = self._uart.baud > 19200
        return self._last_s + (SHORTEST_GAP_S if fast else 3.5 * self._uart.byte_s)

    def clear(self) -> None:
        """The power goes."""
        self._frame.clear()

    def due(self, time_s: float, handle: Callable[[bytes, float], None]) -> None:
        """Hand over the frame that has ended by then, with the instant at which it did."""
        end_s = self.end_s
        if end_s <= time_s:
            frame = bytes(self._frame)
            self._frame.clear()
            handle(frame, end_s)
