"""One line of text asked, one answered, on a serial ByteLink."""

from collections.abc import Callable
from typing import Final

from drivers.clock import Clock
from drivers.links.in_step import InStep
from drivers.links.interfaces import ByteLink
from estimation.errors import DeviceTimeout, FrameError

LONGEST_LINE: Final = 512


class AsciiExchange:
    """`terminator` ends questions and answers. See `InStep` for `worst_answer_s` and `on_resync`."""

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        *,
        name: str,
        worst_answer_s: float,
        terminator: bytes = b"\r\n",
        on_resync: Callable[[], None] | None = None,
    ) -> None:
        self._link, self._clock, self._name = link, clock, name
        self._worst_answer_s, self._terminator = worst_answer_s, terminator
        self.step = InStep(link, clock, name, worst_answer_s, on_resync)
        self.frames = self.bad_frames = self.timeouts = 0
        self.sent_s = self.received_s = 0.0  # of the last exchange

    def ask(self, question: bytes, accept: Callable[[bytes], None], within_s: float = 0.0) -> bytes:
        """The answer without its terminator; `accept` raises FrameError for one to another question.

        `within_s` is what the answer takes on the line, beyond `worst_answer_s`.
        Raises DeviceTimeout, FrameError.
        """
        with self.step.transaction():
            answer = self._exchange(question, within_s)
            try:
                accept(answer)
            except FrameError:
                self.bad_frames += 1
                raise
        self.frames += 1
        return answer

    def _exchange(self, question: bytes, within_s: float) -> bytes:
        self._link.write(question + self._terminator)
        self.sent_s = self._clock.now_s()
        deadline_s = self.sent_s + self._worst_answer_s + within_s
        received = b""
        while self._terminator not in received:
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0.0 or len(received) > LONGEST_LINE:
                self.timeouts += 1
                what = f"{received[:40]!r} instead of an" if received else "no"
                raise DeviceTimeout(
                    f"{self._name}: {what} answer to {question.decode()} in {deadline_s - self.sent_s:.2g} s",
                    "Check cable, power, baud rate and parity",
                )
            received += self._link.read(remaining_s)
        self.received_s = self._clock.now_s()
        answer, _, rest = received.partition(self._terminator)
        if rest:
            self.bad_frames += 1
            raise FrameError(f"{self._name} sent {rest[:40]!r} after its answer", "Look for a second master")
        return answer
