"""The RTDE connection of a Universal Robots controller: packages that are sampled after the question.

The stream is paused while nobody asks, so that no old packages pile up. Packages carry the time of the
controller, which is put on the driver's clock.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.robots import ur_codec as codec
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch

MOST_DRIFT: Final = 200e-6  # s/s, of the controller's clock against ours
MOST_JUMP_S: Final = 0.05  # by which a package may seem to come from the future
KEPT_PACKAGES: Final = 256  # two seconds at 125 Hz


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """A package, and when it was sampled on the driver's clock: at that instant or shortly before."""

    time_s: float
    package: codec.Package


class RtdeConnection:
    """One client of the controller, set up by `open`. After a timeout or a bad frame it opens itself anew."""

    def __init__(
        self, link: ByteLink, recipe: codec.Recipe, clock: Clock, *, rate_hz: float, reply_timeout_s: float
    ) -> None:
        self._link, self._recipe, self._clock = link, recipe, clock
        self._rate_hz, self._reply_timeout_s = rate_hz, reply_timeout_s
        self._reader = codec.FrameReader()
        self.received: deque[Received] = deque(maxlen=KEPT_PACKAGES)
        self._version = b""
        self._lost = self._streaming = False
        self._least_delay_s: float | None = None
        self._delay_at_s = 0.0
        self.frames = self.bad_frames = self.timeouts = self.opened = 0

    @property
    def version(self) -> str:
        """Software of the controller."""
        return ".".join(str(int.from_bytes(self._version[i : i + 4], "big")) for i in range(0, 16, 4))

    def open(self) -> None:
        """Connect, agree on protocol and fields. Raises DeviceError, DeviceTimeout, FrameError."""
        self._version = b""
        self._set_up()

    def close(self) -> None:
        """Leave; safe twice."""
        self._link.close()

    def fresh(self, *, keep_streaming: bool = False) -> Received:
        """A package sampled after the call; once more on a new connection if the first try fails."""
        try:
            return self._attempt(keep_streaming)
        except (DeviceTimeout, FrameError):
            return self._attempt(keep_streaming)

    def stream(self) -> None:
        """Let packages come until a `fresh` one is asked for without `keep_streaming`."""
        self._recover()
        if not self._streaming:
            self._start()

    def until(self, time_s: float) -> None:
        """Receive until a package was sampled at `time_s` or later; the stream must be on."""
        while not self.received or self.received[-1].time_s < time_s:
            self._next_package()

    # --- packages ------------------------------------------------------------------------------------

    def _attempt(self, keep_streaming: bool) -> Received:
        self._recover()
        if self._streaming:
            self._drain()
            self._next_package()  # may have been under way already
        else:
            self._start()
        found = self._next_package()
        if not keep_streaming:
            self._ask(codec.PAUSE)
            self._streaming = False
        return found

    def _start(self) -> None:
        self.received.clear()
        if self._ask(codec.START) != b"\x01":
            self._lose()
            raise FrameError("RTDE refuses to start", "Check the message on the pendant, then reset")
        self._streaming = True

    def _drain(self) -> None:
        while data := self._link.read(0.0):
            self._reader.feed(data)
        while (frame := self._frame()) is not None:
            self._take(*frame)

    def _next_package(self) -> Received:
        deadline_s = self._clock.now_s() + self._reply_timeout_s
        while True:
            kind, payload = self._receive(deadline_s, "data")
            self._take(kind, payload)
            if kind == codec.DATA:
                return self.received[-1]

    def _take(self, kind: int, payload: bytes) -> None:
        """A frame that answers no question."""
        if kind == codec.DATA:
            try:
                package = self._recipe.parse(payload)
                self.received.append(Received(self._time_of(package.timestamp_s), package))
            except FrameError:
                self._lose()
                raise

    def _time_of(self, timestamp_s: float) -> float:
        """Controller's time on our clock. The least delay seen is what a package takes anyway.

        A clock that drifts makes delays look longer or shorter, so the least delay is forgotten as fast.
        """
        now = self._clock.now_s()
        delay_s = now - timestamp_s
        if self._least_delay_s is not None:
            drift_s = MOST_DRIFT * (now - self._delay_at_s)
            if delay_s < self._least_delay_s - drift_s - MOST_JUMP_S:
                raise FrameError(
                    "RTDE sent a package from the future", "Reset; check the network if it recurs"
                )
            delay_s = min(delay_s, self._least_delay_s + drift_s)
        self._least_delay_s, self._delay_at_s = delay_s, now
        return timestamp_s + delay_s

    # --- frames --------------------------------------------------------------------------------------

    def _set_up(self) -> None:
        self._link.reopen()
        self.opened += 1
        self._reader.clear()
        self.received.clear()
        self._least_delay_s, self._streaming, self._lost = None, False, False
        if self._ask(codec.VERSION, codec.PROTOCOL) != b"\x01":
            raise DeviceError("The controller does not speak RTDE version 2", "Use software 3.2 or newer")
        version = self._ask(codec.CONTROLLER)
        if len(version) != 16:
            raise FrameError(
                f"RTDE sent a version of {len(version)} bytes, expected 16", "Check that the port is RTDE's"
            )
        if self._version and version != self._version:
            raise IdentityMismatch("Another controller answers than before", "Check the network, then reset")
        self._version = version
        self._recipe.accept(self._ask(codec.OUTPUTS, self._recipe.request(self._rate_hz)))

    def _recover(self) -> None:
        if self._lost:
            self._set_up()

    def _ask(self, kind: int, payload: bytes = b"") -> bytes:
        """The answer of the same type; data packages that come before it are kept."""
        self._link.write(codec.encode(kind, payload))
        deadline_s = self._clock.now_s() + self._reply_timeout_s
        while True:
            found, answer = self._receive(deadline_s, f"answer to {chr(kind)}")
            if found == kind:
                return answer
            if found not in (codec.DATA, codec.TEXT):
                self._lose()
                raise FrameError(
                    f"RTDE answered {chr(found)} to {chr(kind)}", "Reset; check the network if it recurs"
                )
            self._take(found, answer)

    def _receive(self, deadline_s: float, what: str) -> tuple[int, bytes]:
        while (frame := self._frame()) is None:
            remaining_s = deadline_s - self._clock.now_s()
            data = self._link.read(max(remaining_s, 0.0))
            self._reader.feed(data)
            if not data and remaining_s <= 0.0:
                self._lost = True
                self.timeouts += 1
                raise DeviceTimeout(
                    f"RTDE: no {what} within {self._reply_timeout_s:g} s",
                    "Check network cable and power of the controller",
                )
        return frame

    def _frame(self) -> tuple[int, bytes] | None:
        try:
            frame = self._reader.next_frame()
        except FrameError:
            self._lose()
            raise
        self.frames += frame is not None
        return frame

    def _lose(self) -> None:
        """What comes now cannot be told apart any more: only a new connection helps."""
        self._lost = True
        self.bad_frames += 1
