"""The one seam for time: real in the cell, virtual in the deterministic cell."""

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic time in seconds. Every deadline in truecell is measured with it."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start; never goes backwards."""

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` pass; nothing if it is past already."""

    def utc_s(self) -> float:
        """Wall time, seconds since 1970 UTC: for records only, never for a deadline."""


class RealClock:
    """The time of this computer."""

    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        time.sleep(max(duration_s, 0.0))

    def utc_s(self) -> float:
        return time.time()
