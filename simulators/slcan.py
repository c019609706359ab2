"""A serial CAN dongle of the LAWICEL kind: ASCII lines that end with CR; BELL refuses."""

from typing import Final

from simulators.robots.canopen_arm import Frame

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
