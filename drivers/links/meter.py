"""What a link has seen on its way: how much, how long answers took, how often it was opened."""

import bisect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

BOUNDS_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """Counts since the link was made. Sent and received are bytes, or frames on a CAN bus.

    `answers` counts how long the driver waited from its last word to the next that came: at most BOUNDS_S[i]
    in answers[i], longer than all of them in the last. `late` of them came after a wait was given up.
    """

    port: str
    opened: int
    broken: int  # times that it was gone, or could not be opened
    sent: int
    received: int
    late: int
    answers: tuple[int, ...]
    longest_answer_s: float

    def answered_within_s(self, share: float) -> float | None:
        """The bound below which this share of the answers lies; None of none, or beyond the last bound."""
        wanted, seen = share * sum(self.answers), 0
        for bound_s, count in zip(BOUNDS_S, self.answers, strict=False):
            seen += count
            if seen and seen >= wanted:
                return min(bound_s, self.longest_answer_s)
        return None


class LinkMeter:
    """Told by a link of all it does; `now_s` is its clock."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._opened = self._broken = self._sent = self._received = self._late = 0
        self._answers = [0] * (len(BOUNDS_S) + 1)
        self._longest_s = 0.0
        self._asked_s: float | None = None
        self._given_up = False

    def opened(self) -> None:
        """The port was opened; what was asked before has no answer any more."""
        self._opened += 1
        self._asked_s = None

    def broken(self) -> None:
        """The port is gone, or could not be opened."""
        self._broken += 1
        self._asked_s = None

    def sent(self, count: int) -> None:
        """So many bytes or frames."""
        self._sent += count
        self._asked_s, self._given_up = self._now_s(), False

    def received(self, count: int, waited_s: float) -> None:
        """So many bytes or frames came of a read that would wait so long; 0 if none came."""
        if count:
            self._received += count
            if self._asked_s is not None:
                self._answered(self._now_s() - self._asked_s)
        elif waited_s > 0.0:
            self._given_up = True

    def _answered(self, took_s: float) -> None:
        self._asked_s = None
        self._late += self._given_up
        self._answers[bisect.bisect_left(BOUNDS_S, took_s)] += 1
        self._longest_s = max(self._longest_s, took_s)

    def statistics(self, port: str) -> LinkStatistics:
        """All of it, now."""
        return LinkStatistics(
            port,
            self._opened,
            self._broken,
            self._sent,
            self._received,
            self._late,
            tuple(self._answers),
            self._longest_s,
        )
