"""A device's end of a serial line: every byte takes its time, both ways."""

import math
from collections import deque
from typing import Final

CONVERTER_S: Final = 0.001  # a USB converter hands over what it has at these intervals
ROUNDING_S: Final = 1e-9


class Uart:
    """What the device says leaves byte by byte; what it hears has arrived when its last byte has."""

    def __init__(self, baud: int, bits_per_byte: int = 10, converter_s: float = CONVERTER_S) -> None:
        self.baud, self._bits, self._converter_s = baud, bits_per_byte, converter_s
        self._output: deque[tuple[float, bytes]] = deque()  # when it is complete, and a byte or more
        self._free_s = self._heard_s = 0.0

    @property
    def byte_s(self) -> float:
        """Duration of one byte."""
        return self._bits / self.baud

    @property
    def free_s(self) -> float:
        """When the last byte said so far will have left."""
        return self._free_s

    def heard_s(self, count: int, time_s: float) -> float:
        """When the last of `count` bytes has arrived that the host began to send at `time_s`."""
        self._heard_s = max(self._heard_s, time_s) + count * self.byte_s
        return self._heard_s

    def say(self, data: bytes, time_s: float) -> None:
        """Send, as soon as the line is free."""
        byte_s, start_s = self.byte_s, max(self._free_s, time_s)
        self._output += [(start_s + (i + 1) * byte_s, data[i : i + 1]) for i in range(len(data))]
        self._free_s = start_s + len(data) * byte_s

    def clear(self, time_s: float) -> None:
        """The power goes: what has not left never will."""
        self._output.clear()
        self._free_s = time_s

    def next_output_s(self) -> float:
        """When the converter hands over the next bytes."""
        return self.handed_over_s(self._output[0][0]) if self._output else math.inf

    def handed_over_s(self, complete_s: float) -> float:
        """When the converter passes on what is complete then."""
        return math.ceil((complete_s - ROUNDING_S) / self._converter_s) * self._converter_s

    def handed_over_until_s(self, time_s: float) -> float:
        """What is complete by this instant has been passed on by `time_s`."""
        return math.floor((time_s + ROUNDING_S) / self._converter_s) * self._converter_s + ROUNDING_S

    def take(self, time_s: float) -> bytes:
        """All bytes handed over by then."""
        until_s, data = self.handed_over_until_s(time_s), bytearray()
        while self._output and self._output[0][0] <= until_s:
            data += self._output.popleft()[1]
        return bytes(data)
