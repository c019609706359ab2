"""Tables of numbers in text, fast: numpy's parser reads them block by block; bad ones are left to others."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.transform import FloatArray

_BLOCK: Final = 20_000  # lines: few enough to look for a bad one slowly, many enough for the parser's speed


@dataclass(frozen=True, slots=True)
class BadBlock:
    """Lines of which one at least is not `width` finite numbers: places from 0, `stop` exclusive."""

    start: int
    stop: int


def read_numbers(
    lines: Sequence[str], first: int, separator: str | None, width: int, quote: str | None = None
) -> FloatArray | BadBlock:
    """Numbers (n, width) of the lines from place `first` on; blank lines and comments (#) are none.

    separator : between numbers; None is any white space.
    """
    tables = [np.empty((0, width))]
    for start in range(first, len(lines), _BLOCK):
        block = lines[start : start + _BLOCK]
        table = _parsed(block, separator, quote)
        if table is None:  # the parser takes a line of spaces for a number that is missing
            table = _parsed([line for line in block if line.partition("#")[0].strip()], separator, quote)
        if table is None or (table.size and (table.shape[1] != width or not np.isfinite(table).all())):
            return BadBlock(start, start + len(block))
        if table.size:
            tables.append(table)
    return np.concatenate(tables)


def _parsed(block: Sequence[str], separator: str | None, quote: str | None) -> FloatArray | None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a block may hold nothing but blank lines
            return np.asarray(np.loadtxt(block, delimiter=separator, ndmin=2, quotechar=quote))
    except ValueError:
        return None
