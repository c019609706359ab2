"""Points from CSV, TXT and XYZ: three columns of numbers, one point a line.

Where the fast reading stumbles, a slow second one of that block of lines finds the first bad line and says
what is wrong. Nothing is skipped but blank lines, comments (#) and one header.
"""

import codecs
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

import numpy as np

from controller.offline.number_table import BadBlock, read_numbers
from controller.offline.refusal import BadFile
from controller.offline.units import refuse_other_unit
from estimation.transform import FloatArray

_SEPARATORS: Final = {",": "comma", ";": "semicolon", "\t": "tab", None: "space"}
_DECIMAL_COMMA: Final = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class _Layout:
    """What the first lines say: where numbers begin, their separator, and the columns of x, y and z."""

    first_line: int  # counted from 1
    separator: str | None  # None: any white space
    columns: tuple[int, int, int]
    width: int


def read_text_points(path: Path, unit: str) -> FloatArray:
    """Points (n, 3) in the file's own unit.

    Raises BadFile: empty, header only, words, missing or surplus columns, numbers that are not finite, mixed
    separators, decimal commas, or another unit in the header than `unit`; with the line.
    """
    text = _text(path)
    lines = text.split("\n")
    layout = _layout(lines, path.name, unit)
    table = read_numbers(lines, layout.first_line - 1, layout.separator, layout.width)
    if isinstance(table, BadBlock):
        _refuse_first_bad_line(lines, table, layout, path.name)
    return np.ascontiguousarray(table[:, list(layout.columns)])


def _text(path: Path) -> str:
    """UTF-8, UTF-16 with its mark, or Latin-1, in which the numbers are the same. Raises BadFile."""
    data = path.read_bytes()
    encoding = "utf-16" if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if "\0" in text:
        raise BadFile(f"{path.name}: not a text file", "Export the points as CSV, TXT or XYZ")
    return text.replace("\r\n", "\n").replace("\r", "\n")  # of any system


def _layout(lines: Sequence[str], name: str, unit: str) -> _Layout:
    """Reads down to the first point. Raises BadFile where there is none."""
    header: str | None = None
    header_line = 0
    for number, line in enumerate(lines, start=1):
        content, _, comment = line.partition("#")
        if comment:
            refuse_other_unit(comment, unit, name, number)
        if not content.strip():
            continue
        separator = _separator(content)
        fields = _fields(content, separator)
        if any(_is_number(field) for field in fields):
            _refuse_decimal_commas(content, name, number)
            columns = (0, 1, 2) if header is None else _columns(header, name, header_line, len(fields))
            layout = _Layout(number, separator, columns, len(fields))
            _refuse_fields(fields, layout, name, number)
            return layout
        if header is not None:
            raise BadFile(
                f"{name}, line {number}: {content.strip()!r} is not a point",
                "Keep one header line at most, then x, y, z",
            )
        header, header_line = content, number
        refuse_other_unit(content, unit, name, number)
    if header is not None:
        raise BadFile(
            f"{name}, line {header_line}: only a header, no points", "Export the points below the header"
        )
    raise BadFile(f"{name}: the file is empty", "Export at least the points of one surface")


def _separator(content: str) -> str | None:
    return next((mark for mark in (";", "\t", ",") if mark in content.strip()), None)


def _fields(content: str, separator: str | None) -> list[str]:
    return [field.strip() for field in content.strip().split(separator)]


def _columns(header: str, name: str, line: int, width: int) -> tuple[int, int, int]:
    """Places of x, y and z in the header; the first three columns where it names none of them."""
    words = [
        re.split(r"[^a-z0-9]", field.strip().strip('"').lower())[0]
        for field in _fields(header, _separator(header))
    ]
    if not {"x", "y", "z"} & set(words):
        return 0, 1, 2
    if any(words.count(axis) != 1 for axis in "xyz") or len(words) != width:
        raise BadFile(
            f"{name}, line {line}: the header {header.strip()!r} does not name x, y and z once each",
            "Name the three columns x, y and z, or remove the header",
        )
    return words.index("x"), words.index("y"), words.index("z")


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return _DECIMAL_COMMA.fullmatch(field) is not None
    return field.lower().lstrip("+-") not in ("nan", "inf", "infinity")


def _refuse_decimal_commas(content: str, name: str, number: int) -> None:
    """With ; or white space between the fields a comma inside one can only be a decimal comma."""
    by_comma = [field.strip() for field in content.split(",")]
    by_space = content.replace(";", " ").split()
    decimal = all(_DECIMAL_COMMA.fullmatch(field) for field in by_space) and len(by_space) > 1
    six = len(by_comma) == 6 and ";" not in content and all(re.fullmatch(r"[-+]?\d+", f) for f in by_comma)
    if decimal or six:
        raise BadFile(
            f"{name}, line {number}: {content.strip()!r} seems to have decimal commas",
            "Export it with decimal points",
        )


def _refuse_fields(fields: list[str], layout: _Layout, name: str, number: int) -> None:
    """Raises BadFile for the first fault of a line."""
    place = f"{name}, line {number}"
    if len(fields) < 3:
        raise BadFile(f"{place}: {len(fields)} columns, a point has 3", "Give x, y and z")
    if len(fields) != layout.width:
        _refuse_decimal_commas(",".join(fields), name, number)
        raise BadFile(
            f"{place}: {len(fields)} columns by {_SEPARATORS[layout.separator]}, "
            f"the lines before have {layout.width}",
            "Use one separator and one number of columns throughout",
        )
    for field in fields:
        if _DECIMAL_COMMA.fullmatch(field):
            raise BadFile(f"{place}: {field!r} has a decimal comma", "Export it with decimal points")
        try:
            value = float(field)
        except ValueError:
            raise BadFile(f"{place}: {field!r} is not a number", "Mend or remove the line") from None
        if not np.isfinite(value):
            raise BadFile(f"{place}: {field!r} is not a finite number", "Mend or remove the line")


def _refuse_first_bad_line(lines: Sequence[str], block: BadBlock, layout: _Layout, name: str) -> NoReturn:
    for number, line in enumerate(lines[block.start : block.stop], start=block.start + 1):
        content = line.partition("#")[0]
        if not content.strip():
            continue
        other = _separator(content)
        if other != layout.separator and other is not None:
            _refuse_decimal_commas(content, name, number)
            raise BadFile(
                f"{name}, line {number}: separated by {_SEPARATORS[other]}, "
                f"the lines before by {_SEPARATORS[layout.separator]}",
                "Use one separator throughout",
            )
        _refuse_fields(_fields(content, layout.separator), layout, name, number)
    raise BadFile(
        f"{name}, line {block.start + 1} to {block.stop}: the numbers cannot be read as points",
        "Export x, y and z as plain numbers",
    )
