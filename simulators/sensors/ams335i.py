"""Leuze AMS 335i distance laser on CAN: CiA 406 class 1, an absolute linear encoder.

Source: AMS 335i technical description, pages 60 to 84; the bits of 2060h and 2070h are those of the AMS 338i.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from simulators.canopen_objects import Key, Row, Value, communication, entries_of, mapping
from simulators.canopen_slave import CanopenSlave
from simulators.sensors.beam import Beam

DEVICE_TYPE: Final = 0x00080196
LEUZE: Final = 0x121
POSITION: Final[Key] = (0x6004, 0)
STATUS: Final[Key] = (0x2060, 1)
ERROR_CHOICE: Final[Key] = (0x2070, 0)  # the subindex is not known
OPERATING: Final[Key] = (0x6000, 0)
LARGEST: Final = 999_999
ZERO, SUPPRESS, DELAY = 1, 4, 8  # bits of 2070h
IMPLAUSIBLE: Final = 1 << 16
REVERSED: Final = 1 << 3


def _table() -> list[Row]:
    return [
        (0x1000, 0, "u32", DEVICE_TYPE, "r"),
        (0x1001, 0, "u8", 0, "r"),
        (0x1005, 0, "u32", 0x80, "r"),
        (0x1008, 0, "text", "AMS335i", "r"),
        (0x1009, 0, "text", "1", "r"),
        (0x100A, 0, "text", "V1.0 simulated", "r"),
        (0x100C, 0, "u16", 0, "w"),
        (0x100D, 0, "u8", 0, "w"),
        (0x1014, 0, "u32", 0x80, "r"),
        (0x1017, 0, "u16", 0, "w"),
        (0x1018, 0, "u8", 4, "r"),
        *[(0x1018, sub, "u32", 0, "r") for sub in range(1, 5)],
        *communication(0x1800, 0x180, 254),
        *mapping(0x1A00, (0x60040020,)),
        *communication(0x1801, 0x280, 1),
        *mapping(0x1A01, (0x60040020, 0x20600120)),
        *communication(0x1802, 0x380, 254),
        *mapping(0x1A02, (0x20260120, 0x20260220)),
        *communication(0x1803, 0x480, 1),
        *mapping(0x1A03, (0x20260120, 0x20260220)),
        (0x2026, 0, "u8", 2, "r"),
        (0x2026, 1, "i32", 0, "rm"),
        (0x2026, 2, "u32", 0, "rm"),
        (0x2060, 0, "u8", 1, "r"),
        (0x2060, 1, "u32", 0, "rm"),
        (0x2070, 0, "u8", ZERO | SUPPRESS | DELAY, "w"),
        (0x6000, 0, "u16", 0, "w"),
        (0x6004, 0, "i32", 0, "rm"),
    ]


ENTRIES: Final = entries_of(_table())


@dataclass(frozen=True, slots=True)
class AmsSpec:
    """One sensor."""

    node: int = 16
    serial_number: int = 335_001
    step_m: float = 1e-4  # of its resolution setting
    noise_m: float = 0.0
    delay_s: float = 0.1  # for which the last good value stands


class Ams335i(CanopenSlave):
    """Sends position and status at every SYNC."""

    def __init__(
        self, spec: AmsSpec, beam: Beam, scale: float, offset_m: float, rng: np.random.Generator
    ) -> None:
        self._spec, self._beam, self._rng = spec, beam, rng
        self._scale, self._offset_m = scale, offset_m
        self.extra_status = 0  # bits added by hand: laser off, temperature ...
        self._measured = (-math.inf, 0, 0)  # when, position, status: one measurement for all that ask then
        self._good_s, self._good = -math.inf, 0
        identity: dict[Key, Value] = {(0x1018, 1): LEUZE, (0x1018, 2): 335, (0x1018, 4): spec.serial_number}
        super().__init__(spec.node, ENTRIES, identity)

    def live(self, key: Key, time_s: float) -> Value | None:
        """What is measured at that instant."""
        if key not in (POSITION, STATUS):
            return None
        if self._measured[0] != time_s:
            self._measured = (time_s, *self._measure(time_s))
        return self._measured[1 if key == POSITION else 2]

    def _measure(self, time_s: float) -> tuple[int, int]:
        true_m = float(self._beam.beam_lengths_m(np.array([time_s]))[0])
        noise_m = float(self._rng.standard_normal()) * self._spec.noise_m
        reading_m = (true_m - self._offset_m) / (1 + self._scale) + noise_m
        if not math.isnan(reading_m) and 0 < (steps := round(reading_m / self._spec.step_m)) <= LARGEST:
            sign = -1 if int(self.values[OPERATING]) & REVERSED else 1
            self._good_s, self._good = time_s, sign * steps
            return self._good, self.extra_status
        choice = int(self.values[ERROR_CHOICE])
        delayed = bool(choice & DELAY) and time_s - self._good_s < self._spec.delay_s
        hidden = delayed and bool(choice & SUPPRESS)
        position = 0 if choice & ZERO and not delayed else self._good
        return position, self.extra_status | (0 if hidden else IMPLAUSIBLE)
