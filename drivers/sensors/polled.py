"""The windows of a RangeSensor that is asked for each value."""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from drivers.capabilities import RangeReadings
from drivers.clock import Clock
from drivers.sensors.windows import can_freeze, poll, refuse_frozen
from estimation.errors import DeviceError


class Answer(NamedTuple):
    """One value, or why there is none."""

    distance_m: float  # nan if there is none
    received_s: float
    why: str = ""


class PolledRange(ABC):
    """Keeps the time: every value of a window was measured after `begin_window`, in a cycle of its own.

    `fresh_s` is how old a value can be when it comes; `noise_m` and `step_m` decide whether equal values are
    a sign of a frozen sensor.
    """

    def __init__(self, clock: Clock, name: str, *, fresh_s: float, noise_m: float, step_m: float) -> None:
        self._clock, self._name, self._fresh_s = clock, name, fresh_s
        self._watch_frozen = can_freeze(noise_m, step_m)
        self._connected = False
        self._begun_s = 0.0

    @abstractmethod
    def _ask(self) -> Answer:
        """One value. Raises DeviceError, DeviceTimeout, FrameError."""

    def begin_window(self) -> None:
        """Values are measured after now, and asked for in `end_window`."""
        if not self._connected:
            raise DeviceError(f"{self._name} is not connected", "Connect it first")
        self._begun_s = self._clock.now_s()

    def end_window(self, minimum: int) -> RangeReadings:
        """`minimum` values of different cycles. Raises as `_ask`, and DeviceError if the sensor is frozen."""
        kinds = set[str]()

        def value() -> tuple[float, float]:
            answer = self._ask()
            kinds.add(answer.why)
            return answer.distance_m, answer.received_s

        window = poll(self._clock, value, since_s=self._begun_s, minimum=minimum, period_s=self._fresh_s)
        self._begun_s = self._clock.now_s()
        good = ~np.isnan(window.values)
        distance_m = window.values[good]
        if self._watch_frozen:
            refuse_frozen(distance_m)
        rejected = int(good.size - np.count_nonzero(good))
        return RangeReadings(window.time_s[good], distance_m, rejected, tuple(sorted(kinds - {""})))


def no_value(received_s: float, why: str) -> Answer:
    """An answer that is no distance."""
    return Answer(math.nan, received_s, why)
