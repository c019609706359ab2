"""Units of length in files of points: stated by the user, never guessed, compared with what the file says."""

import re
from typing import Final

from controller.offline.refusal import BadFile

METRES: Final = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
_NAMES: Final = {
    "mm": "mm", "millimetre": "mm", "millimeter": "mm", "millimetres": "mm", "millimeters": "mm",
    "m": "m", "metre": "m", "meter": "m", "metres": "m", "meters": "m",
    "in": "inch", "inch": "inch", "inches": "inch",
    "cm": "cm", "um": "um", "µm": "um", "ft": "ft", "feet": "ft",
}  # fmt: skip
_IN_BRACKETS: Final = re.compile(r"[\[(]\s*([A-Za-zµ]+)\s*[\])]")
_AFTER_NAME: Final = re.compile(r"\b[xyz]_([A-Za-zµ]+)\b", re.IGNORECASE)
_DECLARED: Final = re.compile(r"\bunits?\s*[:= ]\s*([A-Za-zµ]+)", re.IGNORECASE)
_SMALLEST_EXTENT_M: Final = 1e-3
_LARGEST_EXTENT_M: Final = 50.0
_WRONG_BY: Final = {25.4: "mm and inch", 1000.0: "m and mm", 10.0: "cm and mm"}


def unit_in(text: str) -> str | None:
    """The unit that a header or comment names ("x [mm]", "x_mm", "unit: inch"), or None."""
    for pattern in (_IN_BRACKETS, _AFTER_NAME, _DECLARED):
        for word in pattern.findall(text):
            if (name := _NAMES.get(word.lower())) is not None:
                return name
    return None


def refuse_other_unit(text: str, unit: str, name: str, line: int) -> None:
    """Raises BadFile where a header or comment names another unit than the user."""
    if (named := unit_in(text)) is not None and named != unit:
        raise BadFile(
            f"{name}, line {line}: the file says {named!r} and --unit says {unit!r}",
            "State the unit of the numbers in the file; only mm, m and inch are read",
        )


def refuse_extent(extent_m: float, unit: str, name: str, expected_m: float | None) -> None:
    """Raises BadFile where the points span what no part does, or another size than the user expects.

    extent_m : largest side of the box around the points.
    expected_m : what the user expects it to be, to a factor of two, or None.
    """
    if extent_m == 0.0:
        raise BadFile(f"{name}: all points are the same", "Measure at different places")
    inside = "" if unit == "mm" else f" ({extent_m * 1e3:.4g} mm)"
    extent = f"{name}: the points span {extent_m / METRES[unit]:.4g} {unit}{inside}"
    if expected_m is not None and not 0.5 < extent_m / expected_m < 2.0:
        ratio = max(extent_m / expected_m, expected_m / max(extent_m, 1e-12))
        near = [words for factor, words in _WRONG_BY.items() if 0.6 < ratio / factor < 1.6]
        hint = f"; {near[0]} differ by about that" if near else ""
        raise BadFile(
            f"{extent}, but --size says {expected_m * 1e3:.4g} mm, {ratio:.3g} times off{hint}",
            "Mend --unit or --size",
        )
    if expected_m is not None:
        return
    if not _SMALLEST_EXTENT_M <= extent_m <= _LARGEST_EXTENT_M:
        raise BadFile(
            f"{extent}, outside 1 mm to 50 m; m and mm differ by a factor of 1000",
            "Check --unit against the file; where it is right, state the extent with --size",
        )


def scatter_hint(ratio: float) -> str | None:
    """What units may have to do with points that scatter `ratio` times as far as stated, or None."""
    for factor, words in _WRONG_BY.items():
        if 0.8 < max(ratio, 1.0 / ratio) / factor < 1.25:
            return f"{words} differ by a factor of {factor:g}: check --unit and the unit of --sigma"
    return None
