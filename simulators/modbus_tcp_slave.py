"""A device behind a Modbus TCP connection, written without the library that the drivers use."""

import struct
from collections.abc import Sequence
from typing import Final

from simulators.answers import Answers
from simulators.modbus_pdu import Registers, RegistersAndBits, answer_pdu

_HEADER: Final = struct.Struct(">HHHB")  # transaction, protocol, length of what follows, unit
LONGEST_PDU: Final = 253


class RegisterConnection(Answers):
    """The device end of one connection; the unit number is sent back as it came."""

    def __init__(
        self, device: Registers | RegistersAndBits, functions: Sequence[int], reply_s: float
    ) -> None:
        super().__init__()
        self._device, self._functions, self._reply_s = device, functions, reply_s
        self._input = b""

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
            reply = answer_pdu(pdu, self._functions, self._device, time_s)
            frame = _HEADER.pack(transaction, 0, len(reply) + 1, unit) + reply
            self._output.append((time_s + self._reply_s, frame))
