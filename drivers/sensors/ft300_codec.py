"""Robotiq FT 300: registers and stream frames as pure functions.

Source: FT 300 instruction manual, section 4.4. It prints the CRC of its first example once as 04 A6: 84 A6 is
right. Registers have the high byte first, the stream the low one.
"""

import struct
from collections.abc import Sequence
from typing import Final

import numpy as np
from pymodbus.framer import FramerRTU

from estimation.transform import FloatArray

BAUD: Final = 19200
BITS_PER_BYTE: Final = 10  # 8N1
UNIT: Final = 9
RATE_HZ: Final = 100.0
WRENCH_REGISTER: Final = 180  # Fx Fy Fz Mx My Mz
STREAM_REGISTER: Final = 410
STREAM_ON: Final = 0x0200
FIRMWARE_REGISTER: Final = 500  # text, then serial number and year
INFO_REGISTERS: Final = 15

HEADER: Final = b"\x20\x4e"
FRAME_BYTES: Final = 16
PER_UNIT: Final[FloatArray] = np.array([100.0] * 3 + [1000.0] * 3)  # counts per N and per Nm
_WRENCH: Final = struct.Struct("<6h")


def wrench(registers: Sequence[int]) -> FloatArray:
    """Force (N) and torque (Nm) of the six registers, (6,)."""
    result: FloatArray = np.array(struct.unpack(">6h", struct.pack(">6H", *registers))) / PER_UNIT
    return result


def text(registers: Sequence[int]) -> str:
    """Two characters in each register, the first in the high byte; hexadecimal digits if they are none."""
    data = struct.pack(f">{len(registers)}H", *registers).strip(b"\0 ")
    return data.decode("ascii") if all(0x20 <= byte < 0x7F for byte in data) else data.hex().upper()


class StreamDecoder:
    """Wrenches of a stream, however its bytes are split.

    The header can occur inside of data: a frame counts only if its CRC fits, otherwise the search goes on one
    byte further.
    """

    def __init__(self) -> None:
        self.bad_bytes = 0
        self._rest, self._cut = b"", True

    def reset(self) -> None:
        """After input was dropped; a frame that was cut by it is no bad one."""
        self._rest, self._cut = b"", True

    def feed(self, data: bytes) -> FloatArray:
        """The wrenches (n, 6), N and Nm, that are complete with these bytes."""
        buffer, at, found = self._rest + data, 0, list[tuple[int, ...]]()
        while (start := buffer.find(HEADER, at)) >= 0 and start + FRAME_BYTES <= len(buffer):
            frame = buffer[start : start + FRAME_BYTES]
            if FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big")):
                self._skipped(start - at)
                found.append(_WRENCH.unpack_from(frame, 2))
                at = start + FRAME_BYTES
            else:
                self._skipped(start + 1 - at)
                at = start + 1
        keep = start if start >= 0 else max(at, len(buffer) - buffer.endswith(HEADER[:1]))
        self._skipped(keep - at)
        self._rest = buffer[keep:]
        return np.array(found, dtype=np.float64).reshape(-1, 6) / PER_UNIT

    def _skipped(self, count: int) -> None:
        """Before the first frame, less than one may be missing its beginning."""
        if not count:
            self._cut = False
        elif not (self._cut and count < FRAME_BYTES):
            self.bad_bytes += count
