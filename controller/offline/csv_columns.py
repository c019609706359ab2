"""Joints and ranges from a CSV: one row a pose, every column with its unit in the header."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from controller.cellfile.lines import KeyPath
from controller.offline.number_table import BadBlock, read_numbers
from controller.offline.refusal import BadFile

_HEADER: Final = re.compile(
    r"\s*(?P<name>[A-Za-z]+)\s*(?P<number>\d*)\s*[\[(]\s*(?P<unit>[A-Za-z]+)\s*[\])]\s*"
)
_EXAMPLE: Final = '"j1 [deg]", "j2 [deg]", ..., "range [mm]"'
_JOINT_UNITS: Final = ("deg", "rad")
_RANGE_UNITS: Final = ("mm", "m", "inch")


def read_joints_and_ranges(path: Path) -> dict[KeyPath, Any]:
    """Joints, ranges and units, by their places in a data set.

    The header names the joints j1 to jn and the range, each with its unit, in any order; commas or semicolons
    separate; `#` begins a comment. Raises BadFile with the line: nothing is skipped or guessed.
    """
    if not path.is_file():
        raise BadFile(f"{path}: there is no such file", "Name a CSV of joints and ranges")
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise BadFile(
            f"{path}: cannot be read as text ({error})", "Name a CSV of joints and ranges"
        ) from error
    filled = (place for place, line in enumerate(lines) if line.partition("#")[0].strip())
    first = next(filled, None)
    if first is None or next(filled, None) is None:
        raise BadFile(
            f"{path.name}: no measurements", f"Write a header {_EXAMPLE}, then one row for each pose"
        )
    header = lines[first].partition("#")[0].strip()
    separator = ";" if ";" in header else ","
    names, units = _header(_split(header, separator), f"{path.name}:{first + 1}")
    table = read_numbers(lines, first + 1, separator, len(names), quote='"')
    if isinstance(table, BadBlock):
        _refuse_first_bad_row(lines, table, separator, names, path.name)
    joints = [names.index(f"j{i + 1}") for i in range(len(names) - 1)]
    return {
        ("units",): units,
        ("motion", "angles"): table[:, joints].tolist(),
        ("readings",): table[:, names.index("range")].tolist(),
    }


def _split(line: str, separator: str) -> list[str]:
    return next(csv.reader(io.StringIO(line), delimiter=separator, skipinitialspace=True))


def _header(fields: list[str], place: str) -> tuple[list[str], dict[str, str]]:
    """Names of the columns, j1 to jn and range, and the units of all."""
    names, used = [], {"length": set[str](), "angle": set[str]()}
    for field in fields:
        match = _HEADER.fullmatch(field)
        if match is None:
            raise BadFile(f"{place}: the column {field!r} does not say name and unit", f"Write {_EXAMPLE}")
        name, unit = match["name"].lower() + match["number"], match["unit"]
        allowed = _RANGE_UNITS if name == "range" else _JOINT_UNITS
        if unit not in allowed:
            raise BadFile(f"{place}: the column {field!r} is in {unit!r}", f"Use one of {', '.join(allowed)}")
        names.append(name)
        used["length" if name == "range" else "angle"].add(unit)
    wanted = ["range", *(f"j{i + 1}" for i in range(len(names) - 1))]
    if sorted(names) != sorted(wanted) or len(names) < 2:
        raise BadFile(
            f"{place}: the columns are {', '.join(names)}", f"Name them {', '.join(wanted)}, once each"
        )
    if len(used["angle"]) > 1:
        raise BadFile(f"{place}: joints in deg and rad", "Use one unit for all joints")
    return names, {kind: next(iter(words)) for kind, words in used.items()}


def _refuse_first_bad_row(
    lines: Sequence[str], block: BadBlock, separator: str, names: list[str], file: str
) -> NoReturn:
    for number, text in enumerate(lines[block.start : block.stop], block.start + 1):
        if line := text.partition("#")[0].strip():
            _refuse_bad_numbers(_split(line, separator), names, f"{file}:{number}")
    raise BadFile(
        f"{file}:{block.start + 1} to {block.stop}: the numbers cannot be read",
        "Write plain numbers with decimal points",
    )


def _refuse_bad_numbers(fields: list[str], names: list[str], place: str) -> None:
    if len(fields) != len(names):
        hint = "; decimal commas need semicolons between columns" if len(fields) > len(names) else ""
        raise BadFile(f"{place}: {len(fields)} columns, the header has {len(names)}{hint}", "Mend the row")
    for field, name in zip(fields, names, strict=True):
        try:
            number = float(field)
        except ValueError:
            remedy = "Write decimal points" if "," in field else "Mend the row, or take the pose out"
            raise BadFile(f"{place}: {field!r} in column {name} is not a number", remedy) from None
        if not np.isfinite(number):
            raise BadFile(f"{place}: {field!r} in column {name} is not finite", "Take the pose out")
