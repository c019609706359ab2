"""Keyence DL-RS1A communication unit with its amplifiers, GT2 gauges or IL lasers, on RS-232C.

Source: DL-RS1A user's manuals; formats of special values for GT2 and IL are those of the SK edition, widened.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from simulators.sensors.beam import Beam
from simulators.uart import CONVERTER_S, Uart

EXTRA_BITS: Final = 4  # around the data bits of a byte, as the manual computes its answer times
THINK_S: Final = 0.003  # not in the manual
BOOT_S: Final = 2.0  # not in the manual
LONGEST_LINE: Final = 64
INVALID_COMMAND, DATA_LENGTH, PARAMETERS, PARAMETER, NO_AMPLIFIER = "00", "20", "21", "22", "65"
WRITE_CONTROL: Final = "31"  # switch on R: the error exists, its number is not in the facts at hand
PRESET: Final = 50
RESETS: Final = (53, 60)


class Refused(Exception):
    """The unit answers with this error number; never leaves the simulator."""

    def __init__(self, number: str) -> None:
        super().__init__(number)
        self.number = number


@dataclass(frozen=True, slots=True)
class AmplifierSpec:
    """One amplifier and its head."""

    kind: str = "IL"  # or "GT2"
    zero_m: float = 0.1  # distance at which the raw value is zero
    span_m: float = 0.05  # of the measuring range, half of it on each side; a gauge has its stroke above zero
    towards: bool = True  # values grow towards the head
    noise_m: float = 0.0
    response_s: float = 0.01  # values are so old
    hold: bool = False  # the measured value stands as it was when the hold began: at the first question


class Amplifier:
    """What one amplifier measures and remembers."""

    def __init__(
        self, spec: AmplifierSpec, beam: Beam, scale: float, offset_m: float, rng: np.random.Generator
    ) -> None:
        self.spec, self._beam, self._rng = spec, beam, rng
        self._scale, self._offset_m = scale, offset_m
        self.error_bits = 0
        self._preset_mm = 0.0
        self._held: float | None = None
        self._requests = dict.fromkeys((PRESET, *RESETS), 0)

    def _raw_mm(self, time_s: float) -> float:
        spec = self.spec
        true_m = float(self._beam.beam_lengths_m(np.array([time_s - spec.response_s]))[0])
        reading_m = (true_m - self._offset_m) / (1 + self._scale)
        reading_m += float(self._rng.standard_normal()) * spec.noise_m
        raw_m = (spec.zero_m - reading_m) if spec.towards else (reading_m - spec.zero_m)
        lowest_m, highest_m = (
            (0.0, spec.span_m) if spec.kind == "GT2" else (-spec.span_m / 2, spec.span_m / 2)
        )
        if math.isnan(raw_m):
            return raw_m
        return math.inf if raw_m > highest_m else -math.inf if raw_m < lowest_m - 1e-4 else raw_m * 1e3

    def _measured_mm(self, time_s: float) -> float:
        value = self._raw_mm(time_s) - self._preset_mm
        if self.spec.hold:
            self._held = value if self._held is None else self._held
            return self._held
        return value

    def text(self, millimetres: float) -> str:
        """A value in the format of the amplifier."""
        whole, places = (3, 4) if self.spec.kind == "GT2" else (2, 3)
        if self.error_bits:
            return f"+{'E' * whole}.{'E' * places}"
        if math.isnan(millimetres):
            return f"-{'9' * whole}.{'9' * (places - 1)}8"
        if math.isinf(millimetres):
            return f"{'+' if millimetres > 0 else '-'}{'9' * whole}.{'9' * places}"
        return f"{millimetres:+0{whole + places + 2}.{places}f}"

    def measured(self, time_s: float) -> str:
        """As M0 gives it."""
        return self.text(self._measured_mm(time_s))

    def outputs(self) -> str:
        """As MS gives them: GO."""
        return "4" if self.spec.kind == "GT2" else "04"

    def item(self, number: int, time_s: float) -> str:
        """One data item."""
        first = 0 if self.spec.kind == "GT2" else 37
        if number == 134:
            return "1"
        if number == (6 if first == 0 else 33):
            return f"{self.error_bits:05d}"
        if number == (5 if first == 0 else 36):
            return self.outputs()
        if number == first + (2 if first == 0 else 1):
            return self.text(self._raw_mm(time_s))
        if first <= number <= first + 4:
            return self.measured(time_s)
        if number in self._requests:
            return str(self._requests[number])
        raise Refused(PARAMETER)

    def write(self, number: int, data: str, time_s: float) -> None:
        """A request acts when it changes from 0 to 1."""
        if number not in self._requests or data not in ("0", "1"):
            raise Refused(PARAMETER)
        rising = data == "1" and self._requests[number] == 0
        self._requests[number] = int(data)
        if rising:
            self._held = None
            self._preset_mm = self._raw_mm(time_s) if number == PRESET else self._preset_mm


class DlRs1a:
    """The unit's end of the line: full duplex, one answer for each line."""

    def __init__(
        self,
        amplifiers: Sequence[Amplifier],
        baud: int = 9600,
        data_bits: int = 8,
        writable: bool = True,
        converter_s: float = CONVERTER_S,
    ) -> None:
        self.amplifiers = list(amplifiers)
        self.writable = writable  # its switch is on W
        self.uart = Uart(baud, data_bits + EXTRA_BITS, converter_s)
        self._input, self._up_s = b"", 0.0

    def restart(self, time_s: float) -> None:
        """Power comes back."""
        self._input, self._up_s = b"", time_s + BOOT_S
        self.uart.clear(self._up_s)

    def receive(self, data: bytes, time_s: float) -> None:
        """Lines that end with CR or CR LF."""
        if time_s < self._up_s:
            return
        self._input += data
        heard_s = self.uart.heard_s(len(data), time_s)
        while b"\r" in self._input:
            line, _, self._input = self._input.partition(b"\r")
            line = line.lstrip(b"\n")
            if line:
                self.uart.say(self._answer(line, heard_s).encode("ascii") + b"\r\n", heard_s + THINK_S)
        if len(self._input) > LONGEST_LINE:
            self._input = b""

    def next_output_s(self) -> float:
        """When the next bytes are handed over."""
        return self.uart.next_output_s()

    def take(self, time_s: float) -> bytes:
        """Everything handed over by then."""
        return self.uart.take(time_s)

    def discard(self, time_s: float) -> None:
        """Forget what was handed over by then."""
        self.take(time_s)

    # -- commands --------------------------------------------------------------------------------

    def _answer(self, line: bytes, time_s: float) -> str:
        words = line.decode("latin-1").split(",")
        try:
            return self._execute(words, time_s)
        except Refused as refused:
            return f"ER,{words[0][:2]},{refused.number}"

    def _execute(self, words: list[str], time_s: float) -> str:
        command, parameters = words[0], words[1:]
        if command in ("M0", "MS"):
            if parameters:
                raise Refused(PARAMETERS)
            items = [a.measured(time_s) for a in self.amplifiers]
            if command == "MS":
                items = [f"{a.outputs()},{item}" for a, item in zip(self.amplifiers, items, strict=True)]
            return ",".join([command, *items])
        if command not in ("SR", "SW"):
            raise Refused(INVALID_COMMAND)
        if len(parameters) != (2 if command == "SR" else 3):
            raise Refused(PARAMETERS)
        if any(not word.isdigit() for word in parameters[:2]):
            raise Refused(PARAMETER)
        if [len(word) for word in parameters[:2]] != [2, 3]:
            raise Refused(DATA_LENGTH)
        if int(parameters[0]) >= len(self.amplifiers):
            raise Refused(NO_AMPLIFIER)
        amplifier, number = self.amplifiers[int(parameters[0])], int(parameters[1])
        if command == "SR":
            return ",".join([*words, amplifier.item(number, time_s)])
        if not self.writable:
            raise Refused(WRITE_CONTROL)
        amplifier.write(number, parameters[2], time_s)
        return ",".join(words[:3])
