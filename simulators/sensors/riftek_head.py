"""RIFTEK RF602/603/605 triangulation head: its samples, parameters and stream of results.

Source: RF602 user's manual 1.2.0, pages 11 to 20. What is not written there is marked.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from simulators.modbus_slave import FrameGap
from simulators.sensors.beam import Beam
from simulators.uart import CONVERTER_S, Uart

FULL_RANGE: Final = 0x4000
BITS_PER_BYTE: Final = 11  # 8E1
BAUD_STEP: Final = 2400
THINK_S: Final = 0.001  # not in the manual
BOOT_S: Final = 1.0  # not in the manual
AUTOSTART_S: Final = 20.0  # page 15, parameter 89h
HOLD_STEP_S: Final = 0.005
RESULT_BYTES: Final = 4
KEPT_BYTES: Final = 65536  # by the receiving port while nobody reads; what comes then is lost
BINARY, ASCII, MODBUS_RTU = 0, 1, 2

LASER_ON, CONTROL, ADDRESS, BAUD, AVERAGES = 0x00, 0x02, 0x03, 0x04, 0x06
PERIOD, HOLD, AUTOSTART, PROTOCOL = 0x08, 0x10, 0x89, 0x8A
FACTORY: Final[dict[int, int]] = {
    LASER_ON: 1,
    0x01: 0,  # analogue output
    CONTROL: 0,
    ADDRESS: 1,
    BAUD: 4,
    AVERAGES: 1,
    PERIOD: 5000 & 0xFF,
    PERIOD + 1: 5000 >> 8,
    0x0A: 3200 & 0xFF,  # longest integration
    0x0B: 3200 >> 8,
    0x0C: 0,  # analogue window
    0x0D: 0,
    0x0E: 16383 & 0xFF,
    0x0F: 16383 >> 8,
    HOLD: 2,
    0x17: 0,  # zero point
    0x18: 0,
    AUTOSTART: 0,
    PROTOCOL: BINARY,
}

IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RiftekSpec:
    """One head. The base distance is that of the start of the range."""

    device_type: int = 63
    firmware: int = 0x90
    serial_number: int = 17185
    base_mm: int = 80
    range_mm: int = 50
    noise_m: float = 0.0
    protocol: int = BINARY
    parameters: tuple[tuple[int, int], ...] = ()  # in flash, where they differ from the factory's
    no_target: int = 0  # not in the manual
    first_register: int = 1  # address on the wire of what the manual calls register 1: not in the manual
    converter_s: float = CONVERTER_S


class RiftekHead:
    """What all protocols share. Results exist only when they are taken, so an unread stream is free."""

    def __init__(
        self,
        spec: RiftekSpec,
        beam: Beam,
        scale: float,
        offset_m: float,
        rng: np.random.Generator,
        noise_factor: float = 1.0,
    ) -> None:
        self.spec, self._beam, self._rng = spec, beam, rng
        self._scale, self._offset_m, self._noise_m = scale, offset_m, spec.noise_m * noise_factor
        self.flash = {**FACTORY, PROTOCOL: spec.protocol, **dict(spec.parameters)}
        self.uart = Uart(9600, BITS_PER_BYTE, spec.converter_s)
        self.gap = FrameGap(self.uart)
        self._power_on(-BOOT_S)

    # -- life ------------------------------------------------------------------------------------

    def restart(self, time_s: float) -> None:
        """Power comes back: what was not saved is lost."""
        self._power_on(time_s)

    def _power_on(self, time_s: float) -> None:
        self.parameters = dict(self.flash)
        self.uart.clear(time_s)
        self.gap.clear()
        self._later: deque[tuple[float, Callable[[float], None]]] = deque()
        self._passed = b""  # of the stream, before it ended
        self._up_s = time_s + BOOT_S
        self._packets = 0  # sent since power-on
        self._cycle, self._code, self._sent_cycle = -1, self.spec.no_target, -1
        self._valid_cycle, self._valid_code = -math.inf, self.spec.no_target
        self._latched = False
        self._stream_cycle: int | None = None  # the next one to send
        self.settings_changed()
        if self.parameters[AUTOSTART]:
            self.start_stream(self._up_s + AUTOSTART_S)

    def settings_changed(self) -> None:
        """Take over the baud rate."""
        self.uart.baud = self.parameters[BAUD] * BAUD_STEP

    @property
    def baud(self) -> int:
        """Line speed now."""
        return self.uart.baud

    def word(self, code: int) -> int:
        """A parameter of two bytes, the low one first."""
        return self.parameters[code] | self.parameters[code + 1] << 8

    # -- results ---------------------------------------------------------------------------------

    @property
    def _period_s(self) -> float:
        return max(self.word(PERIOD), 1) * 1e-6

    def _cycle_at(self, time_s: float) -> int:
        return math.floor((time_s - self._up_s) / self._period_s + 1e-9)

    def result(self, time_s: float) -> tuple[int, bool]:
        """The present result, and whether it is another one than was sent last."""
        if self._latched:
            self._latched = False
        else:
            self._refresh(time_s)
        fresh, self._sent_cycle = self._cycle != self._sent_cycle, self._cycle
        return self._code, fresh

    def latch(self, time_s: float) -> None:
        """Keep the present result until it is asked for."""
        self._refresh(time_s)
        self._latched = True

    def _refresh(self, time_s: float) -> None:
        cycle = self._cycle_at(time_s)
        if self.parameters[LASER_ON] and cycle > self._cycle:
            self._code = int(self._measure(np.array([cycle]))[0])
            self._cycle = cycle

    def _measure(self, cycles: IntArray) -> IntArray:
        noise_m = self._noise_m / math.sqrt(max(self.parameters[AVERAGES], 1))
        true_m = self._beam.beam_lengths_m(self._up_s + cycles.astype(np.float64) * self._period_s)
        reading_m = (true_m - self._offset_m) / (1 + self._scale)
        reading_m = reading_m + self._rng.standard_normal(len(cycles)) * noise_m
        share = (reading_m * 1e3 - self.spec.base_mm) / self.spec.range_mm
        valid = (share >= 0) & (share < 1)
        codes = np.rint(np.where(valid, share, 0) * FULL_RANGE).astype(np.int64)
        return self._held(cycles, codes, valid)

    def _held(self, cycles: IntArray, codes: IntArray, valid: NDArray[np.bool_]) -> IntArray:
        """Where nothing is seen the last good result stands for a while."""
        steps = np.where(valid, np.arange(len(cycles)), -1)
        last = np.maximum.accumulate(steps)
        good_cycle = np.where(last >= 0, cycles[last], self._valid_cycle)
        good_code = np.where(last >= 0, codes[last], self._valid_code)
        self._valid_cycle, self._valid_code = float(good_cycle[-1]), int(good_code[-1])
        held = (cycles - good_cycle) * self._period_s <= self.parameters[HOLD] * HOLD_STEP_S
        return np.where(valid | held, good_code, self.spec.no_target)

    # -- stream ----------------------------------------------------------------------------------

    def start_stream(self, time_s: float) -> None:
        """Every result is sent from now on, or as many as the line carries."""
        self._stream_cycle = self._cycle_at(time_s) + 1

    def stop_stream(self, time_s: float) -> None:
        """What has been measured by then still comes."""
        self._passed += self._stream(time_s)
        self._stream_cycle = None

    def _stride(self) -> int:
        return max(1, math.ceil(RESULT_BYTES * self.uart.byte_s / self._period_s - 1e-9))

    def _complete_s(self, cycle: int) -> float:
        return self._up_s + cycle * self._period_s + RESULT_BYTES * self.uart.byte_s

    def _stream_until(self, complete_s: float) -> IntArray:
        """Cycles whose packets are complete by then; they are counted as sent."""
        if self._stream_cycle is None or not self.parameters[LASER_ON]:
            return np.empty(0, dtype=np.int64)
        last = self._cycle_at(complete_s - RESULT_BYTES * self.uart.byte_s)
        cycles = np.arange(self._stream_cycle, last + 1, self._stride())
        if len(cycles):
            self._stream_cycle = int(cycles[-1]) + self._stride()
            self._packets += len(cycles)
        return cycles

    def _stream(self, complete_s: float) -> bytes:
        cycles = self._stream_until(complete_s)
        if not len(cycles):
            return b""
        numbers = np.arange(self._packets - len(cycles), self._packets) + 1
        cycles = cycles[: KEPT_BYTES // RESULT_BYTES]
        codes = self._measure(cycles)
        self._cycle, self._code = int(cycles[-1]), int(codes[-1])
        self._sent_cycle = self._cycle
        head = 0x80 | 0x40 | (numbers[: len(cycles)] & 3) << 4
        nibbles = np.stack([codes >> 4 * i & 0xF for i in range(RESULT_BYTES)], axis=1)
        return (head[:, None] | nibbles).astype(np.uint8).tobytes()

    def next_packet(self) -> int:
        """Number of the packet that is about to be sent."""
        self._packets += 1
        return self._packets

    # -- answers ---------------------------------------------------------------------------------

    def do_later(self, time_s: float, action: Callable[[float], None]) -> None:
        """Do something once the request has arrived."""
        self._later.append((time_s, action))

    def say(self, data: bytes, time_s: float) -> None:
        """Answer a request that had arrived by then."""
        self.uart.say(data, time_s + THINK_S)
