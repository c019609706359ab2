"""What every simulated device that answers has: answers that are ready at an instant, in their order."""

import math
from collections import deque


class Answers:
    """The sending half of a byte device."""

    def __init__(self) -> None:
        self._output: deque[tuple[float, bytes]] = deque()

    def next_output_s(self) -> float:
        """When the next answer is ready."""
        return self._output[0][0] if self._output else math.inf

    def take(self, time_s: float) -> bytes:
        """All answers that are ready by then."""
        data = b""
        while self._output and self._output[0][0] <= time_s:
            data += self._output.popleft()[1]
        return data

    def discard(self, time_s: float) -> None:
        """Forget the answers that are ready by then."""
        self.take(time_s)
