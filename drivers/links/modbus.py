"""What Modbus TCP and RTU have in common: the functions, the reply that each must get, and refusals."""

import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Final

from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.bit_message import ReadCoilsRequest, ReadDiscreteInputsRequest, WriteSingleCoilRequest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from estimation.errors import DeviceError

BUSY_CODES: Final = (0x05, 0x06)
SETTINGS_CODES: Final = (0x01, 0x02, 0x03)

_EXCEPTION_WORDS: Final[Mapping[int, str]] = {
    0x01: "illegal function",
    0x02: "illegal address",
    0x03: "illegal value",
    0x04: "device failure",
    0x05: "acknowledged, still working",
    0x06: "busy",
    0x08: "memory parity error",
    0x0A: "no gateway path",
    0x0B: "no answer behind the gateway",
}


class ModbusRefusal(DeviceError):
    """The device answered with an exception; `code` is its number."""

    def __init__(self, problem: str, remedy: str, code: int = 0) -> None:
        super().__init__(problem, remedy)
        self.code = code


def refusal(name: str, request: ModbusPDU, code: int) -> ModbusRefusal:
    """The exception `code` in words."""
    words = _EXCEPTION_WORDS.get(code, "unknown exception")
    remedy = "Wait, then reset"
    if code in SETTINGS_CODES:
        remedy = "Correct the addresses in the cell file: this device has no such register"
    elif code not in BUSY_CODES:
        remedy = "Check the device, then reset"
    return ModbusRefusal(
        f"{name} refused function {request.function_code} at address {request.address}: {words} ({code:02X})",
        remedy,
        code,
    )


class ModbusClient(ABC):
    """One unit and its functions; addresses are 0-based, as on the wire.

    All raise DeviceTimeout, FrameError and ModbusRefusal.
    """

    def __init__(self) -> None:
        self._reads: dict[tuple[type[ModbusPDU], int, int], Any] = {}
        self.frames = self.bad_frames = self.timeouts = 0
        self.sent_s = self.received_s = 0.0  # of the last transaction

    def read_coils(self, address: int, count: int) -> list[bool]:
        """FC 1."""
        return self._read_bits(ReadCoilsRequest, address, count)

    def read_inputs(self, address: int, count: int) -> list[bool]:
        """FC 2, discrete inputs."""
        return self._read_bits(ReadDiscreteInputsRequest, address, count)

    def read_holding_registers(self, address: int, count: int) -> list[int]:
        """FC 3."""
        return self._read_words(ReadHoldingRegistersRequest, address, count)

    def read_input_registers(self, address: int, count: int) -> list[int]:
        """FC 4."""
        return self._read_words(ReadInputRegistersRequest, address, count)

    def write_coil(self, address: int, state: bool) -> None:
        """FC 5."""
        request = WriteSingleCoilRequest(address=address, bits=[state])
        self._ask(request, struct.pack(">BHH", 5, address, 0xFF00 if state else 0), 5)

    def write_register(self, address: int, value: int) -> None:
        """FC 6."""
        request = WriteSingleRegisterRequest(address=address, registers=[value])
        self._ask(request, struct.pack(">BHH", 6, address, value), 5)

    def write_registers(self, address: int, values: Sequence[int]) -> None:
        """FC 16."""
        request = WriteMultipleRegistersRequest(address=address, registers=list(values))
        self._ask(request, struct.pack(">BHH", 16, address, len(values)), 5)

    def _read_bits(self, kind: type[ModbusPDU], address: int, count: int) -> list[bool]:
        reply = self._read(kind, address, count, (count + 7) // 8)
        return [bool(bit) for bit in reply.bits[:count]]

    def _read_words(self, kind: type[ModbusPDU], address: int, count: int) -> list[int]:
        return list(self._read(kind, address, count, 2 * count).registers)

    def _read(self, kind: type[ModbusPDU], address: int, count: int, size: int) -> ModbusPDU:
        key = kind, address, count
        request = self._reads.get(key)  # the same is asked again and again
        if request is None:
            request = self._reads[key] = kind(address=address, count=count)
        return self._ask(request, bytes((request.function_code, size)), 2 + size)

    @abstractmethod
    def _ask(self, request: Any, head: bytes, length: int) -> ModbusPDU:
        """One answered request: the PDU of a good reply begins with `head` and has `length` bytes."""
