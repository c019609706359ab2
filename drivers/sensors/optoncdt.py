"""The RangeSensor capability of an optoNCDT 1420 on RS-422."""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from drivers.capabilities import Identity, LinkHealth, RangeReadings
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.sensors import optoncdt_codec as codec
from drivers.sensors.optoncdt_codec import CodeArray
from drivers.sensors.stream import Stream
from drivers.sensors.windows import can_freeze, refuse_frozen
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray

MOST_DRAINED_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class LaserConfig:
    """Settings of one sensor."""

    range_m: float  # measuring range
    range_start_m: float = 0.0  # distance of the start of the measuring range
    rate_hz: float = 2000.0
    baud: int = 921600
    model: str = ""  # compared with GETINFO if given, as are the serial number and the range
    serial_number: str = ""
    noise_m: float = 0.0  # of one value; 0 switches the search for a frozen value off
    working_range_m: tuple[float, float] | None = None  # distances outside are rejected
    stale_s: float = 0.0  # values may lie so long in the converter
    silence_s: float = 0.25  # without a value, after which the line counts as dead
    prompt_timeout_s: float = 0.5
    drain_silence_s: float = 0.002
    info_patterns: Mapping[str, str] = field(default_factory=lambda: dict(codec.INFO_PATTERNS))


