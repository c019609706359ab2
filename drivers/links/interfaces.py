"""The kinds of link that drivers speak through, bytes and CAN frames, and where links come from.

A real port and the deterministic cell both provide these; a driver cannot tell them apart.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from drivers.capabilities import Search
from drivers.links.meter import LinkStatistics


class ByteLink(Protocol):
    """A serial line or TCP connection."""

    def write(self, data: bytes) -> None:
        """Send all bytes. Raises DeviceError if the port is gone."""

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, waiting at most `timeout_s` for the first byte; b"" if nothing came.

        Raises DeviceError if the port is gone.
        """

    def discard_input(self) -> None:
        """Drop what was received; a reply may still come later."""

    def reopen(self) -> None:
        """Close and open again. Raises DeviceError naming the port if it is not there."""

    def close(self) -> None:
        """Release the port; safe twice."""


class CanFrame(NamedTuple):
    """One classic CAN data frame with an 11-bit identifier."""

    can_id: int
    data: bytes
    time_s: float = 0.0  # when it was received, on the driver's clock


class CanLink(Protocol):
    """A CAN bus behind a dongle or socket."""

    def send(self, can_id: int, data: bytes) -> None:
        """Queue one frame; safe from any thread. Raises DeviceError if the bus is gone."""

    def receive(self, timeout_s: float) -> Sequence[CanFrame]:
        """What has arrived, in order, waiting at most `timeout_s` for the first frame; empty if nothing came.

        Raises DeviceError if the bus is gone.
        """

    def reopen(self) -> None:
        """Close and open again. Raises DeviceError naming the port if it is not there."""

    def close(self) -> None:
        """Release the port; safe twice."""


class Ports(Protocol):
    """Where links come from: the ports of this computer, or the deterministic cell. None is open yet.

    `name` says what the link is for, such as "robot" or "laser"; two links of one device have two names.
    """

    def statistics(self) -> Mapping[str, LinkStatistics]:
        """What each link has seen, by its name; empty in the deterministic cell."""

    @property
    def searches(self) -> Mapping[str, Search]:
        """How to connect the devices on links that have no fixed port, by name; devices without are there."""

    def can_bus(self, name: str, interface: str, port: str, bitrate: int) -> CanLink:
        """A CAN bus behind an "slcan" dongle or a "socketcan" interface."""

    def serial(self, name: str, port: str, baud: int, framing: str = "8N1") -> ByteLink:
        """A serial line; `framing` is data bits, parity (N, E, O) and stop bits."""

    def tcp(self, name: str, host: str, port: int) -> ByteLink:
        """A TCP connection."""
