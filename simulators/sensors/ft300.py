"""Robotiq FT 300 force torque sensor on RS-485: Modbus RTU until it streams (manual, section 4.4)."""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray
from simulators.modbus_pdu import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Refused
from simulators.modbus_slave import FrameGap, answer, crc
from simulators.uart import CONVERTER_S, Uart

UNIT: Final = 9
BAUD: Final = 19200
FUNCTIONS: Final = (3, 16)
PERIOD_S: Final = 0.01
FRAME_BYTES: Final = 16
THINK_S: Final = 0.004  # not in the manual
BOOT_S: Final = 1.0  # not in the manual
JAM: Final = 0xFF
JAM_BYTES: Final = 45  # "about 50" end a stream
WRENCH: Final = range(180, 186)
ACCELERATION: Final = range(190, 193)
STREAM: Final = 410
STREAM_ON: Final = 0x0200
FIRMWARE: Final = range(500, 510)
SERIAL: Final = range(510, 514)
YEAR: Final = 514
FULL_SCALE: Final = np.array([100.0] * 3 + [1000.0] * 3)
KEPT_FRAMES: Final = 256  # by the receiving port while nobody reads; what comes then is lost


class Load(Protocol):
    """What pulls at the sensor."""

    def wrenches(self, times_s: FloatArray) -> FloatArray:
        """Forces (N) and torques (Nm), (n, 6), at past instants (n,)."""


@dataclass(frozen=True, slots=True)
class Ft300Spec:
    """One sensor."""

    serial_number: str = "FTD-0417"
    firmware: str = "FTS-V1.2.3"
    year: int = 2024
    noise_n: float = 0.0  # of one value of a force; torques a hundredth of the number
    streams_at_power_on: bool = False
    converter_s: float = CONVERTER_S


class Ft300:
    """The sensor's end of the line. Frames exist only when they are taken, so an unread stream is free."""

    def __init__(self, spec: Ft300Spec, load: Load, rng: np.random.Generator) -> None:
        self.spec, self._load, self._rng = spec, load, rng
        self.uart = Uart(BAUD, converter_s=spec.converter_s)
        self._gap = FrameGap(self.uart)
        self._power_on(-BOOT_S)

    def restart(self, time_s: float) -> None:
        """Power comes back."""
        self._power_on(time_s)

    def _power_on(self, time_s: float) -> None:
        self._up_s = time_s + BOOT_S
        self.uart.clear(self._up_s)
        self._gap.clear()
        self._jammed = 0
        self._passed = b""  # of the stream, before it ended
        self._next: int | None = 1 if self.spec.streams_at_power_on else None  # frame, counted from boot

    @property
    def streaming(self) -> bool:
        """It sends by itself, and hears no Modbus."""
        return self._next is not None

    # -- line ------------------------------------------------------------------------------------

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the host; deaf while it boots."""
        self._gap.due(time_s, self._frame)
        if time_s < self._up_s:
            return
        if not self.streaming:
            self._gap.receive(data, time_s)
            return
        for byte in data:
            heard_s = self.uart.heard_s(1, time_s)
            self._jammed = self._jammed + 1 if byte == JAM else 0
            if self._jammed >= JAM_BYTES and self._next is not None:
                self._passed += self._stream(heard_s)
                self._next = None

    def next_output_s(self) -> float:
        """When the next bytes are handed over, or a request ends."""
        stream_s = math.inf
        if self._next is not None:
            stream_s = self.uart.handed_over_s(self._complete_s(self._next))
        return 0.0 if self._passed else min(self._gap.end_s, self.uart.next_output_s(), stream_s)

    def take(self, time_s: float) -> bytes:
        """Everything handed over by then."""
        self._gap.due(time_s, self._frame)
        passed, self._passed = self._passed, b""
        return passed + self.uart.take(time_s) + self._stream(self.uart.handed_over_until_s(time_s))

    def discard(self, time_s: float) -> None:
        """Forget what was handed over by then, without making it."""
        self._gap.due(time_s, self._frame)
        self._passed = b""
        self._numbers_until(self.uart.handed_over_until_s(time_s))
        self.uart.take(time_s)

    # -- stream ----------------------------------------------------------------------------------

    def _complete_s(self, number: int) -> float:
        return self._up_s + number * PERIOD_S + FRAME_BYTES * self.uart.byte_s

    def _numbers_until(self, complete_s: float) -> FloatArray:
        if self._next is None:
            return np.empty(0)
        on_the_way_s = self._up_s + FRAME_BYTES * self.uart.byte_s
        last = math.floor((complete_s - on_the_way_s) / PERIOD_S + 1e-9)
        numbers = np.arange(self._next, last + 1, dtype=np.float64)
        self._next = max(self._next, last + 1)
        return numbers

    def _stream(self, complete_s: float) -> bytes:
        numbers = self._numbers_until(complete_s)[:KEPT_FRAMES]
        if not len(numbers):
            return b""
        frames = [
            b"\x20\x4e" + struct.pack("<6h", *counts)
            for counts in self._counts(self._up_s + numbers * PERIOD_S).tolist()
        ]
        return b"".join(frame + crc(frame) for frame in frames)

    def _counts(self, times_s: FloatArray) -> NDArray[np.int64]:
        noise = self._rng.standard_normal((len(times_s), 6)) * self.spec.noise_n
        noise[:, 3:] *= 0.01
        scaled = np.rint((self._load.wrenches(times_s) + noise) * FULL_SCALE)
        counts: NDArray[np.int64] = np.clip(scaled, -32768, 32767).astype(np.int64)
        return counts

    # -- Modbus ----------------------------------------------------------------------------------

    def _frame(self, frame: bytes, time_s: float) -> None:
        reply = answer(frame, UNIT, FUNCTIONS, self, time_s)
        if reply:
            self.uart.say(reply, time_s + THINK_S)

    def read(self, function: int, address: int, count: int, time_s: float) -> Sequence[int]:
        """Words of the register map."""
        wrench = self._counts(np.array([time_s]))[0].tolist()
        return [self._word(address + i, wrench) for i in range(count)]

    def _word(self, address: int, wrench: Sequence[float]) -> int:
        spec = self.spec
        if address in WRENCH:
            return int(wrench[address - WRENCH.start]) & 0xFFFF
        if address in ACCELERATION:
            return (0, 0, -1000 & 0xFFFF)[address - ACCELERATION.start]
        if address == STREAM:
            return 0
        if address in FIRMWARE:
            return _characters(spec.firmware, address - FIRMWARE.start)
        if address in SERIAL:
            return _characters(spec.serial_number, address - SERIAL.start)
        if address == YEAR:
            return spec.year
        raise Refused(ILLEGAL_ADDRESS)

    def write(self, address: int, words: Sequence[int], time_s: float) -> None:
        """Start of the stream."""
        if address != STREAM or len(words) != 1:
            raise Refused(ILLEGAL_ADDRESS)
        if words[0] != STREAM_ON:
            raise Refused(ILLEGAL_VALUE)
        self._jammed = 0
        self._next = math.floor((time_s + THINK_S + 8 * self.uart.byte_s - self._up_s) / PERIOD_S) + 1


def _characters(text: str, position: int) -> int:
    two = text.encode("ascii")[2 * position : 2 * position + 2].ljust(2, b"\0")
    return int.from_bytes(two, "big")
