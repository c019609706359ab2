"""Advantech ADAM-6052 remote I/O: the touch probe's switch on a counter input, behind Modbus TCP.

Framing and PDUs are pymodbus's; what the registers hold is from the manual's tables.
"""

from typing import Any, Final

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu import bit_message as bits
from pymodbus.pdu import register_message as registers

from simulators.probes.switch import Switch

INPUTS: Final = 8
OUTPUTS: Final = range(16, 24)
CONTROL_COILS: Final = 32  # four per channel: start, clear counter, clear overflow, clear latch
INPUT_WORD: Final = 300
OUTPUT_WORD: Final = 302
NAME: Final = (210, 211)
KNOWN_FUNCTIONS: Final = (1, 2, 3, 4, 5, 6, 15, 16)
UNIT: Final = 1


class Adam6052:
    """Inputs, outputs, counters and name of the module."""

    def __init__(self, switch: Switch, model: int, channel: int, reply_delay_s: float) -> None:
        self._switch, self._model, self._channel = switch, model, channel
        self.reply_delay_s = reply_delay_s
        self._outputs = 0  # bits
        self._counter_base = [0] * INPUTS
        self.extra_counts = 0  # bounce, added by hand

    def restart(self) -> None:
        """Power comes back: outputs off, counters at zero."""
        self._outputs = 0
        self._counter_base = [0] * INPUTS
        self._counter_base[self._channel] = self._counter(self._channel)

    def answer(self, request: ModbusPDU, time_s: float) -> ModbusPDU:
        """What the module says to a request, at that instant."""
        code, address, count = request.function_code, request.address, request.count
        self._switch.update(time_s)
        if code in (1, 2):
            states = [self._bit(address + i) for i in range(count)]
            if None in states:
                return ExceptionResponse(code, ExcCodes.ILLEGAL_ADDRESS)
            kind = bits.ReadCoilsResponse if code == 1 else bits.ReadDiscreteInputsResponse
            return kind(bits=[bool(state) for state in states])
        if code in (3, 4):
            words = [self._word(address + i) for i in range(count)]
            if None in words:
                return ExceptionResponse(code, ExcCodes.ILLEGAL_ADDRESS)
            reading: Any = (
                registers.ReadHoldingRegistersResponse if code == 3 else registers.ReadInputRegistersResponse
            )
            return reading(registers=words)  # type: ignore[no-any-return]
        if code == 5 and self._set_coil(address, bool(request.bits[0])):
            return bits.WriteSingleCoilResponse(address=address, bits=request.bits)
        if code == 15 and all(
            self._set_coil(address + i, bool(state)) for i, state in enumerate(request.bits[:count])
        ):
            return bits.WriteMultipleCoilsResponse(address=address, count=count)
        if code == 6 and self._set_word(address, request.registers[0]):
            return registers.WriteSingleRegisterResponse(address=address, registers=request.registers)
        if code == 16 and all(
            self._set_word(address + i, value) for i, value in enumerate(request.registers)
        ):
            return registers.WriteMultipleRegistersResponse(address=address, count=count)
        known = code in KNOWN_FUNCTIONS
        return ExceptionResponse(code, ExcCodes.ILLEGAL_ADDRESS if known else ExcCodes.ILLEGAL_FUNCTION)

    def _counter(self, channel: int) -> int:
        edges = self._switch.count + self.extra_counts if channel == self._channel else 0
        return (edges - self._counter_base[channel]) & 0xFFFFFFFF

    def _inputs(self) -> int:
        return int(self._switch.closed) << self._channel

    def _bit(self, address: int) -> bool | None:
        if 0 <= address < INPUTS:
            return bool(self._inputs() >> address & 1)
        if address in OUTPUTS:
            return bool(self._outputs >> (address - OUTPUTS.start) & 1)
        if CONTROL_COILS <= address < CONTROL_COILS + 4 * INPUTS:
            return (address - CONTROL_COILS) % 4 == 0  # counting
        return None

    def _word(self, address: int) -> int | None:
        if 0 <= address < 2 * INPUTS:
            return self._counter(address // 2) >> 16 * (address % 2) & 0xFFFF  # low word first
        if address == INPUT_WORD:
            return self._inputs()
        if address == OUTPUT_WORD:
            return self._outputs
        if address in NAME:
            return self._model if address == NAME[0] else 0
        return None

    def _set_coil(self, address: int, state: bool) -> bool:
        if address in OUTPUTS:
            mask = 1 << (address - OUTPUTS.start)
            self._outputs = self._outputs | mask if state else self._outputs & ~mask
            return True
        if CONTROL_COILS <= address < CONTROL_COILS + 4 * INPUTS:
            channel, what = divmod(address - CONTROL_COILS, 4)
            if what == 1 and state:
                self._counter_base[channel] = 0
                self._counter_base[channel] = self._counter(channel)
            return True
        return False

    def _set_word(self, address: int, value: int) -> bool:
        if address == OUTPUT_WORD:
            self._outputs = value & 0xFF
            return True
        return False
