"""Links on the real ports of this computer."""

import re
from pathlib import Path
from typing import Final

from drivers.clock import Clock
from drivers.links.can_bus import PythonCanLink
from drivers.links.port_search import PortSearch, is_pattern
from drivers.links.serial_port import SerialLink
from drivers.links.tcp import TcpLink

_COM: Final = re.compile(r"(\\\\\.\\)?COM[0-9*?]", re.IGNORECASE)


class RealPorts:
    """Links that open what they are named after; the path of a port is relative to `directory`.

    `searches` has those links whose port is a pattern, by name.
    """

    def __init__(self, directory: Path, clock: Clock) -> None:
        self._directory, self._clock = directory, clock
        self.searches = dict[str, PortSearch]()

    def can_bus(self, name: str, interface: str, port: str, bitrate: int) -> PythonCanLink:
        """A CAN bus; a "socketcan" port is the name of an interface, not a path."""
        if interface == "socketcan":
            return PythonCanLink(interface, port, bitrate, self._clock)
        link = PythonCanLink(interface, self._path(port), bitrate, self._clock)
        self._search(name, link, port)
        return link

    def serial(self, name: str, port: str, baud: int, framing: str = "8N1") -> SerialLink:
        """A serial line."""
        link = SerialLink(self._path(port), baud, framing)
        self._search(name, link, port)
        return link

    def tcp(self, name: str, host: str, port: int) -> TcpLink:
        """A TCP connection."""
        return TcpLink(host, port)

    def _path(self, port: str) -> str:
        """COM ports of Windows are names, everything else a path."""
        return port if _COM.match(port) else str(self._directory / port)

    def _search(self, name: str, link: PythonCanLink | SerialLink, port: str) -> None:
        if is_pattern(port):
            self.searches[name] = PortSearch(link, self._path(port))
