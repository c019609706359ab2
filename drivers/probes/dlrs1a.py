"""How far a Keyence GT2 contact gauge is pressed, as a `PressSignal`, m."""

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.sensors.dlrs1a import DlRs1a
from estimation.errors import DeviceError


class GaugePress:
    """What the spindle has moved since `zero`. Each poll is one question."""

    def __init__(self, gauge: DlRs1a, clock: Clock, response_s: float) -> None:
        self._gauge, self._clock, self._response_s = gauge, clock, response_s
        self._zero_m = 0.0

    def connect(self) -> Identity:
        """Connect the unit, and forget the zero. Raises what it raises."""
        self._zero_m = 0.0
        return self._gauge.connect()

    def close(self) -> None:
        """Release the unit; safe twice."""
        self._gauge.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        return self._gauge.health()

    def zero(self) -> float:
        """Take the present position as that of a free spindle; its size before."""
        self._clock.sleep(self._response_s)
        self._zero_m, _ = self._position()
        return abs(self._zero_m)

    def poll(self) -> tuple[float, float] | None:
        """The position now, and when it came."""
        position_m, received_s = self._position()
        return abs(position_m - self._zero_m), received_s

    def fresh(self) -> float:
        """A position measured after the call."""
        self._clock.sleep(self._response_s)
        return abs(self._position()[0] - self._zero_m)

    def _position(self) -> tuple[float, float]:
        position_m, received_s = self._gauge.read_raw()
        if position_m is None:
            raise DeviceError(
                "Probe: the gauge gives no value", "Look at the amplifier's display and the gauge's stroke"
            )
        return position_m, received_s
