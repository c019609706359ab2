"""Links on the real ports of this computer."""

import re
from pathlib import Path
from typing import Final

from drivers.clock import Clock
from drivers.links.can_bus import PythonCanLink
from drivers.links.meter import LinkStatistics
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
        self._links = dict[str, PythonCanLink | SerialLink | TcpLink]()

    def statistics(self) -> dict[str, LinkStatistics]:
        """What each link has seen, by its name."""
        return {name: link.statistics for name, link in self._links.items()}

    def can_bus(self, name: str, interface: str, port: str, bitrate: int) -> PythonCanLink:
        """A CAN bus; a "socketcan" port is the name of an interface, not a path."""
        is_interface = interface == "socketcan"
        link = PythonCanLink(interface, port if is_interface else self._path(port), bitrate, self._clock)
        if not is_interface:
            self._search(name, link, port)
        self._links[name] = link
        return link

    def serial(self, name: str, port: str, baud: int, framing: str = "8N1") -> SerialLink:
        """A serial line."""
        self._links[name] = link = SerialLink(self._path(port), baud, framing)
        self._search(name, link, port)
        return link

    def tcp(self, name: str, host: str, port: int) -> TcpLink:
        """A TCP connection."""
        self._links[name] = link = TcpLink(host, port)
        return link

    def _path(self, port: str) -> str:
        """COM ports of Windows are names, everything else a path."""
        return port if _COM.match(port) else str(self._directory / port)

    def _search(self, name: str, link: PythonCanLink | SerialLink, port: str) -> None:
        if is_pattern(port):
            self.searches[name] = PortSearch(link, self._path(port))