class OptoncdtLaser:
    """Streams all the time; a window is what arrives between `begin_window` and `end_window`."""

    def __init__(self, link: ByteLink, config: LaserConfig, clock: Clock) -> None:
        self._link, self._config, self._clock = link, config, clock
        self._decoder = codec.StreamDecoder()
        self._stream = Stream(
            link,
            clock,
            self._decoder,
            name="Laser",
            item="value",
            line="cable and baud rate",
            period_s=1.0 / config.rate_hz,
            silence_s=config.silence_s,
            stale_s=config.stale_s,
        )
        self._opened = self._timeouts = 0
        self._connected = False
        self._watch_frozen = can_freeze(config.noise_m, codec.resolution(config.range_m))

    def connect(self) -> Identity:
        """Silence the stream, compare the identity, configure, start the stream.

        Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch.
        """
        config = self._config
        if config.rate_hz * 30 > config.baud:
            raise DeviceError(
                f"Laser: {config.rate_hz:g} values/s need {config.rate_hz * 30:g} baud, "
                f"the line has {config.baud}",
                "Lower the rate or raise the baud rate in the cell file",
            )
        self._connected = False
        self._link.reopen()
        self._opened += 1
        self._silence()
        info = codec.parse_info(self._command("GETINFO"), config.info_patterns)
        self._compare(info)
        for command in (
            f"MEASRATE {config.rate_hz / 1000:g}",
            "OUTREDUCEDEVICE NONE",
            "OUTADD_RS422 NONE",
            "MASTERMV NONE",  # a mastered sensor counts from elsewhere, in another scale
            "OUTPUT RS422",
        ):
            self._command(command)
        self._decoder.reset()
        self._decoder.discard_next()
        self._connected = True
        self.begin_window()
        self.end_window(1)
        return Identity(
            info["model"] or config.model,
            info["serial_number"],
            info["firmware"],
            (("range_mm", info["range_mm"]), ("rate_hz", f"{config.rate_hz:g}")),
        )

    def close(self) -> None:
        """Switch the stream off and release the port; safe twice."""
        if self._connected:
            self._connected = False
            with contextlib.suppress(DeviceError):
                self._link.write(b"OUTPUT NONE\n")
        self._link.close()

    def health(self) -> LinkHealth:
        """Link counters; three stray bytes count as one bad frame."""
        bad_frames = math.ceil(self._decoder.bad_bytes / 3)
        timeouts = self._timeouts + self._stream.timeouts
        return LinkHealth(self._stream.frames, bad_frames, timeouts, max(0, self._opened - 1))

    def begin_window(self) -> None:
        """Forget everything received so far."""
        if not self._connected:
            raise DeviceError("The laser is not connected", "Connect it first")
        self._stream.begin()

    def end_window(self, minimum: int) -> RangeReadings:
        """All cycles since `begin_window`, at least `minimum` of them; distances from the sensor's frame.

        Raises DeviceTimeout (silence), FrameError (unreadable), DeviceError (frozen).
        """
        window = self._stream.end(minimum)
        return self._readings(window.values, window.time_s)

    # --- values --------------------------------------------------------------------------------------

    def _readings(self, codes: CodeArray, time_s: FloatArray) -> RangeReadings:
        config = self._config
        good = codec.in_range(codes)
        kinds = tuple(sorted({codec.code_words(int(code)) for code in np.unique(codes[~good])}))
        distance_m = config.range_start_m + codec.distances(codes, config.range_m)
        if self._watch_frozen:
            refuse_frozen(distance_m[good])
        if config.working_range_m is not None:
            nearest_m, farthest_m = config.working_range_m
            working = (distance_m >= nearest_m) & (distance_m <= farthest_m)
            if not working[good].all():
                good &= working
                limits = f"{nearest_m * 1e3:g} to {farthest_m * 1e3:g} mm"
                kinds += (f"outside the working range of {limits}",)
        rejected = int(codes.size - np.count_nonzero(good))
        return RangeReadings(time_s[good], distance_m[good], rejected, kinds)

    # --- commands ------------------------------------------------------------------------------------

    def _silence(self) -> None:
        """OUTPUT NONE until it is answered: after a restart the sensor may still be streaming."""
        received, talks = b"", False
        for _ in range(3):
            self._link.write(b"OUTPUT NONE\n")
            data = self._read_until_prompt()
            received += data
            # The first command may have met the rest of another one, and was refused together with it.
            if codec.parse_reply(data) is not None:
                talks = True
                if self._drained():
                    return
        if talks:
            raise FrameError(
                f"Laser: still sending {MOST_DRAINED_S:g} s after OUTPUT NONE", "Switch the sensor off and on"
            )
        line = f"{self._config.baud} 8N1"
        if received:
            raise FrameError(
                f"Laser: no valid answer at {line}, but {len(received)} unreadable bytes",
                "Check the baud rate in the cell file and the polarity of the cable",
            )
        raise DeviceTimeout(f"Laser: no valid answer at {line}", "Check cable, power and baud rate")

    def _drained(self) -> bool:
        """Whether the sensor falls silent."""
        deadline_s = self._clock.now_s() + MOST_DRAINED_S
        while self._link.read(self._config.drain_silence_s):
            if self._clock.now_s() > deadline_s:
                return False
        return True

    def _command(self, command: str) -> codec.Reply:
        self._link.write(command.encode("ascii") + b"\n")
        reply = codec.parse_reply(self._read_until_prompt())
        if reply is None:
            self._timeouts += 1
            raise DeviceTimeout(
                f"Laser: no answer to {command} within {self._config.prompt_timeout_s:g} s",
                "Check cable and power",
            )
        if reply.error:
            raise DeviceError(
                f"Laser refused {command}: {reply.error}", "Check the settings of the laser in the cell file"
            )
        word = command.split(maxsplit=1)[0]
        if not any(line.upper().startswith(word) for line in reply.lines):
            raise FrameError(f"Laser answered {command} with {' / '.join(reply.lines)!r}", "Check the cable")
        return reply

    def _read_until_prompt(self) -> bytes:
        received, deadline_s = b"", self._clock.now_s() + self._config.prompt_timeout_s
        while codec.PROMPT not in received:
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0.0:
                break
            received += self._link.read(remaining_s)
        return received

    def _compare(self, info: Mapping[str, str]) -> None:
        """Another sensor, or another range, voids the calibration."""
        config = self._config
        if config.model and config.model.lower() not in info["model"].lower():
            raise self._mismatch("model", info["model"], config.model)
        if config.serial_number and info["serial_number"] != config.serial_number:
            raise self._mismatch("serial number", info["serial_number"], config.serial_number)
        range_mm = float(info["range_mm"]) if info["range_mm"] else math.nan
        if not math.isclose(range_mm, config.range_m * 1e3, rel_tol=1e-6):
            told = f"{info['range_mm']} mm" if info["range_mm"] else ""
            raise self._mismatch("measuring range", told, f"{config.range_m * 1e3:g} mm")

    @staticmethod
    def _mismatch(what: str, told: str, expected: str) -> IdentityMismatch:
        return IdentityMismatch(
            f"Laser: its {what} is {told or 'not told'}, the cell file says {expected}",
            "Connect the sensor that was calibrated, or correct the cell file and calibrate again",
        )
