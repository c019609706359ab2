"""What a Modbus device says to a request, whatever the frame around it (Application Protocol V1.1b3).

Written without the library that the drivers use.
"""

import struct
from collections.abc import Sequence
from typing import Final, Protocol

ILLEGAL_FUNCTION: Final = 1
ILLEGAL_ADDRESS: Final = 2
ILLEGAL_VALUE: Final = 3
MOST_READ: Final = 125
MOST_WRITTEN: Final = 123
MOST_BITS_READ: Final = 2000
MOST_BITS_WRITTEN: Final = 1968
BIT_READS: Final = (1, 2)
WORD_READS: Final = (3, 4)
READS: Final = BIT_READS + WORD_READS
COIL: Final = {0x0000: False, 0xFF00: True}  # what function 5 may write


class Refused(Exception):
    """The request gets an exception answer with this code; never leaves the simulator."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


class Registers(Protocol):
    """The words of a device, addressed as on the wire; both raise Refused, and then nothing is written."""

    def read(self, function: int, address: int, count: int, time_s: float) -> Sequence[int]:
        """Words of 16 bits."""

    def write(self, address: int, words: Sequence[int], time_s: float) -> None:
        """Take over words."""


class Bits(Protocol):
    """The coils and inputs of a device; both raise Refused, and then nothing is written."""

    def read_bits(self, function: int, address: int, count: int, time_s: float) -> Sequence[bool]:
        """Coils or discrete inputs."""

    def write_bits(self, address: int, states: Sequence[bool], time_s: float) -> None:
        """Take over coils."""


class RegistersAndBits(Registers, Bits, Protocol):
    """A device that has both."""


def answer_pdu(
    pdu: bytes, functions: Sequence[int], device: Registers | RegistersAndBits, time_s: float
) -> bytes:
    """The answer to a function with its parameters, good or refused; `functions` are those of the device."""
    function = pdu[0]
    try:
        if function not in functions:
            raise Refused(ILLEGAL_FUNCTION)
        return bytes([function]) + _execute(function, pdu[1:], device, time_s)
    except Refused as refused:
        return bytes([function | 0x80, refused.code])


def _execute(function: int, body: bytes, device: Registers | RegistersAndBits, time_s: float) -> bytes:
    if len(body) < 4:
        raise Refused(ILLEGAL_VALUE)
    address, number = struct.unpack_from(">HH", body)
    if function in READS:
        return _read(function, address, number, body, device, time_s)
    if function in (5, 6):
        if len(body) != 4 or (function == 5 and number not in COIL):
            raise Refused(ILLEGAL_VALUE)
        if function == 5:
            device.write_bits(address, [COIL[number]], time_s)  # type: ignore[union-attr]  # it has the function
        else:
            device.write(address, [number], time_s)
        return body
    if function not in (15, 16):
        raise Refused(ILLEGAL_FUNCTION)
    most, size = (MOST_BITS_WRITTEN, -(-number // 8)) if function == 15 else (MOST_WRITTEN, 2 * number)
    if not 1 <= number <= most or len(body) != 5 + size or body[4] != size:
        raise Refused(ILLEGAL_VALUE)
    if function == 15:
        states = [bool(body[5 + i // 8] >> i % 8 & 1) for i in range(number)]
        device.write_bits(address, states, time_s)  # type: ignore[union-attr]
    else:
        device.write(address, struct.unpack_from(f">{number}H", body, 5), time_s)
    return body[:4]


def _read(
    function: int,
    address: int,
    count: int,
    body: bytes,
    device: Registers | RegistersAndBits,
    time_s: float,
) -> bytes:
    most = MOST_BITS_READ if function in BIT_READS else MOST_READ
    if len(body) != 4 or not 1 <= count <= most:
        raise Refused(ILLEGAL_VALUE)
    if function in WORD_READS:
        words = device.read(function, address, count, time_s)
        return bytes([2 * count]) + struct.pack(f">{count}H", *words)
    states = device.read_bits(function, address, count, time_s)  # type: ignore[union-attr]
    packed = sum(int(state) << i for i, state in enumerate(states))
    size = -(-count // 8)
    return bytes([size]) + packed.to_bytes(size, "little")
