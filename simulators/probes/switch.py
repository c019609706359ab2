"""What is wired to a digital input: the switch of a touch probe."""

from typing import Protocol


class Switch(Protocol):
    """Open or closed."""

    closed: bool
    count: int  # of the times it has closed

    def update(self, time_s: float) -> None:
        """Bring it up to that instant."""

    def unchanged_until_s(self, time_s: float) -> float:
        """`closed` does not change before this, as far as can be seen then."""
