"""Keeps the answers of a line in step with the requests, where an answer does not name its request.

There, one that comes late looks like the answer to the next request and shifts all that follow. So after any
failure the line stays silent for longer than the slowest answer, is drained, and says who it is before it
counts again.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Final

from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from estimation.errors import DeviceError, FrameError

LONGEST_DRAIN: Final = 8  # silences, after which the line counts as babbling


class InStep:
    """One request at a time: each in a `transaction`.

    `worst_answer_s` is the longest time in which an answer begins, with what a converter adds; `on_resync`
    reads and compares an identity, with transactions of its own.
    """

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        name: str,
        worst_answer_s: float,
        on_resync: Callable[[], None] | None = None,
    ) -> None:
        self._link, self._clock, self._name = link, clock, name
        self._worst_answer_s, self._on_resync = worst_answer_s, on_resync
        self._out_of_step = self._resynchronising = False
        self.strays = 0  # times that something came when nobody was asked

    def reset(self) -> None:
        """Forget an earlier failure: after the link was opened and its input dropped."""
        self._out_of_step = False

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Around one request and its answer. Any DeviceError inside puts the line out of step."""
        try:
            if not self._resynchronising:
                self._resynchronise()
            yield
        except DeviceError:
            self._out_of_step = True
            raise

    def _resynchronise(self) -> None:
        if self._link.read(0.0):
            self.strays += 1
            self._out_of_step = True
        if not self._out_of_step:
            return
        deadline_s = self._clock.now_s() + LONGEST_DRAIN * self._worst_answer_s
        while self._link.read(self._worst_answer_s):
            if self._clock.now_s() > deadline_s:
                raise FrameError(
                    f"{self._name} sends without being asked", "Look for a second master on the line"
                )
        if self._on_resync is not None:
            self._resynchronising = True
            try:
                self._on_resync()
            finally:
                self._resynchronising = False
        self._out_of_step = False
