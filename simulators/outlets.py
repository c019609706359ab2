"""Simulated devices in real time: each behind an outlet that another process plugs into, all in one loop."""

import contextlib
import math
import selectors
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Protocol

from simulators.faults import FaultyBytes, WireFaults
from simulators.interfaces import ByteDevice
from simulators.ports import PtyPort, TcpPort, garbled

LONGEST_WAIT_S: Final = 0.02
LONGEST_STEP_S: Final = 0.03  # what passes beyond it, the machine was busy with something else


class ForgivingClock:
    """Real time less the time in which this process could not run.

    Without it, a busy machine looks to the simulated drives like a silent master.
    """

    def __init__(self) -> None:
        self._last_s = time.monotonic()
        self._now_s = 0.0
        self.stalled_s = 0.0

    def tick(self, at_most_s: float) -> float:
        """The present, at most so much later than at the last tick."""
        real_s = time.monotonic()
        passed_s, self._last_s = real_s - self._last_s, real_s
        granted_s = min(passed_s, at_most_s)
        self.stalled_s += passed_s - granted_s
        self._now_s += granted_s
        return self._now_s


class Outlet(Protocol):
    """A port with a device behind it."""

    faults: WireFaults

    @property
    def plugged(self) -> bool:
        """A client can open it."""

    def plug(self) -> None:
        """Appear."""

    def unplug(self) -> None:
        """Disappear, as when somebody pulls the cable."""

    def next_output_s(self) -> float:
        """When there may be something to send."""

    def serve(self, time_s: float) -> None:
        """Send what is due."""


class Loop:
    """Waits for clients and for devices; `update` brings the world up to the present."""

    def __init__(self, update: Callable[[float], None] = lambda time_s: None) -> None:
        self._selector = selectors.SelectSelector()  # to the microsecond; epoll waits whole milliseconds
        self._clock, self._update = ForgivingClock(), update
        self.outlets = list[Outlet]()
        self.now_s = 0.0
        self._running = True

    @property
    def stalled_s(self) -> float:
        """For how long this process could not run."""
        return self._clock.stalled_s

    def watch(self, thing: Any, action: Callable[[], None]) -> None:
        """Call `action` whenever `thing` has something to read."""
        self._selector.register(thing, selectors.EVENT_READ, action)

    def forget(self, thing: Any) -> None:
        """Watch it no longer; before it is closed."""
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(thing)

    def quit(self) -> None:
        """End after this step."""
        self._running = False

    def run(self) -> None:
        """Serve until `quit`; every outlet is unplugged then."""
        try:
            while self._running:
                self.step()
        finally:
            for outlet in self.outlets:
                outlet.unplug()

    def step(self) -> None:
        """Wait for the next event, at most LONGEST_WAIT_S, and serve it."""
        due_s = min([outlet.next_output_s() for outlet in self.outlets], default=math.inf)
        events = self._selector.select(min(max(due_s - self.now_s, 0.0), LONGEST_WAIT_S))
        self.now_s = self._clock.tick(LONGEST_STEP_S)
        for key, _ in events:
            key.data()
        # Followed as it goes: what is asked after a minute of motion must be answered at once.
        self._update(self.now_s)
        for outlet in self.outlets:
            outlet.serve(self.now_s)


class SerialOutlet:
    """A pseudo-terminal. `connect` makes what a plug finds there; `baud` is the line speed, if it has one."""

    def __init__(
        self,
        loop: Loop,
        path: Path,
        connect: Callable[[], ByteDevice],
        baud: Callable[[], int] | None = None,
    ) -> None:
        self._loop, self._connect, self._baud = loop, connect, baud
        self.faults = WireFaults()
        self.port = PtyPort(path)
        self._device = FaultyBytes(connect(), self.faults)
        loop.watch(self.port, self._receive)
        loop.outlets.append(self)

    @property
    def plugged(self) -> bool:
        return self.port.plugged

    def plug(self) -> None:
        if not self.plugged:
            self.port.plug()
            self._device = FaultyBytes(self._connect(), self.faults)
            self._loop.watch(self.port, self._receive)

    def unplug(self) -> None:
        if self.plugged:
            self._loop.forget(self.port)
            self.port.unplug()

    def _wrong_baud(self) -> bool:
        return self._baud is not None and self.port.client_baud() != self._baud()

    def _receive(self) -> None:
        data = self.port.read()
        if data:
            self._device.receive(garbled(data) if self._wrong_baud() else data, self._loop.now_s)

    def next_output_s(self) -> float:
        return self._device.next_output_s() if self.plugged else math.inf

    def serve(self, time_s: float) -> None:
        if self.plugged:
            self.port.stay_settable()
        if self._device.next_output_s() > time_s:
            return
        if not self.plugged:
            self._device.discard(time_s)
            return
        data = self._device.take(time_s)
        if data:
            self.port.write(garbled(data) if self._wrong_baud() else data)


class TcpOutlet:
    """A listening port; `connect` makes what each client finds there."""

    def __init__(self, loop: Loop, host: str, port: int, connect: Callable[[], ByteDevice]) -> None:
        self._loop, self._connect = loop, connect
        self.faults = WireFaults()
        self.port = TcpPort(host, port)
        self._clients = dict[socket.socket, FaultyBytes]()
        loop.watch(self.port, self._accept)
        loop.outlets.append(self)

    @property
    def plugged(self) -> bool:
        return self.port.plugged

    def plug(self) -> None:
        if not self.plugged:
            self.port.plug()
            self._loop.watch(self.port, self._accept)

    def unplug(self) -> None:
        if self.plugged:
            self._loop.forget(self.port)
            self.port.unplug()
        self.hang_up()

    def hang_up(self) -> None:
        """Close every connection, as a device does that restarts."""
        for client in list(self._clients):
            self._drop(client)

    def _accept(self) -> None:
        client = self.port.accept()
        if client is not None:
            self._clients[client] = FaultyBytes(self._connect(), self.faults)
            self._loop.watch(client, lambda: self._receive(client))

    def _receive(self, client: socket.socket) -> None:
        if client not in self._clients:  # dropped in the same step
            return
        try:
            data = client.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._clients[client].receive(data, self._loop.now_s)
        else:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._loop.forget(client)
        del self._clients[client]
        client.close()

    def next_output_s(self) -> float:
        return min([device.next_output_s() for device in self._clients.values()], default=math.inf)

    def serve(self, time_s: float) -> None:
        for client, device in list(self._clients.items()):
            data = device.take(time_s)
            if data:
                try:
                    client.sendall(data)
                except OSError:
                    self._drop(client)
