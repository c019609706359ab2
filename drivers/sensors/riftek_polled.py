"""What the two protocols of a RIFTEK head have in common in which it is asked for each result."""

import math
from abc import abstractmethod

import numpy as np

from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.sensors import riftek_codec as codec
from drivers.sensors.polled import Answer, PolledRange, no_value
from drivers.sensors.riftek_settings import RiftekConfig, compare


class PolledRiftek(PolledRange):
    """One request for each result; identity again after every failure."""

    def __init__(self, link: ByteLink, config: RiftekConfig, clock: Clock) -> None:
        super().__init__(
            clock,
            "Laser",
            fresh_s=config.result_s,
            noise_m=config.noise_m / math.sqrt(config.averages),
            step_m=codec.resolution(config.range_m),
        )
        self._link, self._config = link, config
        self._opened = 0

    @abstractmethod
    def _result(self) -> tuple[int, float]:
        """A result in increments, and when it came. Raises DeviceError, DeviceTimeout, FrameError."""

    @abstractmethod
    def _head(self) -> codec.Head:
        """Who answers. Raises DeviceError, DeviceTimeout, FrameError."""

    def close(self) -> None:
        """Release the port; safe twice."""
        self._connected = False
        self._link.close()

    def _ask(self) -> Answer:
        code, received_s = self._result()
        if code in self._config.no_target_codes:
            return no_value(received_s, "no target")
        if code > codec.FULL_RANGE:
            return no_value(received_s, "beyond the measuring range")
        result_m = float(codec.distances(np.array([code]), self._config.range_m)[0])
        return Answer(self._config.base_m + result_m, received_s)

    def _after_failure(self) -> None:
        """Part of the resynchronisation: the head that answers now is still the one that was asked."""
        if self._connected:
            compare(self._config, self._head())
