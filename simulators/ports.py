"""The ends of the wires that another process opens: pseudo-terminals and a TCP port."""

import contextlib
import fcntl
import os
import socket
import struct
import termios
import tty
from pathlib import Path
from typing import Final

TCGETS2: Final = 0x802C542A
READ_BYTES: Final = 65536
LOCAL_FLAGS: Final = 3  # where `tcgetattr` has them


class PtyPort:
    """A serial port by name: a symbolic link to a pseudo-terminal of which we hold both ends."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = self._slave = -1
        self.lost_bytes = 0  # that nobody read in time
        self.plug()

    @property
    def plugged(self) -> bool:
        return self._master >= 0

    def fileno(self) -> int:
        return self._master

    def plug(self) -> None:
        """Appear under our name."""
        if self.plugged:
            return
        self._master, self._slave = os.openpty()  # an open slave keeps the master readable without a client
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        fresh.symlink_to(os.ttyname(self._slave))
        fresh.replace(self.path)

    def unplug(self) -> None:
        """Disappear, as when somebody pulls the cable."""
        if not self.plugged:
            return
        self.path.unlink(missing_ok=True)
        for descriptor in (self._master, self._slave):
            os.close(descriptor)
        self._master = self._slave = -1

    def read(self) -> bytes:
        """What the client has written; b"" if nothing."""
        try:
            return os.read(self._master, READ_BYTES)
        except (BlockingIOError, OSError):
            return b""

    def write(self, data: bytes) -> bool:
        """Send; what does not fit into the buffer is lost. False if nothing fitted."""
        try:
            written = os.write(self._master, data)
        except (BlockingIOError, OSError):
            written = 0
        self.lost_bytes += len(data) - written
        return written > 0

    def stay_settable(self) -> None:
        """Let a client that asks for parity open the port again.

        A pseudo-terminal has no parity, and the C library refuses settings that change nothing. So there is
        always something to change: a flag that raw lines clear, and that means nothing without echo.
        """
        settings = termios.tcgetattr(self._slave)
        if not settings[LOCAL_FLAGS] & termios.ECHOE:
            settings[LOCAL_FLAGS] |= termios.ECHOE
            termios.tcsetattr(self._slave, termios.TCSANOW, settings)

    def client_baud(self) -> int:
        """The line speed that the client has set."""
        settings = fcntl.ioctl(self._master, TCGETS2, bytes(44))
        return int(struct.unpack_from("=I", settings, 40)[0])


def garbled(data: bytes) -> bytes:
    """What a receiver at another line speed makes of these bytes."""
    return bytes(byte * 167 + 89 & 0xFF | 0x81 for byte in data)


class TcpPort:
    """A listening socket and its connections, all non-blocking."""

    def __init__(self, host: str, port: int) -> None:
        self.host, self.port = host, port
        self._listener: socket.socket | None = None
        self.plug()

    @property
    def plugged(self) -> bool:
        return self._listener is not None

    def fileno(self) -> int:
        return self._listener.fileno() if self._listener else -1

    def plug(self) -> None:
        if self._listener is None:
            self._listener = socket.create_server((self.host, self.port))
            self._listener.setblocking(False)
            self.port = self._listener.getsockname()[1]  # 0 asks for any free port

    def unplug(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def accept(self) -> socket.socket | None:
        """The next client, if there is one."""
        if self._listener is None:
            return None
        with contextlib.suppress(OSError):
            connection, _ = self._listener.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return connection
        return None
