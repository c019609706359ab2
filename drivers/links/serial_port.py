"""A serial port as a ByteLink."""

import contextlib
import errno
import os
import select
import threading
import time
from typing import Final

import serial

from drivers.links.meter import LinkMeter, LinkStatistics
from estimation.errors import DeviceError

try:
    import termios
except ImportError:  # on Windows a byte of wrong parity passes for a good one
    termios = None  # type: ignore[assignment]

# What a port raises once its device is gone; a flush answers with an error that is no OSError.
PORT_ERRORS: Final = (serial.SerialException, OSError, getattr(termios, "error", OSError))

KEPT_BYTES: Final = 1 << 18  # the kernel keeps 4 KiB only, 0.7 s of a fast sensor
READ_SLICE_S: Final = 0.05
WRITE_TIMEOUT_S: Final = 1.0


class SerialLink:
    """A line without handshake, for one user at a time; a thread empties the port so that nothing is lost.

    `framing` is data bits, parity (N, E, O) and stop bits, as in "8N1".
    The port is opened by `reopen`, not before.
    """

    def __init__(self, port: str, baud: int, framing: str = "8N1") -> None:
        self.port, self.baud, self._framing = port, baud, framing
        self._serial: serial.Serial | None = None
        self._reader: threading.Thread | None = None
        self._draining = threading.Lock()  # reads and flushes of the port exclude each other
        self._flushes = 0
        self._arrived = threading.Condition()
        self._buffer = bytearray()
        self._failure: DeviceError | None = None
        self._meter = LinkMeter(time.monotonic)

    @property
    def statistics(self) -> LinkStatistics:
        """What the line has seen."""
        return self._meter.statistics(self.port)

    def reopen(self) -> None:
        """Close and open again. Raises DeviceError naming the port and the remedy."""
        self.close()
        try:
            data_bits, parity, stop_bits = tuple(self._framing)
            port = serial.Serial(
                self.port,
                self.baud,
                bytesize=int(data_bits),
                parity=parity,
                stopbits=int(stop_bits),
                timeout=READ_SLICE_S,
                write_timeout=WRITE_TIMEOUT_S,
                exclusive=True,
            )
        except (*PORT_ERRORS, ValueError) as error:
            self._meter.broken()
            raise opening_failed(self.port, error) from error
        try:
            if parity != "N":
                _check_parity(port)
        except PORT_ERRORS as error:  # it went meanwhile
            port.close()
            self._meter.broken()
            raise opening_failed(self.port, error) from error
        with contextlib.suppress(*PORT_ERRORS):  # a pseudo-terminal has no such lines
            port.dtr = port.rts = True
        self._serial, self._failure = port, None
        self._meter.opened()
        self._buffer.clear()
        self._reader = threading.Thread(
            target=self._receive, args=(port,), name=f"serial {self.port}", daemon=True
        )
        self._reader.start()

    def close(self) -> None:
        """Release the port; safe twice."""
        port, self._serial = self._serial, None
        if port is not None:
            if self._reader is not None:
                self._reader.join()
            port.close()

    def write(self, data: bytes) -> None:
        """Send all bytes. Raises DeviceError if the port is gone or takes nothing."""
        try:
            self._require().write(data)
            self._meter.sent(len(data))
        except serial.SerialTimeoutException as error:
            raise DeviceError(
                f"Port {self.port} takes no data for {WRITE_TIMEOUT_S:g} s",
                "Check the converter and its cable",
            ) from error
        except PORT_ERRORS as error:
            raise self._gone(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, waiting at most `timeout_s` for the first byte. Raises DeviceError if gone."""
        self._require()
        with self._arrived:
            if not self._buffer and self._failure is None:
                self._arrived.wait_for(lambda: self._buffer or self._failure is not None, timeout_s)
            if not self._buffer and self._failure is not None:
                raise DeviceError(self._failure.problem, self._failure.remedy)
            data = bytes(self._buffer)
            self._buffer.clear()
        self._meter.received(len(data), timeout_s)
        return data

    def discard_input(self) -> None:
        """Drop what was received."""
        port = self._require()
        with self._draining:
            self._flushes += 1
            with contextlib.suppress(*PORT_ERRORS):  # `read` tells that a port is gone
                port.reset_input_buffer()
            with self._arrived:
                self._buffer.clear()

    def _receive(self, port: serial.Serial) -> None:
        try:
            while self._serial is port:
                flushes = self._flushes
                if not select.select([port.fileno()], [], [], READ_SLICE_S)[0]:
                    continue
                with self._draining:
                    if self._flushes != flushes:  # readable no more, which would look like a lost device
                        continue
                    data = port.read(max(1, port.in_waiting))
                    with self._arrived:
                        self._buffer += data
                        if len(self._buffer) > KEPT_BYTES:
                            del self._buffer[:-KEPT_BYTES]
                        self._arrived.notify_all()
        except (*PORT_ERRORS, TypeError) as error:  # TypeError: closed while reading
            with self._arrived:
                self._failure = self._gone(error)
                self._arrived.notify_all()

    def _require(self) -> serial.Serial:
        if self._serial is None:
            raise DeviceError(f"Port {self.port} is not open", "Connect the device first")
        return self._serial

    def _gone(self, error: Exception) -> DeviceError:
        self._meter.broken()
        return DeviceError(
            f"Port {self.port} is gone ({error})", "Check the cable and the power of the device"
        )


def _check_parity(port: serial.Serial) -> None:
    """Let a byte of wrong parity arrive as NUL; pyserial lets it arrive as if it were right."""
    if termios is not None:
        settings = termios.tcgetattr(port.fileno())
        settings[0] |= termios.INPCK
        termios.tcsetattr(port.fileno(), termios.TCSANOW, settings)


def opening_failed(port: str, error: Exception) -> DeviceError:
    """Why a port cannot be opened, and what to do."""
    told = [
        getattr(each, "errno", None) for each in (error, error.__cause__)
    ]  # python-can tells it of the cause
    number = next((each for each in told if isinstance(each, int)), None)
    text = str(error)
    remedy = "Check the port in the cell file"
    if number == errno.ENOENT or "No such file" in text:
        remedy = "Plug the device in, or for a simulated cell start `truecell simulate` first"
    elif number == errno.EACCES or "Permission denied" in text:
        remedy = "Give this user access to the port (on most systems: the group dialout)"
    elif number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        remedy = "Another program uses it: stop that one"
    # pyserial's own text names the port again, twice.
    cause = os.strerror(number) if number is not None else text.rpartition("] ")[2]
    return DeviceError(f"Port {port} cannot be opened: {cause}", remedy)
