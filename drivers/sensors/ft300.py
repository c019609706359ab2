"""The ForceSensor capability of a Robotiq FT 300: set up by Modbus RTU, then a stream of frames.

While it streams it hears no Modbus.
"""

import contextlib
import math
from dataclasses import dataclass
from typing import Final

from drivers.capabilities import ForceReadings, Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.links.modbus_rtu import ModbusRtu
from drivers.sensors import ft300_codec as codec
from drivers.sensors.stream import Stream
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray

MODEL: Final = "Robotiq FT 300"
JAM: Final = b"\xff" * 50  # ends a stream
JAMS: Final = 3
QUIET_S: Final = 0.1  # after a stream, before Modbus
SILENCE_S: Final = 0.16  # without a valid frame: a bad link
PERIOD_S: Final = 1.0 / codec.RATE_HZ


@dataclass(frozen=True, slots=True)
class Ft300Config:
    """Settings of one sensor."""

    serial_number: str = ""  # compared if given
    worst_answer_s: float = 0.1
    silence_s: float = SILENCE_S
    stale_s: float = 0.02  # values may lie so long in sensor and converter


class Ft300:
    """Streams all the time; a window is what arrives between `begin_window` and `end_window`."""

    def __init__(self, link: ByteLink, config: Ft300Config, clock: Clock) -> None:
        self._link, self._config, self._clock = link, config, clock
        self._modbus = ModbusRtu(
            link,
            clock,
            name="Force sensor",
            unit=codec.UNIT,
            baud=codec.BAUD,
            bits_per_byte=codec.BITS_PER_BYTE,
            worst_answer_s=config.worst_answer_s,
        )
        self._decoder = codec.StreamDecoder()
        self._stream = Stream(
            link,
            clock,
            self._decoder,
            name="Force sensor",
            item="valid frame",
            line="cable and baud rate",
            period_s=PERIOD_S,
            silence_s=config.silence_s,
            stale_s=config.stale_s,
        )
        self._opened = 0
        self._connected = False
        self._heard_s = self._polled_s = 0.0  # the last valid frame, while polling

    def connect(self) -> Identity:
        """End a stream left over, compare the identity, start the stream.

        Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch.
        """
        self._connected = False
        self._link.reopen()
        self._opened += 1
        self._stop_stream()
        self._modbus.reset()
        identity = self._identity()
        with contextlib.suppress(DeviceTimeout, FrameError):  # the acknowledge may drown in the stream
            self._modbus.write_registers(codec.STREAM_REGISTER, [codec.STREAM_ON])
        self._connected = True
        self.begin_window()
        self.end_window(1)
        return identity

    def close(self) -> None:
        """End the stream and release the port; safe twice."""
        if self._connected:
            self._connected = False
            with contextlib.suppress(DeviceError):
                self._link.write(JAM)
        self._link.close()

    def health(self) -> LinkHealth:
        """Link counters; sixteen stray bytes count as one bad frame."""
        modbus = self._modbus
        bad = modbus.bad_frames + math.ceil(self._decoder.bad_bytes / codec.FRAME_BYTES)
        frames, timeouts = modbus.frames + self._stream.frames, modbus.timeouts + self._stream.timeouts
        return LinkHealth(frames, bad, timeouts, max(0, self._opened - 1))

    def begin_window(self) -> None:
        """Forget everything received so far."""
        if not self._connected:
            raise DeviceError("The force sensor is not connected", "Connect it first")
        self._stream.begin()
        self._heard_s = self._clock.now_s()

    def end_window(self, minimum: int) -> ForceReadings:
        """All cycles measured since `begin_window`, at least `minimum`. Raises DeviceTimeout, FrameError."""
        window = self._stream.end(minimum)
        self._heard_s = float(window.time_s[-1])
        return ForceReadings(window.time_s, window.values[:, :3], window.values[:, 3:])

    def poll(self) -> tuple[FloatArray, float] | None:
        """Forces (n, 3) of the frames that have come by now, and when. Waits for one period at most.

        Raises DeviceTimeout, FrameError once there was no valid frame for too long.
        """
        asked_s = self._clock.now_s()
        if asked_s - self._polled_s > 2.0 * PERIOD_S:
            self._heard_s = asked_s  # nobody listened
        wrenches = self._decoder.feed(self._link.read(PERIOD_S))
        self._polled_s = now = self._clock.now_s()
        if len(wrenches):
            self._heard_s = now
            self._stream.frames += len(wrenches)
            return wrenches[:, :3], now
        if now - self._heard_s > self._config.silence_s:
            raise self._stream.silent(0)
        return None

    # --- set-up --------------------------------------------------------------------------------------

    def _stop_stream(self) -> None:
        """It may be streaming from an earlier session, and hears nothing else then."""
        for _ in range(JAMS):
            self._link.write(JAM)
            deadline_s = self._clock.now_s() + len(JAM) * codec.BITS_PER_BYTE / codec.BAUD + 4 * QUIET_S
            while self._link.read(QUIET_S):
                if self._clock.now_s() > deadline_s:
                    break
            else:
                return
        raise FrameError(
            f"Force sensor: still sending after {JAMS * len(JAM)} bytes that end a stream",
            "Switch the sensor off and on",
        )

    def _identity(self) -> Identity:
        registers = self._modbus.read_holding_registers(codec.FIRMWARE_REGISTER, codec.INFO_REGISTERS)
        firmware, serial = codec.text(registers[:10]), codec.text(registers[10:14])
        if not firmware.startswith("F"):
            raise IdentityMismatch(
                f"Unit {codec.UNIT} calls its firmware {firmware!r}, not F...",
                "Connect a Robotiq FT 300, or correct the cell file",
            )
        expected = self._config.serial_number
        if expected not in ("", serial):
            raise IdentityMismatch(
                f"Force sensor: its serial number is {serial}, the cell file says {expected}",
                "Connect the sensor that was calibrated, or correct the cell file and calibrate again",
            )
        return Identity(MODEL, serial, firmware, (("year", str(registers[14])),))
