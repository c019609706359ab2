"""A Modbus RTU slave: frames end with 3.5 bytes of silence.

Silent on wrong CRC, on another unit and after a broadcast.
"""

import math
import struct
from collections.abc import Callable, Sequence
from typing import Final

from simulators.modbus_pdu import READS, Registers, answer_pdu
from simulators.uart import Uart

BROADCAST: Final = 0
LONGEST_FRAME: Final = 256
SHORTEST_GAP_S: Final = 0.00175  # above 19200 baud


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
