"""What a device that runs alone measures: values that tell when they were measured, and their faults."""

import math
from dataclasses import replace
from typing import Final

import numpy as np

from estimation.errors import CellFileError
from estimation.transform import FloatArray
from simulators.faults import Fault

KINDS: Final = {
    "stuck": "stays as it was",
    "lost": "is lost: no target, an open circuit",
    "jump": "is off by VALUE, in the unit of the signal",
    "drift": "runs away by VALUE per second",
}


class Signal:
    """Rises from `low` to `high` in `period_s` seconds, then begins again: a value gives away its instant."""

    def __init__(self, low: float, high: float, period_s: float) -> None:
        self.low, self.high, self.period_s = low, high, period_s
        self._faults = list[Fault]()

    def schedule(self, fault: Fault) -> None:
        """Let this fault of KINDS happen; without an end it lasts for ever."""
        if fault.kind not in KINDS:
            raise CellFileError(
                f"No signal has the fault {fault.kind!r}", f"Choose one of {', '.join(KINDS)}"
            )
        if math.isinf(fault.from_s):
            fault = replace(fault, from_s=0.0)
        self._faults.append(fault)

    def at(self, times_s: FloatArray) -> FloatArray:
        """Values (n,) at these instants (n,); nan while the signal is lost."""
        times_s = np.array(times_s, dtype=float)
        offset = np.zeros_like(times_s)
        for fault in self._faults:
            struck = (times_s >= fault.from_s) & (times_s < fault.until_s)
            if fault.kind == "stuck":
                times_s[struck] = fault.from_s
            elif fault.kind == "lost":
                offset[struck] = math.nan
            elif fault.kind == "jump":
                offset[struck] += fault.value or 0.0
            else:
                offset[struck] += (fault.value or 0.0) * (times_s[struck] - fault.from_s)
        return self.low + (self.high - self.low) * (times_s / self.period_s % 1.0) + offset

    def value(self, time_s: float) -> float:
        """The same at one instant."""
        return float(self.at(np.array([time_s]))[0])

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        """As seen by a distance sensor."""
        return self.at(times_s)

    def instant_s(self, value: float, near_s: float) -> float:
        """When this value was measured; of all such instants the one that is nearest to `near_s`."""
        within_s = (value - self.low) / (self.high - self.low) * self.period_s
        return within_s + round((near_s - within_s) / self.period_s) * self.period_s


class Ticker:
    """A contact that closes once per period, for half of it; `count` tells when it was read."""

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.closed, self.count = False, 0

    def update(self, time_s: float) -> None:
        """Bring `closed` and `count` up to that instant."""
        periods = time_s / self.period_s + 1e-9  # an edge has come when its instant has
        self.count = math.floor(periods)
        self.closed = periods % 1.0 < 0.5

    def unchanged_until_s(self, time_s: float) -> float:
        """`closed` does not change before this."""
        return (math.floor(time_s / self.period_s * 2.0 + 1e-9) + 1.0) * self.period_s / 2.0
