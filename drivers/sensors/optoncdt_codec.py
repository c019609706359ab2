"""optoNCDT 1420: the binary value stream and the ASCII replies, as pure functions.

Source: optoNCDT 1420 instruction manual, 7.5.2 (values) and appendix A 3 (commands). The words of the
error codes are from general knowledge; every value above full scale is rejected, known or not.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

CodeArray = NDArray[np.int64]

FULL_SCALE: Final = 65520
FIRST_IN_RANGE: Final = 643
LAST_IN_RANGE: Final = 64877
PROMPT: Final = b"->"

_ERROR_WORDS: Final[Mapping[int, str]] = {
    262073: "scaling underflow",
    262074: "scaling overflow",
    262075: "too much data for the baud rate",
    262076: "no peak",
    262077: "peak before the range",
    262078: "peak behind the range",
    262080: "not calculable",
    262081: "not evaluable",
    262082: "laser off",
}


class StreamDecoder:
    """Finds the three-byte values L (00......), M (01......), H (1.......), however the bytes are split.

    An L byte always restarts; bytes that fit nowhere are counted and dropped: a lost byte costs one value.
    H says whether a value is the first (10) of its measurement; further ones (11) are not distances and count
    as bad, because none was asked for.
    """

    def __init__(self) -> None:
        self.bad_bytes = 0
        self._rest, self._discard, self._cut = b"", False, False

    def reset(self) -> None:
        """After input was dropped: forget an incomplete value, and expect the end of another."""
        self._rest, self._cut = b"", True

    def discard_next(self) -> None:
        """After a reply: its text and a cut value can together look like one value."""
        self._discard = True

    def feed(self, data: bytes) -> CodeArray:
        """The values (n,) that are complete with these bytes."""
        buffer = np.frombuffer(self._rest + data, dtype=np.uint8)
        flags = buffer >> 6
        starts = np.flatnonzero((flags[:-2] == 0) & (flags[1:-1] == 1) & (flags[2:] == 2))
        end = int(starts[-1]) + 3 if starts.size else 0
        # What may still become a value: L, or L and M, at the very end.
        tail = flags[max(end, buffer.size - 2) :].tolist()
        kept = 2 if tail == [0, 1] else 1 if tail and tail[-1] == 0 else 0
        self._rest = buffer[buffer.size - kept :].tobytes()
        expected = 0
        if self._cut and buffer.size:
            self._cut, first = False, flags[:2].tolist()
            expected = 2 if first[0] == 1 and first[-1] >= 2 else 1 if first[0] >= 2 else 0
        self.bad_bytes += buffer.size - kept - expected - 3 * starts.size
        bits = buffer.astype(np.int64) & 0x3F
        codes: CodeArray = bits[starts] | bits[starts + 1] << 6 | bits[starts + 2] << 12
        if self._discard and codes.size:
            self._discard, codes = False, codes[1:]
        return codes


def distances(codes: CodeArray, range_m: float) -> FloatArray:
    """Distance from the start of the measuring range, metres (n,), of values without mastering."""
    return (codes.astype(np.float64) * (102.0 / FULL_SCALE) - 1.0) / 100.0 * range_m


def resolution(range_m: float) -> float:
    """Distance of two neighbouring values, metres."""
    return 1.02 / FULL_SCALE * range_m


def in_range(codes: CodeArray) -> NDArray[np.bool_]:
    """True (n,) where the value is a distance inside the measuring range, neither error nor reserve."""
    return (codes >= FIRST_IN_RANGE) & (codes <= LAST_IN_RANGE)


def code_words(code: int) -> str:
    """Why this value is not a distance."""
    if code < FIRST_IN_RANGE:
        return "before the measuring range"
    if code <= FULL_SCALE:
        return "behind the measuring range"
    return _ERROR_WORDS.get(code, f"error value {code}")


@dataclass(frozen=True, slots=True)
class Reply:
    """What came before the prompt."""

    lines: tuple[str, ...]
    error: str  # the line `Exxx ...` of a command that was not executed, or ""
    warning: str  # the line `Wxxx ...` of one that was executed all the same, or ""


def parse_reply(data: bytes) -> Reply | None:
    """The reply in these bytes; None until its prompt has arrived.

    Values of a stream still running may come before and between: only printable lines count.
    """
    end = data.rfind(PROMPT)
    if end < 0:
        return None
    text = "".join(chr(byte) if 32 <= byte < 127 or byte in b"\r\n" else "" for byte in data[:end])
    lines = tuple(line.strip() for line in re.split(r"[\r\n]+", text) if line.strip())
    marked = {line[0]: line for line in lines if re.match(r"[EW]\d{2,3}\b", line)}
    return Reply(lines, marked.get("E", ""), marked.get("W", ""))


# The exact text of GETINFO is not in our sources: patterns are a setting, and lenient.
INFO_PATTERNS: Final[Mapping[str, str]] = {
    "model": r"(?im)^\s*(?:name|sensor|article|type)\s*:\s*(.+?)\s*$",
    "serial_number": r"(?im)^\s*serial(?:\s*(?:number|no\.?))?\s*:\s*(\S+)\s*$",
    "firmware": r"(?im)^\s*(?:version|firmware|softwareversion)\s*:\s*(.+?)\s*$",
    "range_mm": r"(?im)^\s*(?:measuring\s+)?range\s*:\s*([\d.]+)\s*(?:mm)?\s*$",
}


def parse_info(reply: Reply, patterns: Mapping[str, str] = INFO_PATTERNS) -> dict[str, str]:
    """Fields of the GETINFO reply; "" for one that it does not name."""
    text = "\n".join(reply.lines)
    found = {name: re.search(pattern, text) for name, pattern in patterns.items()}
    return {name: match.group(1) if match else "" for name, match in found.items()}
