"""Advantech ADAM-6052 remote I/O: the touch probe's switch on a counter input, behind Modbus TCP.

What the registers hold is from the manual's tables.
"""

from collections.abc import Sequence
from typing import Final

from simulators.modbus_pdu import ILLEGAL_ADDRESS, Refused
from simulators.probes.switch import Switch

INPUTS: Final = 8
OUTPUTS: Final = range(16, 24)
CONTROLS: Final = range(32, 32 + 4 * INPUTS)  # of a channel: start, clear counter, overflow, latch
INPUT_WORD: Final = 300
OUTPUT_WORD: Final = 302
NAME: Final = (210, 211)
FUNCTIONS: Final = (1, 2, 3, 4, 5, 6, 15, 16)
UNIT: Final = 1


class Adam6052:
    """Inputs, outputs, counters and name of the module."""

    def __init__(self, switch: Switch, model: int, channel: int) -> None:
        self._switch, self._model, self._channel = switch, model, channel
        self._outputs = 0  # bits
        self._counter_base = [0] * INPUTS
        self.extra_counts = 0  # bounce, added by hand

    def restart(self) -> None:
        """Power comes back: outputs off, counters at zero."""
        self._outputs = 0
        self._counter_base = [0] * INPUTS
        self._counter_base[self._channel] = self._counter(self._channel)

    def read_bits(self, function: int, address: int, count: int, time_s: float) -> Sequence[bool]:
        """Inputs, outputs and control coils."""
        self._switch.update(time_s)
        return [self._bit(address + i) for i in range(count)]

    def write_bits(self, address: int, states: Sequence[bool], time_s: float) -> None:
        """Outputs and control coils."""
        self._switch.update(time_s)
        if not all(address + i in OUTPUTS or address + i in CONTROLS for i in range(len(states))):
            raise Refused(ILLEGAL_ADDRESS)
        for i, state in enumerate(states):
            self._set_coil(address + i, state)

    def read(self, function: int, address: int, count: int, time_s: float) -> Sequence[int]:
        """Counters, inputs and outputs as words, name."""
        self._switch.update(time_s)
        return [self._word(address + i) for i in range(count)]

    def write(self, address: int, words: Sequence[int], time_s: float) -> None:
        """The outputs as a word."""
        if address != OUTPUT_WORD or len(words) != 1:
            raise Refused(ILLEGAL_ADDRESS)
        self._outputs = words[0] & 0xFF

    def _counter(self, channel: int) -> int:
        edges = self._switch.count + self.extra_counts if channel == self._channel else 0
        return (edges - self._counter_base[channel]) & 0xFFFFFFFF

    def _inputs(self) -> int:
        return int(self._switch.closed) << self._channel

    def _bit(self, address: int) -> bool:
        if 0 <= address < INPUTS:
            return bool(self._inputs() >> address & 1)
        if address in OUTPUTS:
            return bool(self._outputs >> (address - OUTPUTS.start) & 1)
        if address in CONTROLS:
            return (address - CONTROLS.start) % 4 == 0  # counting
        raise Refused(ILLEGAL_ADDRESS)

    def _word(self, address: int) -> int:
        if 0 <= address < 2 * INPUTS:
            return self._counter(address // 2) >> 16 * (address % 2) & 0xFFFF  # low word first
        if address == INPUT_WORD:
            return self._inputs()
        if address == OUTPUT_WORD:
            return self._outputs
        if address in NAME:
            return self._model if address == NAME[0] else 0
        raise Refused(ILLEGAL_ADDRESS)

    def _set_coil(self, address: int, state: bool) -> None:
        if address in OUTPUTS:
            mask = 1 << (address - OUTPUTS.start)
            self._outputs = self._outputs | mask if state else self._outputs & ~mask
            return
        channel, what = divmod(address - CONTROLS.start, 4)
        if what == 1 and state:
            self._counter_base[channel] = 0
            self._counter_base[channel] = self._counter(channel)
