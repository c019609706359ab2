"""On which line of a TOML text each key stands, and which keys stand twice.

tomllib gives values without lines, so this reads the text once more. It never refuses: on text that
is not TOML it stops early, and tomllib says what is wrong.
"""

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

KeyPath = tuple[str | int, ...]

_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_KEY = re.compile(r"""[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'""")
_STRING = re.compile(r'''"""(?:[^\\]|\\.)*?"""|\'\'\'.*?\'\'\'|"(?:[^"\\\n]|\\.)*"|'[^'\n]*\'''', re.DOTALL)
_BARE = re.compile(r"[^,\]}#\n]*")


@dataclass(frozen=True, slots=True)
class Duplicate:
    """A key or table that stands twice."""

    path: KeyPath
    line: int
    first_line: int
    start: int  # the text of the second one
    end: int


@dataclass(slots=True)
class LineIndex:
    """The line of every key, counted from 1."""

    lines: dict[KeyPath, int] = field(default_factory=dict)
    duplicates: list[Duplicate] = field(default_factory=list)

    def line_of(self, path: KeyPath) -> int:
        """Line of the key, or of the nearest table around it."""
        for length in range(len(path), 0, -1):
            if (line := self.lines.get(path[:length])) is not None:
                return line
        return 1


class _NotToml(Exception):
    """The text cannot be followed any further."""


class _Scanner:
    def __init__(self, text: str) -> None:
        self._text, self._at = text, 0
        self._line, self._counted_to = 1, 0
        self._table: KeyPath = ()
        self._headers: set[KeyPath] = set()
        self._array_sizes: dict[KeyPath, int] = {}
        self._open_duplicate: tuple[KeyPath, int, int] | None = None  # of a table: path, line, start
        self.index = LineIndex()

    def scan(self) -> None:
        while True:
            self._skip(_BLANK)
            if self._at >= len(self._text):
                break
            if self._text[self._at] == "[":
                self._header()
            else:
                self._key_value(self._table)
            self._skip(_SPACE)
            if self._at < len(self._text) and self._text[self._at] not in "#\r\n":
                raise _NotToml
        self._close_duplicate_table()

    def _line_here(self) -> int:
        self._line += self._text.count("\n", self._counted_to, self._at)
        self._counted_to = self._at
        return self._line

    def _skip(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._at)
        if match is None:
            raise _NotToml
        self._at = match.end()
        return match.group()

    def _expect(self, literal: str) -> None:
        if not self._text.startswith(literal, self._at):
            raise _NotToml
        self._at += len(literal)

    def _dotted_key(self) -> Iterator[str]:
        while True:
            self._skip(_SPACE)
            key = self._skip(_KEY)
            yield key[1:-1] if key[0] in "\"'" else key
            self._skip(_SPACE)
            if not self._text.startswith(".", self._at):
                return
            self._at += 1

    def _header(self) -> None:
        self._close_duplicate_table()
        start, line = self._at, self._line_here()
        is_array = self._text.startswith("[[", self._at)
        self._expect("[[" if is_array else "[")
        keys = list(self._dotted_key())
        self._expect("]]" if is_array else "]")
        path: KeyPath = ()
        for position, key in enumerate(keys):
            path += (key,)
            if position < len(keys) - 1:
                self.index.lines.setdefault(path, line)
                if path in self._array_sizes:
                    path += (self._array_sizes[path] - 1,)
        if is_array:
            size = self._array_sizes.get(path, 0)
            self._array_sizes[path] = size + 1
            self.index.lines.setdefault(path, line)
            path += (size,)
        elif path in self._headers:
            self._open_duplicate = (path, line, start)
        if self._open_duplicate is None:
            if not is_array and path not in self._headers:
                self.index.lines[path] = line  # before, it may have been known from a table inside it only
            self.index.lines.setdefault(path, line)
        self._headers.add(path)
        self._table = path

    def _close_duplicate_table(self) -> None:
        if self._open_duplicate is not None:
            path, line, start = self._open_duplicate
            first_line = self.index.lines.get(path, 1)
            self.index.duplicates.append(Duplicate(path, line, first_line, start, self._at))
            self._open_duplicate = None

    def _key_value(self, table: KeyPath) -> None:
        start, line = self._at, self._line_here()
        path = table
        keys = list(self._dotted_key())
        for key in keys[:-1]:
            path += (key,)
            self.index.lines.setdefault(path, line)
        path += (keys[-1],)
        first_line = self.index.lines.get(path)
        self._expect("=")
        self._skip(_SPACE)
        if first_line is None:
            self.index.lines[path] = line
        self._value(path)
        if first_line is not None and self._open_duplicate is None:
            self.index.duplicates.append(Duplicate(path, line, first_line, start, self._at))

    def _value(self, path: KeyPath) -> None:
        if self._at >= len(self._text):
            raise _NotToml
        first = self._text[self._at]
        if first == "[":
            self._array(path)
        elif first == "{":
            self._inline_table(path)
        elif first in "\"'":
            self._skip(_STRING)
        else:
            self._skip(_BARE)

    def _array(self, path: KeyPath) -> None:
        self._expect("[")
        position = 0
        while True:
            self._skip(_BLANK)
            if self._text.startswith("]", self._at):
                break
            element = (*path, position)
            self.index.lines.setdefault(element, self._line_here())
            before = self._at
            self._value(element)
            self._skip(_BLANK)
            if self._text.startswith(",", self._at):
                self._at += 1
            elif not self._text.startswith("]", self._at) or self._at == before:
                raise _NotToml
            position += 1
        self._expect("]")

    def _inline_table(self, path: KeyPath) -> None:
        self._expect("{")
        self._skip(_SPACE)
        while not self._text.startswith("}", self._at):
            self._key_value(path)
            self._skip(_SPACE)
            if self._text.startswith(",", self._at):
                self._at += 1
                self._skip(_SPACE)
            elif not self._text.startswith("}", self._at):
                raise _NotToml
        self._expect("}")


def index_lines(text: str) -> LineIndex:
    """Find the line of every key, as far as the text can be followed."""
    scanner = _Scanner(text)
    with contextlib.suppress(_NotToml, RecursionError):
        scanner.scan()
    return scanner.index


def without(text: str, duplicates: list[Duplicate]) -> str:
    """The text with the second ones blanked out; all line numbers stay."""
    for duplicate in duplicates:
        kept = re.sub(r"[^\r\n]", " ", text[duplicate.start : duplicate.end])
        text = text[: duplicate.start] + kept + text[duplicate.end :]
    return text
