"""A TCP connection as a ByteLink."""

import contextlib
import socket
import time

from drivers.links.meter import LinkMeter, LinkStatistics
from estimation.errors import DeviceError


class TcpLink:
    """One connection, opened by `reopen` and not before.

    A connection whose other end has vanished stays silent: the deadlines of the driver above find that.
    """

    def __init__(self, host: str, port: int, connect_timeout_s: float = 2.0) -> None:
        self.host, self.port, self._connect_timeout_s = host, port, connect_timeout_s
        self._socket: socket.socket | None = None
        self._meter = LinkMeter(time.monotonic)

    @property
    def statistics(self) -> LinkStatistics:
        """What the connection has seen."""
        return self._meter.statistics(f"{self.host}:{self.port}")

    def reopen(self) -> None:
        """Close and connect again. Raises DeviceError naming host and port."""
        self.close()
        try:
            connection = self._connect()
        except DeviceError:
            self._meter.broken()
            raise
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # a poll must not wait for more
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._socket = connection
        self._meter.opened()

    def _connect(self) -> socket.socket:
        try:
            return socket.create_connection((self.host, self.port), self._connect_timeout_s)
        except TimeoutError as error:
            raise DeviceError(
                f"{self.host} port {self.port} does not answer within {self._connect_timeout_s:g} s",
                "Check power, network cable and address of the device",
            ) from error
        except ConnectionRefusedError as error:
            raise DeviceError(
                f"{self.host} refuses connections to port {self.port}",
                "Check the port in the cell file; for a simulated cell start `truecell simulate` first",
            ) from error
        except OSError as error:
            raise DeviceError(
                f"{self.host} port {self.port} cannot be reached: {error}",
                "Check the address and the network",
            ) from error

    def close(self) -> None:
        """Release the connection; safe twice."""
        connection, self._socket = self._socket, None
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def write(self, data: bytes) -> None:
        """Send all bytes. Raises DeviceError if the connection is gone."""
        connection = self._require()
        try:
            connection.settimeout(self._connect_timeout_s)
            connection.sendall(data)
            self._meter.sent(len(data))
        except OSError as error:
            raise self._gone(str(error)) from error

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, waiting at most `timeout_s`. Raises DeviceError if the connection is gone."""
        connection = self._require()
        try:
            connection.settimeout(max(timeout_s, 0.0))  # zero does not wait
            data = connection.recv(65536)
        except (TimeoutError, BlockingIOError):
            self._meter.received(0, timeout_s)
            return b""
        except OSError as error:
            raise self._gone(str(error)) from error
        if not data:
            raise self._gone("closed by the device")
        self._meter.received(len(data), timeout_s)
        return data

    def discard_input(self) -> None:
        """Drop what was received."""
        while self.read(0.0):
            pass

    def _require(self) -> socket.socket:
        if self._socket is None:
            raise DeviceError(f"No connection to {self.host} port {self.port}", "Connect the device first")
        return self._socket

    def _gone(self, reason: str) -> DeviceError:
        self._meter.broken()
        return DeviceError(
            f"Connection to {self.host} port {self.port} is gone ({reason})",
            "Check power and network cable of the device, then reset",
        )
