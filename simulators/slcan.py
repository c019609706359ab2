"""A serial CAN dongle of the LAWICEL kind: ASCII lines that end with CR; BELL refuses."""

import math
from typing import Final

from simulators.interfaces import CanDevice, Frame

OK: Final = b"\r"
REFUSED: Final = b"\a"
LONGEST_LINE: Final = 32


def encode_frame(frame: Frame) -> bytes:
    """t iii l dd.. CR, without a time stamp."""
    return b"t%03X%d%s\r" % (frame.can_id, len(frame.data), frame.data.hex().upper().encode())


class SlcanDongle:
    """Host side of the dongle. Frames for the bus are collected in `sent`."""

    def __init__(self) -> None:
        self._input = b""
        self._speed_set = False
        self.open = False
        self.sent: list[tuple[int, bytes]] = []

    def receive(self, data: bytes) -> bytes:
        """What the dongle answers to bytes from the host."""
        self._input += data
        answers = b""
        while b"\r" in self._input:
            line, _, self._input = self._input.partition(b"\r")
            if line:
                answers += self._line(line)
        if len(self._input) > LONGEST_LINE:
            self._input = b""
            answers += REFUSED
        return answers

    def _line(self, line: bytes) -> bytes:
        command, rest = line[:1], line[1:]
        if command in (b"S", b"s"):
            if self.open or (command == b"S" and rest not in (b"%d" % n for n in range(9))):
                return REFUSED
            self._speed_set = True
            return OK
        if command == b"O":
            if self.open or not self._speed_set:
                return REFUSED
            self.open = True
            return OK
        if command == b"C":
            was_open, self.open = self.open, False
            return OK if was_open else REFUSED
        if command == b"V":
            return b"V1013\r"
        if command == b"N":
            return b"NTC01\r"
        if command == b"F":
            return b"F00\r" if self.open else REFUSED
        if command in (b"Z", b"M", b"m", b"W", b"X"):
            return OK
        if command in (b"t", b"T", b"r", b"R") and self.open:
            return self._frame(command, rest)
        return REFUSED

    def _frame(self, command: bytes, rest: bytes) -> bytes:
        digits = 3 if command in b"tr" else 8
        try:
            can_id, size = int(rest[:digits], 16), int(rest[digits : digits + 1])
            data = bytes.fromhex(rest[digits + 1 :].decode("ascii"))
        except (ValueError, UnicodeDecodeError):
            return REFUSED
        if size > 8 or (command in b"tT" and len(data) != size):
            return REFUSED
        if command == b"t":  # remote and extended frames mean nothing to this arm
            self.sent.append((can_id, data))
        return OK


class SlcanDevice:
    """A CAN bus behind a dongle, as one byte device; frames are lost while the channel is closed."""

    def __init__(self, bus: CanDevice) -> None:
        self._bus, self._dongle = bus, SlcanDongle()
        self._answers = b""
        self._answers_s = math.inf

    def receive(self, data: bytes, time_s: float) -> None:
        """Lines from the host."""
        answers = self._dongle.receive(data)
        if answers:
            self._answers += answers
            self._answers_s = min(self._answers_s, time_s)
        for can_id, payload in self._dongle.sent:
            self._bus.receive(can_id, payload, time_s)
        self._dongle.sent.clear()

    def next_output_s(self) -> float:
        """When the next line is handed over."""
        return min(self._answers_s, self._bus.next_output_s())

    def take(self, time_s: float) -> bytes:
        """All lines handed over by then."""
        lines, self._answers, self._answers_s = [self._answers], b"", math.inf
        while (frame := self._bus.take(time_s)) is not None:
            if self._dongle.open:
                lines.append(encode_frame(frame))
        return b"".join(lines)

    def discard(self, time_s: float) -> None:
        """Forget what was handed over by then."""
        self.take(time_s)
