"""Keyence DL-RS1A: commands, answers and data as pure functions.

Source: DL-RS1A user's manuals, editions GT2 (96078E), IL (96081E), IG, SK: communication specifications.
"""

import re
from dataclasses import dataclass
from typing import Final

from estimation.errors import DeviceError, FrameError

ALL_VALUES: Final = b"M0"
ERRORS: Final = {
    "00": "no such command",
    "20": "wrong length of data",
    "21": "wrong number of parameters",
    "22": "parameter out of range, read only or badly formed",
    "29": "error of the serial line",
    "65": "no such amplifier",
}
_ERROR: Final = re.compile(r"ER,(?P<command>[A-Z0-9]{2}),(?P<number>\d{2})")
_NUMBER: Final = re.compile(r"[+-]\d{2,3}\.\d{3,4}")
_NO_NUMBER: Final = re.compile(r"9+[89]")  # over range, under range, not valid yet


@dataclass(frozen=True, slots=True)
class Head:
    """What amplifiers of one kind call their data."""

    raw: str  # data number of the value that nothing holds or offsets
    errors: str  # data number of the error bits
    step_m: float  # of the last digit


HEADS: Final = {
    "GT2": Head(raw="002", errors="006", step_m=1e-7),  # the numbers of the GT-70A, as far as seen
    "IL": Head(raw="038", errors="033", step_m=1e-6),  # the numbers of the IG
}


def read_request(amplifier: int, number: str) -> bytes:
    """One data item of one amplifier."""
    return f"SR,{amplifier:02d},{number}".encode("ascii")


def line_bytes(request: bytes) -> int:
    """Bytes of a request and of its longest answer, with their ends."""
    return len(request) + 2 + 12 + 9


def parse_item(line: bytes, request: bytes) -> str:
    """The data in the answer to a `read_request`.

    Raises FrameError for an answer to another one, DeviceError where the unit refuses.
    """
    text = _text(line)
    _refuse(text, request)
    head, _, data = text.rpartition(",")
    if head != request.decode("ascii") or not data:
        raise FrameError(
            f"Gauge unit answered {request.decode()} with {text!r}", "Look for a second master on the line"
        )
    return data


def parse_all(line: bytes) -> list[str]:
    """The measured values of all amplifiers in the answer to M0. Raises FrameError, DeviceError."""
    text = _text(line)
    _refuse(text, ALL_VALUES)
    command, *values = text.split(",")
    if command != "M0" or not values:
        raise FrameError(f"Gauge unit answered M0 with {text!r}", "Check baud rate and parity")
    return values


def parse_value(data: str) -> float | None:
    """Metres from a data field in millimetres; None for anything that is no measured value."""
    if not _NUMBER.fullmatch(data) or _NO_NUMBER.fullmatch(data[1:].replace(".", "")):
        return None
    return float(data) * 1e-3


def _text(line: bytes) -> str:
    try:
        return line.decode("ascii")
    except UnicodeDecodeError:
        raise FrameError(f"Gauge unit sent {line[:40]!r}", "Check baud rate, data bits and parity") from None


def _refuse(text: str, request: bytes) -> None:
    error = _ERROR.fullmatch(text)
    if error is not None and request.startswith(error["command"].encode()):
        words = ERRORS.get(error["number"], "no reason that is known")
        raise DeviceError(
            f"Gauge unit refused {request.decode()}: {words} ({error['number']})",
            "Check amplifiers and their plugs, and the kind of head in the cell file",
        )
