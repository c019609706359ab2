"""The TouchProbe capability of a sensor that measures how hard, or how far, its stylus is pressed.

A contact is a signal that rises over a threshold. What the stylus weighs is taken off at `arm`.
"""

from dataclasses import dataclass
from typing import Protocol

from drivers.capabilities import Device, Identity, LinkHealth
from drivers.clock import Clock
from estimation.errors import DeviceError


class PressSignal(Device, Protocol):
    """A sensor that feels its stylus, in N or m."""

    def zero(self) -> float:
        """Take the present state as free. Returns its size before, for a look at whether it can be."""

    def poll(self) -> tuple[float, float] | None:
        """The latest value that has come, and when; None if none has. Waits for one period at most.

        Raises DeviceTimeout, FrameError.
        """

    def fresh(self) -> float:
        """A value measured after the call."""


@dataclass(frozen=True, slots=True)
class ThresholdConfig:
    """When a signal means contact. `unit` is that of the limits, as shown to people."""

    threshold: float
    release: float  # below it the stylus is free again
    free_limit: float  # largest signal of a free stylus, in any orientation
    unit: str
    period_s: float  # between two values
    latency_s: float  # from the contact until its value has come
    longest_gap_s: float = 0.1  # a touch between values further apart is refused


class ThresholdProbe:
    """A probe on a `PressSignal`."""

    def __init__(self, signal: PressSignal, config: ThresholdConfig, clock: Clock) -> None:
        if not 0.0 < config.release < config.threshold:
            raise DeviceError(
                f"The probe releases at {config.release:g} {config.unit}, trips at {config.threshold:g}",
                "Set a release between zero and the threshold",
            )
        self._signal, self._config, self._clock = signal, config, clock
        self._armed = False
        self._clear_s = self._gap_s = 0.0
        self._touched_s: float | None = None

    def connect(self) -> Identity:
        """Connect the sensor. Raises what it raises."""
        self._armed, self._touched_s = False, None
        return self._signal.connect()

    def close(self) -> None:
        """Release the sensor; safe twice."""
        self._signal.close()

    def health(self) -> LinkHealth:
        """Link counters of the sensor."""
        return self._signal.health()

    def arm(self) -> None:
        """Take the present signal off. Raises DeviceError if it is more than a free stylus can show."""
        config = self._config
        self._armed, self._touched_s, self._gap_s = False, None, 0.0
        before = self._signal.zero()
        if before > config.free_limit:
            raise DeviceError(
                f"The probe shows {before:.3g} {config.unit} before the approach, "
                f"limit {config.free_limit:g} {config.unit}",
                "Free the stylus; if it is free, check its mount and the limit",
            )
        self._clear_s, self._armed = self._clock.now_s(), True

    def touched_at_s(self) -> float | None:
        """One poll: the latest instant at which contact can have begun, or None if not touched."""
        if self._touched_s is not None:
            return self._touched_s
        if not self._armed:
            raise DeviceError("The probe is not armed", "Arm it before the approach")
        value = self._signal.poll()
        if value is None:
            return None
        pressed, received_s = value
        if pressed < self._config.threshold:
            self._clear_s = received_s
            return None
        self._gap_s = received_s - self._clear_s
        if self._gap_s > self._config.longest_gap_s:
            raise DeviceError(
                f"Touched between values {self._gap_s * 1e3:.0f} ms apart, "
                f"limit {self._config.longest_gap_s * 1e3:.0f} ms",
                "Touch again; if it recurs, check the cable and the load of the computer",
            )
        self._touched_s = received_s
        return received_s

    @property
    def poll_uncertainty_s(self) -> float:
        """Longest time between contact and its detection: as configured, or of the last touch if longer."""
        return max(self._config.period_s, self._gap_s) + self._config.latency_s

    def is_open(self) -> bool:
        """The stylus touches nothing now, read afresh."""
        return self._signal.fresh() < self._config.release
