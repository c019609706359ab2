"""URScript as far as a client sends it: programs of calls with literal numbers, run from top to bottom."""

import re
from dataclasses import dataclass
from typing import Final

_HEAD: Final = re.compile(r"\s*def\s+\w+\s*\(\s*\)\s*:\s*")
_CALL: Final = re.compile(r"\s*(\w+)\s*\((.*)\)\s*")
_WORDS: Final = re.compile(r"p?\[[^\[\]]*\]|[^,\[\]]+")
_LONGEST: Final = 100_000


class ScriptError(Exception):
    """Not a program; never leaves the simulator."""


@dataclass(frozen=True, slots=True)
class Call:
    """A function with its arguments: lists and poses are tuples."""

    name: str
    arguments: tuple[tuple[float, ...], ...]
    named: dict[str, float]


def parse_call(line: str) -> Call:
    """Raises ScriptError."""
    match = _CALL.fullmatch(line)
    if match is None:
        raise ScriptError(line)
    arguments, named = list[tuple[float, ...]](), dict[str, float]()
    try:
        for word in (word.strip() for word in _WORDS.findall(match[2])):
            key, equals, value = word.partition("=")
            if equals:
                named[key.strip()] = float(value)
            elif word:
                inner = word.removeprefix("p").strip("[]")
                arguments.append(tuple(float(number) for number in inner.split(",")))
    except ValueError:
        raise ScriptError(line) from None
    return Call(match[1], tuple(arguments), named)


class ScriptReader:
    """Collects lines until a program is complete: `def` to `end`, or one line outside."""

    def __init__(self) -> None:
        self._input = b""
        self._lines: list[str] | None = None

    def feed(self, data: bytes) -> list[list[str]]:
        """Programs that are complete now, as lines."""
        self._input = (self._input + data)[-_LONGEST:]
        programs = list[list[str]]()
        while b"\n" in self._input:
            raw, _, self._input = self._input.partition(b"\n")
            line = raw.decode("utf-8", errors="replace").strip()
            if _HEAD.fullmatch(line):
                self._lines = []
            elif self._lines is None:
                programs += [[line]] if line else []
            elif line == "end":
                programs.append(self._lines)
                self._lines = None
            elif line:
                self._lines.append(line)
        return programs
