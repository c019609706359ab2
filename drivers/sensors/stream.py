"""A sensor that sends all the time: what arrives from now on, when, and whether anything arrives at all."""

from typing import Any, Final, Protocol

import numpy as np

from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.sensors.windows import Values, Window
from estimation.errors import DeviceError, DeviceTimeout, FrameError
from estimation.transform import FloatArray

LONGEST_PAUSE_S: Final = 0.05  # between two reads while many values are still to come


class Decoder(Protocol):
    """Finds the values in the bytes, however they are split."""

    bad_bytes: int  # dropped, because they fitted nowhere

    def reset(self) -> None:
        """After input was dropped: forget an incomplete value."""

    def feed(self, data: bytes) -> Any:
        """The values (n, ...) that are complete with these bytes."""


class Stream:
    """A window is what arrives between `begin` and `end`; `frames` and `timeouts` count over all of them."""

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        decoder: Decoder,
        *,
        name: str,
        item: str,
        line: str,
        period_s: float,
        silence_s: float,
        stale_s: float,
    ) -> None:
        """Values `item` of the device `name`, one each `period_s`; `line` says what may garble its bytes.

        Without a value for `silence_s` the line is dead; values may lie in a converter for `stale_s`.
        """
        self._link, self._clock, self._decoder = link, clock, decoder
        self._name, self._item, self._line = name, item, line
        self._period_s, self._silence_s, self._stale_s = period_s, silence_s, stale_s
        self.frames = self.timeouts = 0

    def begin(self) -> None:
        """Forget everything received so far."""
        self._clock.sleep(self._stale_s)  # what lies in the converter now comes within
        self._link.discard_input()
        self._decoder.reset()

    def end(self, minimum: int) -> Window:
        """At least `minimum` values since `begin`, and one. Raises DeviceTimeout (silence), FrameError."""
        bad_before = self._decoder.bad_bytes
        window = self._collected(minimum)
        self.frames += len(window.values)
        if len(window.values) < max(minimum, 1):
            raise self.silent(self._decoder.bad_bytes - bad_before)
        return window

    def silent(self, bad_bytes: int) -> DeviceError:
        """What to say when no value came for too long."""
        self.timeouts += 1
        limit_s = self._silence_s
        if bad_bytes > 0:
            return FrameError(
                f"{self._name}: {bad_bytes} unreadable bytes and no {self._item} in {limit_s:g} s",
                f"Check {self._line}",
            )
        return DeviceTimeout(f"{self._name}: no {self._item} for {limit_s:g} s", "Check cable and power")

    def _collected(self, minimum: int) -> Window:
        """At least `minimum` values and whatever else has come; fewer if there was none for too long.

        The receive time is spread by the period of the sensor over the values that came at once.
        """
        clock, period_s = self._clock, self._period_s
        chunks, times, got = list[Values](), list[FloatArray](), 0
        heard_s = clock.now_s()
        while got < minimum or not chunks:
            data = self._link.read(period_s)
            now = clock.now_s()
            values = self._decoder.feed(data) if data else None
            if values is not None and len(values):
                heard_s = now
                chunks.append(values)
                times.append(now - period_s * np.arange(len(values) - 1, -1, -1, dtype=np.float64))
                got += len(values)
                missing = minimum - got
                if missing > 1:
                    clock.sleep(min(missing * period_s, LONGEST_PAUSE_S))
            elif now - heard_s >= self._silence_s:
                break
        if not chunks:
            return Window(self._decoder.feed(b""), np.empty(0))
        return Window(np.concatenate(chunks), np.concatenate(times))
