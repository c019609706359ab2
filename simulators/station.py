"""One simulated device behind the ports that its clients open, and what can happen to it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from estimation.errors import CellFileError
from simulators import faults
from simulators.device_kind import DeviceKind, Simulated
from simulators.faults import Fault
from simulators.interfaces import ByteDevice
from simulators.outlets import Loop, SerialOutlet, TcpOutlet
from simulators.slcan import SlcanDevice


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where a device is to be found. A relative path is one in `directory`."""

    ports: Mapping[str, str] = field(default_factory=dict)
    """For TCP a number for each socket, if not the usual one; else a path, if not the name of the kind."""
    host: str = "127.0.0.1"
    directory: Path = Path()


class Station:
    """A device at its outlets, in a loop. Raises CellFileError if a port cannot be opened."""

    def __init__(self, loop: Loop, kind: DeviceKind[Any], device: Simulated, endpoint: Endpoint) -> None:
        self._loop, self.kind, self.device = loop, kind, device
        self._directory = endpoint.directory
        self.outlets = dict[str, SerialOutlet | TcpOutlet]()  # by socket
        if kind.link == "tcp":
            self._listen(endpoint)
        else:
            self._open_line(endpoint)

    def _open_line(self, endpoint: Endpoint) -> None:
        for name in endpoint.ports:
            if name:
                raise CellFileError(f"{self.kind.name} has no socket {name!r}", "Name one path")
        path = _free_path(self._directory / endpoint.ports.get("", self.kind.name))
        try:
            self.outlets[""] = SerialOutlet(self._loop, path, lambda: self._find(""), self._baud())
        except OSError as error:
            raise CellFileError(
                f"{path} cannot be made: {error.strerror}", "Name a path where you may write"
            ) from error

    def _listen(self, endpoint: Endpoint) -> None:
        for name in endpoint.ports:
            if name not in self.kind.sockets:
                known = ", ".join(name or "the main one" for name in self.kind.sockets)
                raise CellFileError(f"{self.kind.name} has no socket {name!r}", f"It has {known}")
        for name, usual in self.kind.sockets.items():
            text = endpoint.ports.get(name, str(usual))
            if not text.isdigit() or int(text) > 65535:
                raise CellFileError(f"{text!r} is no TCP port", "Give a number, 0 for any free one")
            self.outlets[name] = self._outlet(endpoint.host, int(text), name)

    def _outlet(self, host: str, port: int, socket: str) -> TcpOutlet:
        try:
            return TcpOutlet(self._loop, host, port, lambda: self._find(socket))
        except PermissionError as error:
            raise CellFileError(
                f"Port {port} is reserved for the system", f"Choose one above 1023, such as {port + 5000}"
            ) from error
        except OSError as error:
            raise CellFileError(
                f"{self.kind.name} cannot be simulated at {host}:{port}: {error.strerror or error}",
                "Choose an address of this computer, such as 127.0.0.1, and a free port",
            ) from error

    def _find(self, socket: str) -> ByteDevice:
        """What a client finds at a socket now."""
        device = self.device
        return SlcanDevice(device.can) if device.can is not None else device.connect[socket]()

    def _baud(self) -> Callable[[], int] | None:
        return None if self.device.baud is None else lambda: self.device.baud() if self.device.baud else 0

    @property
    def where(self) -> dict[str, str]:
        """Path or host:port of each socket."""
        return {
            name: f"{outlet.port.host}:{outlet.port.port}"
            if isinstance(outlet, TcpOutlet)
            else str(outlet.port.path)
            for name, outlet in self.outlets.items()
        }

    @property
    def plugged(self) -> bool:
        """Clients can open it."""
        return all(outlet.plugged for outlet in self.outlets.values())

    # -- what happens to it ----------------------------------------------------------------------

    def schedule(self, fault: Fault) -> None:
        """Let this fault of a message or of the signal happen. Raises CellFileError."""
        if fault.kind in faults.KINDS:
            for outlet in self.outlets.values():
                outlet.faults.schedule(fault)
        elif self.device.signal is None:
            raise CellFileError(f"{self.kind.name} measures no signal: no {fault.kind}", "Leave it out")
        else:
            # A signal is continuous: without an end, the fault lasts.
            self.device.signal.schedule(replace(fault, once=False))

    def silence(self, duration_s: float) -> None:
        """Nothing gets through for so long."""
        now_s = self._loop.now_s
        for outlet in self.outlets.values():
            outlet.faults.add("drop", from_s=now_s, until_s=now_s + duration_s)

    def unplug(self) -> None:
        """Somebody pulls the cable."""
        for outlet in self.outlets.values():
            outlet.unplug()

    def plug(self, port: str | None = None) -> None:
        """The cable is back; at another port if one is named: a path, or the number of the main socket."""
        if port is not None:
            self._move(port)
        for outlet in self.outlets.values():
            outlet.plug()

    def _move(self, port: str) -> None:
        outlet = next(iter(self.outlets.values()))
        outlet.unplug()
        if isinstance(outlet, TcpOutlet):
            outlet.port.port = int(port)
        else:
            outlet.port.path = _free_path(self._directory / port)

    def restart(self) -> None:
        """The power fails for a moment; connections end."""
        if self.device.restart is not None:
            self.device.restart(self._loop.now_s)
        for outlet in self.outlets.values():
            if isinstance(outlet, TcpOutlet):
                outlet.hang_up()

    def swap(self, device: Simulated) -> None:
        """Another device takes the place of this one."""
        self.unplug()
        self.device = device
        self.plug()


def _free_path(path: Path) -> Path:
    """A path where a pseudo-terminal may be linked: nothing is there but a link of an earlier time."""
    if path.exists() and not path.is_symlink():
        raise CellFileError(f"{path} is there already", "Name a path for the port that does not exist yet")
    return path
