"""The RangeSensor capability of a RIFTEK RF60x in its binary protocol: a stream of results."""

import contextlib
import math
from typing import Final

from drivers.capabilities import Identity, LinkHealth, RangeReadings
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.sensors import riftek_codec as codec
from drivers.sensors.riftek_settings import BITS_PER_BYTE, RiftekConfig, compare, readings
from drivers.sensors.stream import Stream
from estimation.errors import DeviceError, DeviceTimeout, FrameError

STOPS: Final = 2  # the first may meet the rest of another request
QUIET_BYTES: Final = 4  # so long nothing may follow an answer


class RiftekLaser:
    """Streams all the time; a window is what arrives between `begin_window` and `end_window`.

    The protocol has no checksum. A packet is known by its number, and its bytes by their parity: on a line
    that checks it, a damaged byte arrives as NUL, which no answer contains.
    """

    def __init__(self, link: ByteLink, config: RiftekConfig, clock: Clock) -> None:
        self._link, self._config, self._clock = link, config, clock
        self._decoder = codec.ResultDecoder()
        self._stream = Stream(
            link,
            clock,
            self._decoder,
            name="Laser",
            item="result",
            line="cable, baud rate and even parity",
            period_s=config.period_us * 1e-6,
            silence_s=config.silence_s,
            stale_s=config.stale_s,
        )
        self._byte_s = BITS_PER_BYTE / config.baud
        self._opened = self._answers = self._bad_frames = self._timeouts = 0
        self._number = -1  # of the last answer
        self._connected = False

    def connect(self) -> Identity:
        """Stop the stream, compare the identity, set and read back the parameters, start the stream.

        Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch.
        """
        config = self._config
        need_baud = codec.RESULT_NIBBLES * BITS_PER_BYTE * config.rate_hz
        if need_baud > config.baud:
            raise DeviceError(
                f"Laser: {config.rate_hz:g} results/s need {need_baud:g} baud, the line has {config.baud}",
                "Lower the rate, or raise the baud rate of the laser and in the cell file",
            )
        self._connected = False
        self._link.reopen()
        self._opened += 1
        self._number = -1
        self._stop_stream()
        told = self._ask(codec.request(config.address, codec.IDENTIFY), 8)
        identity = compare(config, codec.parse_head(told))
        for parameter, value in (
            (codec.LASER_ON, 1),
            (codec.CONTROL, self._read(codec.CONTROL) & 0xFE),  # sample by time, not by trigger
            (codec.AVERAGES, config.averages),
            (codec.PERIOD_HIGH, config.period_us >> 8),
            (codec.PERIOD_LOW, config.period_us & 0xFF),
            (codec.HOLD, 0),  # a result that is held is older than it looks
        ):
            self._write(parameter, value)
        self._link.write(codec.request(config.address, codec.STREAM))
        self._connected = True
        self.begin_window()
        self.end_window(1)
        return identity

    def close(self) -> None:
        """Stop the stream and release the port; safe twice."""
        if self._connected:
            self._connected = False
            with contextlib.suppress(DeviceError):
                self._link.write(codec.request(self._config.address, codec.STOP))
        self._link.close()

    def health(self) -> LinkHealth:
        """Link counters; a packet that is missing in the numbering, or four stray bytes, is one bad frame."""
        decoder = self._decoder
        bad = self._bad_frames + decoder.lost + math.ceil(decoder.bad_bytes / codec.RESULT_NIBBLES)
        frames, timeouts = self._answers + self._stream.frames, self._timeouts + self._stream.timeouts
        return LinkHealth(frames, bad, timeouts, max(0, self._opened - 1))

    def begin_window(self) -> None:
        """Forget everything received so far."""
        if not self._connected:
            raise DeviceError("The laser is not connected", "Connect it first")
        self._stream.begin()

    def end_window(self, minimum: int) -> RangeReadings:
        """All results since `begin_window`, at least `minimum` of them.

        Raises DeviceTimeout (silence), FrameError (unreadable), DeviceError (frozen).
        """
        window = self._stream.end(minimum)
        return readings(self._config, window.values, window.time_s)

    # --- requests ------------------------------------------------------------------------------------

    def _stop_stream(self) -> None:
        """Stop, drain, and stay silent longer than the slowest answer: the head may still be streaming."""
        for _ in range(STOPS):
            self._link.write(codec.request(self._config.address, codec.STOP))
        deadline_s = self._clock.now_s() + 1.0
        while self._link.read(self._config.worst_answer_s):
            if self._clock.now_s() > deadline_s:
                raise FrameError("Laser: still sending 1 s after it was stopped", "Switch it off and on")

    def _read(self, parameter: int) -> int:
        return self._ask(codec.read_request(self._config.address, parameter), 1)[0]

    def _write(self, parameter: int, value: int) -> None:
        """A write is not acknowledged: read it back."""
        self._link.write(codec.write_request(self._config.address, parameter, value))
        told = self._read(parameter)
        if told != value:
            raise DeviceError(
                f"Laser: parameter {parameter:02X}h is {told} after {value} was written",
                "Check the settings of the laser in the cell file",
            )

    def _ask(self, request: bytes, size: int) -> bytes:
        """The answer of `size` bytes, and nothing after it."""
        packet = self._exchange(request, 2 * size)
        expected = (self._number + 1) % 4
        if self._number >= 0 and packet.number != expected:
            self._bad_frames += 1
            raise FrameError(
                f"Laser: answer number {packet.number} instead of {expected}",
                "Look for a second master on the line",
            )
        self._number = packet.number
        self._answers += 1
        return packet.data

    def _exchange(self, request: bytes, nibbles: int) -> codec.Packet:
        self._link.write(request)
        on_the_way_s = (len(request) + nibbles) * self._byte_s
        deadline_s = self._clock.now_s() + on_the_way_s + self._config.worst_answer_s
        received = b""
        while len(received) < nibbles:
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0.0:
                self._timeouts += 1
                raise DeviceTimeout(
                    f"Laser: {len(received)} of {nibbles} bytes at {self._config.baud} baud 8E1",
                    "Check cable, power, baud rate and address",
                )
            received += self._link.read(remaining_s)
        received += self._link.read(QUIET_BYTES * self._byte_s)
        if len(received) != nibbles:
            self._bad_frames += 1
            raise FrameError(
                f"Laser: {len(received)} bytes instead of {nibbles}", "Look for a second master on the line"
            )
        return codec.parse_packet(received)
