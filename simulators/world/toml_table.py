"""A strict reader of TOML tables: quantities with units, and no key that means nothing."""

import math
import re
from typing import Any, Final

import numpy as np

from estimation.errors import CellFileError
from estimation.transform import FloatArray

UNITS: Final[dict[str, tuple[str, float]]] = {
    "m": ("length", 1.0),
    "mm": ("length", 1e-3),
    "um": ("length", 1e-6),
    "rad": ("angle", 1.0),
    "deg": ("angle", math.pi / 180),
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
    "deg/s": ("angular speed", math.pi / 180),
    "deg/s^2": ("angular acceleration", math.pi / 180),
    "%": ("ratio", 1e-2),
    "ppm": ("ratio", 1e-6),
}
_QUANTITY: Final = re.compile(r"([+-]?\d+(?:\.\d+)?) ?(\S+)")


def parse_quantity(text: object, kind: str, where: str = "quantity") -> float:
    """SI value of e.g. "12.5 mm"; raises CellFileError for another kind of unit, or none."""
    units = " or ".join(unit for unit, (its_kind, _) in UNITS.items() if its_kind == kind)
    match = _QUANTITY.fullmatch(text) if isinstance(text, str) else None
    if match is None or UNITS.get(match[2], ("", 0.0))[0] != kind:
        raise CellFileError(f"{where} is {text!r}, not a {kind}", f'Write e.g. "1.5 {units}"')
    return float(match[1]) * UNITS[match[2]][1]


class StrictTable:
    """A TOML table of which every key must be asked for."""

    def __init__(self, content: object, where: str) -> None:
        if not isinstance(content, dict):
            raise CellFileError(f"{where} is {content!r}, not a table", f"Write [{where}]")
        self._content: dict[str, Any] = dict(content)
        self._where = where

    def take(self, key: str, default: object = None) -> Any:
        if key not in self._content and default is None:
            raise CellFileError(f"{self._where} has no {key}", f"Add {key} to [{self._where}]")
        return self._content.pop(key, default)

    def has(self, key: str) -> bool:
        return key in self._content

    def table(self, key: str) -> "StrictTable":
        return StrictTable(self.take(key), f"{self._where}.{key}")

    def tables(self, key: str) -> "list[StrictTable]":
        return [StrictTable(item, f"{self._where}.{key}[{i}]") for i, item in enumerate(self.take(key))]

    def number(self, key: str, kind: str, default: float | None = None) -> float:
        if default is not None and key not in self._content:
            return default
        return parse_quantity(self.take(key), kind, f"{self._where}.{key}")

    def length(self, key: str, default: float | None = None) -> float:
        return self.number(key, "length", default)

    def vector(self, key: str, kind: str, size: int) -> FloatArray:
        items = self.take(key)
        if not isinstance(items, list) or len(items) != size:
            raise CellFileError(f"{self._where}.{key} is {items!r}", f"Give {size} values")
        return np.array([parse_quantity(item, kind, f"{self._where}.{key}") for item in items])

    def integer(self, key: str) -> int:
        value = self.take(key)
        if not isinstance(value, int) or isinstance(value, bool):
            raise CellFileError(f"{self._where}.{key} is {value!r}", "Give a whole number")
        return value

    def text(self, key: str) -> str:
        value = self.take(key)
        if not isinstance(value, str):
            raise CellFileError(f"{self._where}.{key} is {value!r}", "Give a text in quotes")
        return value

    def end(self) -> None:
        if self._content:
            names = ", ".join(sorted(self._content))
            raise CellFileError(f"{self._where} has {names}, unknown here", "Remove or correct it")
