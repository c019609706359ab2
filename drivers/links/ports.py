"""Links on the real ports of this computer."""

from pathlib import Path

from drivers.clock import Clock
from drivers.links.can_bus import PythonCanLink
from drivers.links.serial_port import SerialLink
from drivers.links.tcp import TcpLink


class RealPorts:
    """Links that open what they are named after; the path of a port is relative to `directory`."""

    def __init__(self, directory: Path, clock: Clock) -> None:
        self._directory, self._clock = directory, clock

    def can_bus(self, name: str, interface: str, port: str, bitrate: int) -> PythonCanLink:
        """A CAN bus; a "socketcan" port is the name of an interface, not a path."""
        where = port if interface == "socketcan" else self._path(port)
        return PythonCanLink(interface, where, bitrate, self._clock)

    def serial(self, name: str, port: str, baud: int, framing: str = "8N1") -> SerialLink:
        """A serial line."""
        return SerialLink(self._path(port), baud, framing)

    def tcp(self, name: str, host: str, port: int) -> TcpLink:
        """A TCP connection."""
        return TcpLink(host, port)

    def _path(self, port: str) -> str:
        """COM ports of Windows are names, everything else a path."""
        return port if port.upper().startswith("COM") and port[3:].isdigit() else str(self._directory / port)
