"""The device end of a Modbus TCP connection. Framing and PDUs are pymodbus's."""

import functools
import logging
from typing import Protocol

from pymodbus.constants import ExcCodes
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU

from simulators.answers import Answers

logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # it dumps frames on every refused request


class ModbusModule(Protocol):
    """What the device is asked."""

    @property
    def reply_delay_s(self) -> float:
        """From request to answer."""

    def answer(self, request: ModbusPDU, time_s: float) -> ModbusPDU:
        """What the device says to a request, at that instant."""


class ModbusConnection(Answers):
    """The device end of one TCP connection; inputs are sampled when a request arrives."""

    def __init__(self, module: ModbusModule) -> None:
        super().__init__()
        self._module = module
        decoder = DecodePDU(is_server=True)
        # A touch asks the same thing hundreds of times.
        decoder.decode = functools.lru_cache(maxsize=16)(decoder.decode)  # type: ignore[method-assign]
        self._framer = FramerSocket(decoder)
        self._input = b""

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client, however they are cut."""
        self._input += data
        while self._input:
            try:
                used, request = self._framer.handleFrame(self._input, 0, 0)
            except ModbusException:
                self._refuse(time_s)
                continue
            if request is None and not used:
                if self._input[2:4] not in (b"", b"\0", b"\0\0"):
                    self._input = b""  # not Modbus
                return
            self._input = self._input[used:]
            if request is not None:
                answer = self._module.answer(request, time_s)
                self._send(answer, request.transaction_id, request.dev_id, time_s)

    def _refuse(self, time_s: float) -> None:
        """A function that the device does not have."""
        frame = self._input
        length = 6 + int.from_bytes(frame[4:6], "big")
        answer = ExceptionResponse(frame[7] & 0x7F, ExcCodes.ILLEGAL_FUNCTION)
        self._input = frame[length:]
        self._send(answer, int.from_bytes(frame[0:2], "big"), frame[6], time_s)

    def _send(self, answer: ModbusPDU, transaction: int, unit: int, time_s: float) -> None:
        answer.transaction_id, answer.dev_id = transaction, unit
        self._output.append((time_s + self._module.reply_delay_s, self._framer.buildFrame(answer)))
