"""LMI Gocator line profiler: its Modbus TCP registers (2300 manual, pages 344 to 347).

The head computes measurements from its profiles; Modbus has those, not the profiles. Measurement 0 is the
height of what stands below the head, all others are not set up.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from simulators.modbus_pdu import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Refused
from simulators.modbus_tcp_slave import RegisterConnection
from simulators.sensors.beam import Beam

FUNCTIONS: Final = (3, 4, 6, 16)
STOP, START, ALIGN, ALIGN_MOVING, CLEAR, LOAD, VARIABLES = range(7)
DURATION_S: Final = {
    STOP: 0.05,
    START: 0.2,
    ALIGN: 2.0,
    ALIGN_MOVING: 4.0,
    CLEAR: 0.05,
    LOAD: 0.8,
    VARIABLES: 0.05,
}
PARAMETERS: Final = range(1, 65)
STATE: Final = range(300, 372)
BUSY: Final = 301
JOB_LENGTH: Final = 311
RESULTS: Final = range(976, 1999)
ADVANCE: Final = 976
DECISION: Final = 2  # in each group of three from 1000 on
NO_VALUE: Final = 0x80000000
INVALID_VALUE: Final = 0b10  # bits 1 to 7: code 1
PASS: Final = 1
DEPTH: Final = 10  # messages that are buffered; not in the manual
REPLY_S: Final = 0.002
BOOT_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class GocatorSpec:
    """One head. Its heights count upwards, from a plane that is `zero_m` away from it."""

    zero_m: float = 0.3
    span_m: float = 0.2  # of the measuring range, half of it on each side of the plane
    rate_hz: float = 200.0
    jobs: tuple[str, ...] = ("block", "other")  # the first is loaded at power-on
    noise_m: float = 0.0
    buffered: bool = False
    running: bool = False  # at power-on


class Gocator:
    """The registers, whoever asks for them."""

    def __init__(
        self, spec: GocatorSpec, beam: Beam, scale: float, offset_m: float, rng: np.random.Generator
    ) -> None:
        self.spec, self._beam, self._rng = spec, beam, rng
        self._scale, self._offset_m = scale, offset_m
        self._power_on(-BOOT_S)

    def restart(self, time_s: float) -> None:
        """Power comes back."""
        self._power_on(time_s)

    def _power_on(self, time_s: float) -> None:
        self._up_s = time_s + BOOT_S
        self.job, self.running = self.spec.jobs[0], self.spec.running
        self._command, self._words = 0, [0] * len(PARAMETERS)
        self._busy_s, self._pending = -math.inf, STOP  # until when a command is executed, and which
        self._executing = False
        self._aligned = False
        self._number = 0  # of the last frame
        self._since_s = self._up_s  # when the frames began to count
        self._queue = deque[int]()  # buffered
        self._overflow = False
        self._shown: tuple[int, int] = (0, NO_VALUE)  # frame and height in micrometres
        self._heights = dict[int, int]()

    def connect(self) -> RegisterConnection:
        """What a client finds."""
        return RegisterConnection(self, FUNCTIONS, REPLY_S)

    # -- commands --------------------------------------------------------------------------------

    def write(self, address: int, words: Sequence[int], time_s: float) -> None:
        """Parameters, and a command that is executed only if it is another one than before."""
        self._update(time_s)
        if address < 0 or address + len(words) > PARAMETERS.stop:
            raise Refused(ILLEGAL_ADDRESS)
        for register, word in enumerate(words, start=address):
            if register in PARAMETERS:
                self._words[register - 1] = word
        if address == 0 and words[0] != self._command:
            if words[0] not in DURATION_S:
                raise Refused(ILLEGAL_VALUE)
            self._command = words[0]
            self._pending, self._executing = words[0], True
            self._busy_s = time_s + DURATION_S[words[0]]

    def _update(self, time_s: float) -> None:
        if self._executing and time_s >= self._busy_s:
            self._executing = False
            self._finish(self._pending, self._busy_s)
        if self.running and time_s >= self._up_s:
            newest = math.floor((time_s - self._since_s) * self.spec.rate_hz + 1e-9)
            if self.spec.buffered:
                room = DEPTH - len(self._queue)
                fresh = range(self._number + 1, newest + 1)
                self._queue += fresh[:room]
                self._overflow = self._overflow or len(fresh) > room
                self._heights |= {number: self._height(number) for number in fresh[:room]}
            elif newest > self._number:
                self._shown = newest, self._height(newest)
            self._number = max(self._number, newest)

    def _finish(self, command: int, time_s: float) -> None:
        if command == STOP:
            self.running = False
        elif command == START:
            if not self.running:
                self._since_s = time_s - self._number / self.spec.rate_hz
            self.running = True
        elif command == LOAD:
            name = "".join(chr(word) for word in self._words).partition("\0")[0]
            if name in self.spec.jobs:
                self.job, self.running = name, False
        elif command in (ALIGN, CLEAR):
            self._aligned = command == ALIGN

    # -- results ---------------------------------------------------------------------------------

    def _height(self, number: int) -> int:
        true_m = float(self._beam.beam_lengths_m(np.array([self._since_s + number / self.spec.rate_hz]))[0])
        noise_m = float(self._rng.standard_normal()) * self.spec.noise_m
        height_m = self.spec.zero_m - (true_m - self._offset_m) / (1 + self._scale) + noise_m
        if math.isnan(height_m) or abs(height_m) > self.spec.span_m / 2:
            return NO_VALUE
        return round(height_m * 1e6) & 0xFFFFFFFF

    def read(self, function: int, address: int, count: int, time_s: float) -> Sequence[int]:
        """Words of the register map; reading 976 takes the next buffered message."""
        self._update(time_s)
        last = address + count
        if time_s < self._up_s or not any(r.start <= address and last <= r.stop for r in (STATE, RESULTS)):
            raise Refused(ILLEGAL_ADDRESS)
        if address in STATE:
            return [self._state(address + i) for i in range(count)]
        if address == ADVANCE and self._queue:
            number = self._queue.popleft()
            self._shown = number, self._heights.pop(number)
            self._overflow = False
        return [self._result(address + i) for i in range(count)]

    def _state(self, register: int) -> int:
        if register == BUSY:
            return int(self._executing)
        if register >= JOB_LENGTH:
            letters = [len(self.job), *self.job.encode("ascii")]
            at = register - JOB_LENGTH
            return letters[at] if at < len(letters) else 0
        return {300: int(self.running), 302: int(self._aligned)}.get(register, 0)

    def _result(self, register: int) -> int:
        number, height = self._shown
        if register >= 1000:
            measurement, part = divmod(register - 1000, 3)
            value = height if measurement == 0 else NO_VALUE
            if part == DECISION:
                return INVALID_VALUE if value == NO_VALUE else PASS
            return value >> (0 if part else 16) & 0xFFFF
        for first, value in ((992, round(number / self.spec.rate_hz * 1e6)), (996, number)):
            if first <= register < first + 4:
                return value >> 16 * (3 - register + first) & 0xFFFF
        return {977: len(self._queue), 978: int(self._overflow)}.get(register, 0)
