"""The force that a Robotiq FT 300 feels at its stylus, as a `PressSignal`, N."""

from typing import Final

import numpy as np

from drivers.capabilities import Identity, LinkHealth
from drivers.sensors.ft300 import Ft300
from estimation.transform import FloatArray

ZERO_READINGS: Final = 10  # averaged; the weight of the stylus depends on its orientation


class Ft300Press:
    """What differs from the force at `zero`."""

    def __init__(self, sensor: Ft300) -> None:
        self._sensor = sensor
        self._zero_n: FloatArray = np.zeros(3)

    def connect(self) -> Identity:
        """Connect the sensor, and forget the zero. Raises what the sensor raises."""
        self._zero_n = np.zeros(3)
        return self._sensor.connect()

    def close(self) -> None:
        """Release the sensor; safe twice."""
        self._sensor.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        return self._sensor.health()

    def zero(self) -> float:
        """Take the present force as that of a free stylus; its size before."""
        self._zero_n = self._mean(ZERO_READINGS)
        return float(np.linalg.norm(self._zero_n))

    def poll(self) -> tuple[float, float] | None:
        """The largest force of what has come, and when."""
        polled = self._sensor.poll()
        if polled is None:
            return None
        forces_n, received_s = polled
        return float(np.linalg.norm(forces_n - self._zero_n, axis=1).max()), received_s

    def fresh(self) -> float:
        """A force measured after the call."""
        return float(np.linalg.norm(self._mean(1) - self._zero_n))

    def _mean(self, count: int) -> FloatArray:
        self._sensor.begin_window()
        mean: FloatArray = self._sensor.end_window(count).force_n.mean(axis=0)
        return mean
