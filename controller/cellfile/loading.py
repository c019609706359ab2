"""Reading a cell file: all mistakes at once, each with its line."""

import hashlib
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from controller.cellfile.cell import Cell
from controller.cellfile.consistency import find_inconsistencies
from controller.cellfile.geometry import check_geometry
from controller.cellfile.lines import LineIndex, index_lines, without
from controller.cellfile.mistakes import CellFileMistakes, Mistake, Source
from controller.cellfile.translate import mistakes_of, schema

FILE_NAME: Final = "cell.toml"
MAX_FILE_BYTES: Final = 1_000_000

Feasibility = Callable[[Cell], list[Mistake]]
"""Judges a cell that is otherwise in order: can its limits be reached at all?"""

_AT_LINE = re.compile(r"\s*\(at (?:line (?P<line>\d+), column \d+|end of document)\)$")


def load_cell(path: str | Path, feasibility: Feasibility | None = None) -> Cell:
    """Read and check a cell file, or the cell.toml in a folder.

    Quick: the CAD file is only opened. With `feasibility` all is checked as by `check_cell`.
    Raises CellFileMistakes (a CellFileError) with all mistakes.
    """
    cell, mistakes = _read(Path(path))
    if cell is not None and not mistakes and feasibility is not None:
        mistakes = _judge(cell, feasibility)
    if cell is None or mistakes:
        raise CellFileMistakes(mistakes)
    return cell


def check_cell(path: str | Path, feasibility: Feasibility | None = None) -> list[Mistake]:
    """All mistakes of a cell file, in the order of the file; [] if it is in order.

    Each step needs the one before it to be in order: the file, its part against the CAD file, feasibility.
    """
    cell, mistakes = _read(Path(path))
    return _judge(cell, feasibility) if cell is not None and not mistakes else mistakes


def _judge(cell: Cell, feasibility: Feasibility | None) -> list[Mistake]:
    mistakes = check_geometry(cell)
    if not mistakes and feasibility is not None:
        mistakes = feasibility(cell)
    return sorted(mistakes, key=lambda mistake: mistake.line)


def _read(path: Path) -> tuple[Cell | None, list[Mistake]]:
    if path.is_dir():
        path = path / FILE_NAME
    try:
        text = _text_of(path)
    except _Unreadable as error:
        return None, [Mistake(str(path), error.line, "", "", error.problem, error.remedy)]
    source, mistakes = _parse(path, text)
    if source is None:
        return None, mistakes
    cell, sections, findings = _validate(source)
    mistakes += findings
    mistakes += find_inconsistencies(sections, source, path.parent)
    if cell is not None and not mistakes:
        cell._path = path.absolute()
        cell._source = source
        cell._cad_digest = hashlib.sha256(cell.cad_path.read_bytes()).hexdigest()
    return cell, sorted(mistakes, key=lambda mistake: mistake.line)


class _Unreadable(Exception):
    def __init__(self, problem: str, remedy: str, line: int = 1) -> None:
        super().__init__(problem)
        self.problem, self.remedy, self.line = problem, remedy, line


def _text_of(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise _Unreadable(
                f"{path.stat().st_size} bytes", f"a cell file has at most {MAX_FILE_BYTES} bytes; is it one?"
            )
        content = path.read_bytes()
    except OSError as error:
        raise _Unreadable(
            f"cannot be read ({error.strerror})", "name a cell file, or a folder with a cell.toml"
        ) from error
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")  # some editors begin with a mark
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise _Unreadable(
            f"byte 0x{content[error.start]:02X} is not UTF-8", "save the file as UTF-8", line
        ) from error


def _parse(path: Path, text: str) -> tuple[Source | None, list[Mistake]]:
    index = index_lines(text)
    empty = Source(str(path), text, index, {})
    mistakes = [
        Mistake(
            str(path),
            duplicate.line,
            empty.key(duplicate.path),
            "",
            f"stands twice, first in line {duplicate.first_line}",
            "remove one of them",
        )
        for duplicate in index.duplicates
    ]
    try:
        data = tomllib.loads(without(text, index.duplicates))
    except tomllib.TOMLDecodeError as error:
        return None, [*mistakes, _syntax_mistake(path, text, index, str(error))]
    except (RecursionError, ValueError) as error:  # nested too deep; a number of thousands of digits
        return None, [
            *mistakes,
            Mistake(str(path), 1, "", "", f"not a cell file ({error})", "correct the file"),
        ]
    return Source(str(path), text, index, data), mistakes


def _syntax_mistake(path: Path, text: str, index: LineIndex, message: str) -> Mistake:
    match = _AT_LINE.search(message)
    lines = text.split("\n")
    line = int(match["line"]) if match and match["line"] else len(lines)
    problem = _AT_LINE.sub("", message)
    written = lines[line - 1].strip() if line <= len(lines) else ""
    bare = re.match(r"""[^=]*=\s*(?P<value>[+-]?[0-9][0-9.,]*\s*[A-Za-z%°µ][^#"']*)""", written)
    if bare:
        remedy = f'write quantities in quotes: "{bare["value"].strip()}"'
    else:
        remedy = "correct this line or the one before it"
    return Mistake(str(path), line, "", "", f"not TOML: {problem[:1].lower()}{problem[1:]}", remedy)


def _frozen(value: Any) -> Any:
    """Arrays as tuples, which strict models ask for."""
    if isinstance(value, dict):
        return {key: _frozen(child) for key, child in value.items()}
    return tuple(_frozen(child) for child in value) if isinstance(value, list) else value


def _validate(source: Source) -> tuple[Cell | None, dict[str, Any], list[Mistake]]:
    """The cell, or the tables that are in order by themselves, and the mistakes of the others."""
    content = _frozen(source.data)
    try:
        cell = Cell.model_validate(content)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        faulty = {details["loc"][0] for details in errors if details["loc"]}
        sections = {
            name: TypeAdapter(field.annotation).validate_python(content[field.alias or name])
            for name, field in Cell.model_fields.items()
            if (field.alias or name) not in faulty and field.annotation is not None
        }
        return None, sections, mistakes_of(errors, replace(source, schema=schema()))
    return cell, {name: getattr(cell, name) for name in Cell.model_fields}, []
