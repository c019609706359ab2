"""A CAN bus as a CanLink: an slcan dongle on a serial port, or a SocketCAN interface, by python-can.

The check of CAN ends in the dongle; its lines have none. The digit behind the identifier says how long a line
is: a byte that was lost or doubled, and a lost CR, are found. A hexadecimal digit that became another is not.
"""

import contextlib
import re
import threading
from collections.abc import Sequence
from typing import Any, Final

import can
import serial
from can.exceptions import error_check
from can.interfaces.slcan import slcanBus

from drivers.clock import Clock, RealClock
from drivers.links.interfaces import CanFrame
from drivers.links.meter import LinkMeter, LinkStatistics
from drivers.links.serial_port import opening_failed
from estimation.errors import DeviceError

SEND_TIMEOUT_S: Final = 0.5
ERROR_BUS_OFF: Final = 0x40  # SocketCAN error class, in the identifier of an error frame
LONGEST_LINE: Final = 1024
_LINE: Final = re.compile(rb"[^\r\a]*[\r\a]")  # BEL ends the answer to a refused command
_FRAME: Final = re.compile(r"(t[0-9A-Fa-f]{3}|T[0-9A-Fa-f]{8})(?P<size>[0-8])(?P<data>([0-9A-Fa-f]{2})*)\r")
TTY_BAUD: Final = 1_000_000  # of the dongle's virtual port; USB ignores it


def is_whole(line: str) -> bool:
    """Whether a line of the dongle, with its CR, is no data frame, or one with as many bytes as it says."""
    if line[:1] not in ("t", "T"):
        return True
    match = _FRAME.fullmatch(line)
    return match is not None and len(match["data"]) == 2 * int(match["size"])


class _TolerantSlcanBus(slcanBus):
    """One malformed line is a bad frame, not an exception out of `recv`; reads chunks instead of bytes."""

    bad_frames = 0

    def __init__(self, port: str, bitrate: int) -> None:
        try:
            super().__init__(port, tty_baudrate=TTY_BAUD, bitrate=bitrate, sleep_after_open=0.0)
        except BaseException:
            self._is_shutdown = True  # else the end of this object would send "close the bus" to the port
            if hasattr(self, "serialPortOrig"):
                self.serialPortOrig.close()
            raise

    def set_bitrate(self, bitrate: int, data_bitrate: int | None = None) -> None:
        """Comes before anything else is sent, so it locks the port: the dongle may serve another master."""
        self.serialPortOrig.exclusive = True
        super().set_bitrate(bitrate, data_bitrate)

    def _read(self, timeout: float | None) -> str | None:
        waited: Any = serial.Timeout(timeout)  # type: ignore[arg-type]  # None waits for ever
        with error_check("Could not read from serial device"):
            while True:
                line = _LINE.match(self._buffer)
                if line is not None:
                    text = line[0].decode("ascii", errors="replace")
                    del self._buffer[: line.end()]
                    if is_whole(text):
                        return text
                    self.bad_frames += 1
                    continue
                data = self.serialPortOrig.read(self.serialPortOrig.in_waiting or 1)
                self._buffer += data
                if len(self._buffer) > LONGEST_LINE and not _LINE.match(self._buffer):
                    self._buffer.clear()
                    self.bad_frames += 1
                if not data and waited.expired():
                    return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            return super()._recv_internal(timeout)
        except (ValueError, IndexError):  # a frame of another kind, cut short
            self.bad_frames += 1
            return None, False


class PythonCanLink:
    """Classic CAN with 11-bit identifiers. The bus is opened by `reopen`, not before.

    `interface` is "slcan" (port: the serial port of the dongle) or "socketcan" (port: such as can0, whose bit
    rate is set by the system).
    """

    def __init__(
        self, interface: str, port: str, bitrate: int = 1_000_000, clock: Clock | None = None
    ) -> None:
        if interface not in ("slcan", "socketcan"):
            raise DeviceError(f"CAN interface {interface!r}", 'Choose "slcan" or "socketcan"')
        self.interface, self.port, self._bitrate = interface, port, bitrate
        self._clock = clock or RealClock()
        self._bus: Any = None
        self._bad_frames = 0
        self._send_lock = threading.Lock()
        self._meter = LinkMeter(self._clock.now_s)

    @property
    def statistics(self) -> LinkStatistics:
        """What the bus has seen; a wait is cut to pieces here, so that nothing counts as late."""
        return self._meter.statistics(self.port)

    @property
    def bad_frames(self) -> int:
        """Lines and frames that were dropped since the link was made."""
        return self._bad_frames + int(getattr(self._bus, "bad_frames", 0))

    def reopen(self) -> None:
        """Close and open again. Raises DeviceError naming the port and the remedy."""
        self.close()
        try:
            self._bus = self._open()
        except (can.CanError, OSError, ValueError) as error:
            self._meter.broken()
            raise opening_failed(self.port, error) from error
        self._meter.opened()

    def close(self) -> None:
        """Release the bus; safe twice."""
        bus, self._bus = self._bus, None
        if bus is not None:
            self._bad_frames += int(getattr(bus, "bad_frames", 0))
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; safe from any thread. Raises DeviceError if the bus is gone or takes nothing."""
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        try:
            with self._send_lock:
                self._require().send(message, timeout=SEND_TIMEOUT_S)
                self._meter.sent(1)
        except (can.CanError, OSError) as error:
            raise self._gone(error) from error

    def receive(self, timeout_s: float) -> Sequence[CanFrame]:
        """The next data frame; empty after `timeout_s`. Raises DeviceError if the bus is gone or off."""
        bus = self._require()
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            try:
                message = bus.recv(max(deadline_s - self._clock.now_s(), 0.0))
            except (can.CanError, OSError, TypeError) as error:  # TypeError: closed while reading
                raise self._gone(error) from error
            if message is None:
                return ()
            if message.is_error_frame:
                self._bad_frames += 1
                if message.arbitration_id & ERROR_BUS_OFF:
                    raise DeviceError(
                        f"CAN bus {self.port} is off",
                        "Check termination, wiring and bit rate, then restart the interface and reset",
                    )
            elif not (message.is_remote_frame or message.is_extended_id):
                self._meter.received(1, 0.0)
                return (CanFrame(message.arbitration_id, bytes(message.data), self._clock.now_s()),)

    def _open(self) -> Any:
        if self.interface == "socketcan":
            return can.Bus(interface="socketcan", channel=self.port)
        return _TolerantSlcanBus(self.port, self._bitrate)

    def _require(self) -> Any:
        if self._bus is None:
            raise DeviceError(f"CAN bus {self.port} is not open", "Connect the arm first")
        return self._bus

    def _gone(self, error: Exception) -> DeviceError:
        self._meter.broken()
        return DeviceError(
            f"CAN bus on {self.port} is gone ({error})",
            "Check the dongle, its cable and the power of the drives",
        )
