"""Real ports with scripted devices behind them: a pseudo-terminal, an slcan dongle, a TCP module."""

import contextlib
import os
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator

from tests.drivers.fakes import FakeArmLink, VirtualClock


class WallClock(VirtualClock):
    """The fakes' clock on real time: it cannot be set."""

    def __init__(self) -> None:
        pass

    @property
    def time_s(self) -> float:  # type: ignore[override]
        return time.monotonic()

    @time_s.setter
    def time_s(self, value: float) -> None:
        pass


class PseudoTerminal:
    """A port; a thread calls `on_data` with what the driver writes, and `on_idle` every millisecond."""

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.on_data: Callable[[bytes], None] = lambda data: None
        self.on_idle: Callable[[], None] = lambda: None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def unplug(self) -> None:
        """The device and its port vanish."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join()
            os.close(self._slave)
            os.close(self.master)

    def _run(self) -> None:
        while not self._closing.is_set():
            readable, _, _ = select.select([self.master], [], [], 0.001)
            if readable:
                with contextlib.suppress(OSError):
                    self.on_data(os.read(self.master, 4096))
            self.on_idle()


@contextlib.contextmanager
def pseudo_terminal() -> Iterator[PseudoTerminal]:
    port = PseudoTerminal()
    try:
        yield port
    finally:
        port.unplug()


class SlcanDongle:
    """Fake drives behind a dongle that speaks slcan."""

    def __init__(self, port: PseudoTerminal) -> None:
        self.arm = FakeArmLink(WallClock())
        self.lock = threading.Lock()
        self._port, self._received = port, b""
        port.on_data, port.on_idle = self._take, self._give

    def _take(self, data: bytes) -> None:
        *lines, self._received = (self._received + data).split(b"\r")
        with self.lock:
            for line in lines:
                if line[:1] == b"t":
                    self.arm.send(int(line[1:4], 16), bytes.fromhex(line[5:].decode()))

    def _give(self) -> None:
        with self.lock:
            while frames := self.arm.receive(0.0):
                for can_id, data, _ in frames:
                    line = f"t{can_id:03X}{len(data)}{data.hex().upper()}\r"
                    self._port.write(line.encode())


@contextlib.contextmanager
def tcp_device(serve: Callable[[socket.socket], None]) -> Iterator[int]:
    """A listening port of this computer; `serve` gets each connection in a thread. Yields the port number."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    with connection, contextlib.suppress(OSError):
                        serve(connection)

        threading.Thread(target=accept, daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
