"""Simulated devices on real ports of this computer, served from a thread, for clients that are not ours."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from simulators.interfaces import ByteDevice
from simulators.outlets import Loop, SerialOutlet, TcpOutlet


@contextlib.contextmanager
def _served(loop: Loop) -> Iterator[None]:
    thread = threading.Thread(target=loop.run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        loop.quit()
        thread.join(10.0)


@contextlib.contextmanager
def on_serial_port(
    path: Path,
    device: ByteDevice,
    baud: Callable[[], int] | None = None,
    update: Callable[[float], None] = lambda time_s: None,
) -> Iterator[SerialOutlet]:
    """The device behind a pseudo-terminal; a client at another line speed sees garbage."""
    loop = Loop(update)
    outlet = SerialOutlet(loop, path, lambda: device, baud)
    with _served(loop):
        yield outlet


@contextlib.contextmanager
def on_tcp_port(connect: Callable[[], ByteDevice], host: str = "127.0.0.1", port: int = 0) -> Iterator[int]:
    """The device behind a TCP port of this computer, 0 being any free one. Yields its number."""
    loop = Loop()
    outlet = TcpOutlet(loop, host, port, connect)
    with _served(loop):
        yield outlet.port.port
