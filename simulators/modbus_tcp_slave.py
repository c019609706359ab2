"""Registers behind a Modbus TCP connection, written without the library that the drivers use."""

import math
import struct
from collections import deque
from collections.abc import Sequence
from typing import Final

from simulators.modbus_slave import Registers, answer_pdu

_HEADER: Final = struct.Struct(">HHHB")  # transaction, protocol, length of what follows, unit
LONGEST_PDU: Final = 253


class RegisterConnection:
    """The device end of one connection; the unit number is sent back as it came."""

    def __init__(self, registers: Registers, functions: Sequence[int], reply_s: float) -> None:
        self._registers, self._functions, self._reply_s = registers, functions, reply_s
        self._input = b""
        self._output: deque[tuple[float, bytes]] = deque()

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client, however they are cut."""
        self._input += data
        while len(self._input) > _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack_from(self._input)
            if protocol or not 2 <= length <= LONGEST_PDU + 1:
                self._input = b""  # not Modbus
                return
            end = _HEADER.size - 1 + length
            if len(self._input) < end:
                return
            pdu, self._input = self._input[_HEADER.size : end], self._input[end:]
            reply = answer_pdu(pdu, self._functions, self._registers, time_s)
            frame = _HEADER.pack(transaction, 0, len(reply) + 1, unit) + reply
            self._output.append((time_s + self._reply_s, frame))

    def next_output_s(self) -> float:
        """When the next answer leaves."""
        return self._output[0][0] if self._output else math.inf

    def take(self, time_s: float) -> bytes:
        """All answers that left by then."""
        data = b""
        while self._output and self._output[0][0] <= time_s:
            data += self._output.popleft()[1]
        return data

    def discard(self, time_s: float) -> None:
        """Forget the answers that left by then."""
        self.take(time_s)
