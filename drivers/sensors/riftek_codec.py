"""RIFTEK RF602/603/605: requests, packets and parameters as pure functions.

Source: RF602 user's manual 1.2.0, pages 12 to 20. Its example of reading parameter 05h shows the bytes of
parameter 02h, and it calls 1234 what is 3039h (12345).
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.errors import FrameError
from estimation.transform import FloatArray

CodeArray = NDArray[np.int64]

FULL_RANGE: Final = 0x4000
RESULT_NIBBLES: Final = 4
IDENTITY_NIBBLES: Final = 16

_ASCII_HEAD: Final = re.compile(rb"[0-9]{1,10}(\n[0-9]{1,10}){4}")
_ASCII_RESULT: Final = re.compile(rb"[0-9]{1,5}")

IDENTIFY, READ, WRITE, FLASH, LATCH, RESULT, STREAM, STOP = range(1, 9)
LASER_ON, CONTROL, AVERAGES, PERIOD_LOW, PERIOD_HIGH, HOLD = 0x00, 0x02, 0x06, 0x08, 0x09, 0x10

# Register numbers of the manual, pages 18 and 19; where counting starts on the wire it does not say.
SERIAL_REGISTER: Final = 3  # then base distance, range and result
LASER_REGISTER, CONTROL_REGISTER, AVERAGES_REGISTER, PERIOD_REGISTER, HOLD_REGISTER = 10, 12, 15, 16, 20


@dataclass(frozen=True, slots=True)
class Head:
    """What a head says about itself."""

    device_type: int
    firmware: int
    serial_number: int
    base_mm: int
    range_mm: int


def request(address: int, code: int, message: bytes = b"") -> bytes:
    """A request (page 12): address, code, and the message as nibbles, the low one first."""
    nibbles = bytes(0x80 | nibble for byte in message for nibble in (byte & 0x0F, byte >> 4))
    return bytes((address, 0x80 | code)) + nibbles


def read_request(address: int, parameter: int) -> bytes:
    """Read one parameter."""
    return request(address, READ, bytes([parameter]))


def write_request(address: int, parameter: int, value: int) -> bytes:
    """Write one parameter; it is not acknowledged."""
    return request(address, WRITE, bytes((parameter, value)))


@dataclass(frozen=True, slots=True)
class Packet:
    """One answer."""

    data: bytes
    number: int  # modulo 4, one more than that of the packet before
    fresh: bool  # another result than was sent last


def parse_packet(received: bytes) -> Packet:
    """The answer in these bytes, all of them. Raises FrameError."""
    heads = {byte >> 4 for byte in received}
    head = heads.pop() if heads else 0
    if heads or not head & 0x8 or len(received) % 2:
        raise FrameError(
            f"Laser sent {received.hex(' ')}, not one packet", "Check cable, baud rate and even parity"
        )
    nibbles = [byte & 0x0F for byte in received]
    data = bytes(low | high << 4 for low, high in zip(nibbles[::2], nibbles[1::2], strict=True))
    return Packet(data, head & 3, bool(head & 4))


def parse_head(data: bytes) -> Head:
    """Answer to IDENTIFY, 8 bytes."""
    serial, base, full = (int.from_bytes(data[i : i + 2], "little") for i in (2, 4, 6))
    return Head(data[0], data[1], serial, base, full)


def parse_ascii_head(line: bytes) -> Head:
    """Answer to V: five numbers with LF between them. Raises FrameError."""
    if not _ASCII_HEAD.fullmatch(line):
        raise FrameError(f"Laser answered V with {line!r}", "Check baud rate, parity and protocol")
    return Head(*(int(part) for part in line.split(b"\n")))


def parse_ascii_result(line: bytes) -> int:
    """Answer to R0, a number of increments. Raises FrameError."""
    if not _ASCII_RESULT.fullmatch(line) or int(line) > 0xFFFF:
        raise FrameError(f"Laser answered R0 with {line!r}", "Check baud rate, parity and protocol")
    return int(line)


def distances(codes: CodeArray, range_m: float) -> FloatArray:
    """Distance from the start of the range, metres (n,)."""
    result: FloatArray = codes.astype(np.float64) * (range_m / FULL_RANGE)
    return result


def resolution(range_m: float) -> float:
    """Distance of two neighbouring results, metres."""
    return range_m / FULL_RANGE


class ResultDecoder:
    """Results of a stream, however its bytes are split.

    All four bytes of a packet have the same head, and the next packet has another one: a packet counts once
    it is followed by another head, so that neither a lost nor a doubled byte makes a value. The first after
    `reset` does not count.
    """

    def __init__(self) -> None:
        self.bad_bytes = self.lost = self.stale = 0  # lost: packets missing in the numbering
        self.reset()
        self._cut = False  # nothing was dropped yet

    def reset(self) -> None:
        """After input was dropped."""
        self._rest, self._number, self._cut = b"", -1, True

    def feed(self, data: bytes) -> CodeArray:
        """The fresh results (n,) that are complete with these bytes."""
        buffer = np.frombuffer(self._rest + data, dtype=np.uint8)
        heads = buffer >> 4
        edges = np.flatnonzero(heads[1:] != heads[:-1]) + 1
        if not edges.size:
            self._rest = buffer[-4 * RESULT_NIBBLES :].tobytes()
            self.bad_bytes += buffer.size - len(self._rest)
            return _NOTHING
        starts = np.concatenate(([0], edges[:-1]))
        self._rest = buffer[edges[-1] :].tobytes()
        sizes = edges - starts
        good = (sizes == RESULT_NIBBLES) & (heads[starts] >= 8)
        if self._cut:  # the first may be the end of a packet, and with a doubled byte looks whole
            good[0], self._cut = False, False
            self.bad_bytes -= int(sizes[0])
        self.bad_bytes += int(sizes[~good].sum())
        starts = starts[good]
        self._count_lost(heads[starts] & 3)
        fresh = (heads[starts] & 4) != 0
        self.stale += int(starts.size - np.count_nonzero(fresh))
        bits = buffer.astype(np.int64) & 0x0F
        starts = starts[fresh]
        codes: CodeArray = (
            bits[starts] | bits[starts + 1] << 4 | bits[starts + 2] << 8 | bits[starts + 3] << 12
        )
        return codes

    def _count_lost(self, numbers: NDArray[np.uint8]) -> None:
        if not numbers.size:
            return
        chain = np.concatenate(([self._number], numbers)).astype(np.int64)
        steps = np.diff(chain[chain >= 0])
        self.lost += int(np.sum((steps - 1) % 4))
        self._number = int(numbers[-1])


_NOTHING: Final[CodeArray] = np.empty(0, dtype=np.int64)
