"""What is wrong in a cell file, and where: file, line, key, value, and what is allowed."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from controller.cellfile.lines import KeyPath, LineIndex
from controller.quantities import shown
from estimation.errors import CellFileError


@dataclass(frozen=True, slots=True)
class Mistake:
    """One mistake in a cell file."""

    file: str
    line: int  # counted from 1; 1 if the mistake belongs to no line
    key: str  # "robot.sync_period"; "" if it belongs to no key
    value: str  # as a message shows it; "" for a key that is missing
    problem: str
    remedy: str

    def __str__(self) -> str:
        setting = f"{self.key} = {self.value}" if self.value else self.key
        place = f"{self.file}:{self.line}: " + (f"{setting}: " if setting else "")
        return f"{place}{self.problem}" + (f", {self.remedy}" if self.remedy else "")


def format_mistakes(mistakes: Sequence[Mistake]) -> str:
    """One line for each mistake, in the order of the file."""
    return "\n".join(str(mistake) for mistake in mistakes)


class CellFileMistakes(CellFileError):
    """All mistakes of one cell file."""

    def __init__(self, mistakes: Sequence[Mistake]) -> None:
        self.mistakes = tuple(mistakes)
        count = "1 mistake" if len(mistakes) == 1 else f"{len(mistakes)} mistakes"
        super().__init__(
            f"{count} in the cell file:\n{format_mistakes(mistakes)}\n", "Correct the file and check it again"
        )

    def __str__(self) -> str:
        return f"{self.problem}{self.remedy}."

    def __reduce__(self) -> tuple[type["CellFileMistakes"], tuple[tuple[Mistake, ...]]]:
        return type(self), (self.mistakes,)


@dataclass(frozen=True, slots=True)
class Source:
    """The text that a cell or data set was read from: turns a key path into file, line and value."""

    file: str
    text: str = field(repr=False)
    index: LineIndex = field(repr=False)
    data: dict[str, Any] = field(repr=False)
    schema: dict[str, Any] = field(repr=False, default_factory=dict)  # JSON schema that the data shall keep

    def mistake(self, path: KeyPath, problem: str, remedy: str = "") -> Mistake:
        """A mistake at a key, such as ("job", "phases", 2, "limit")."""
        value = self.value(path)
        written = shown(value) if not isinstance(value, dict) and not _is_tables(value) else ""
        return Mistake(self.file, self.index.line_of(path), self.key(path), written, problem, remedy)

    def value(self, path: KeyPath) -> object:
        """The value in the file, or an empty table if there is none."""
        here: Any = self.data
        for step in path:
            try:
                here = here[step]
            except (KeyError, IndexError, TypeError):
                return {}
        return here

    def key(self, path: KeyPath) -> str:
        """A key path as people read it: job.phases[hand-eye].limit; numbers count from 1."""
        text = ""
        for position, step in enumerate(path):
            if isinstance(step, int):
                element = self.value(path[: position + 1])
                name = element.get("name", element.get("id")) if isinstance(element, dict) else None
                text += f"[{name}]" if isinstance(name, str) and name.isprintable() else f"[{step + 1}]"
            else:
                plain = step.isascii() and step.isprintable() and step
                text += ("." if text else "") + (step if plain else shown(step))
        return text


def nearest(word: str, known: Sequence[str]) -> str:
    """A remedy for a name that is not known: the nearest one, or all."""
    close = difflib.get_close_matches(word, known, n=1)
    if close:
        return f'did you mean "{close[0]}"?'
    return f"known: {', '.join(known)}" if known else "none is known here"


def _is_tables(value: object) -> bool:
    return isinstance(value, (list, tuple)) and bool(value) and isinstance(value[0], dict)
