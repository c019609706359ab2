"""What every simulated device offers to a wire, real or virtual. Times are of whoever runs the device."""

from typing import NamedTuple, Protocol


class Frame(NamedTuple):
    """One CAN data frame, and when it was on the bus."""

    can_id: int
    data: bytes
    time_s: float = 0.0


class ByteDevice(Protocol):
    """A simulated device behind a byte stream: a serial line, or one TCP connection."""

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client, however they are cut."""

    def next_output_s(self) -> float:
        """Nothing comes before this, if nothing is sent to the device; inf if it only answers."""

    def take(self, time_s: float) -> bytes:
        """All that was sent by then and not yet taken."""

    def discard(self, time_s: float) -> None:
        """Forget what was sent by then."""


class CanDevice(Protocol):
    """A simulated device on a CAN bus."""

    def receive(self, can_id: int, data: bytes, time_s: float) -> None:
        """A frame from the master."""

    def next_output_s(self) -> float:
        """Nothing comes before this, if the master stays silent."""

    def take(self, time_s: float) -> Frame | None:
        """The oldest frame that was on the bus by then."""

    def next_frames(self, until_s: float) -> list[Frame]:
        """The frames that come together next, if that is by then; everything before has happened."""
