"""Numbers as a report prints them: u to two digits, the value to the same place, mm and deg at the edge."""

import math
from typing import Final

MINUS: Final = "\u2212"
NOTHING: Final = "–"

_SHOWN: Final = {"m": ("mm", 1e3), "rad": ("deg", math.degrees(1.0)), "1": ("%", 1e2)}


def shown_unit(unit: str) -> tuple[str, float]:
    """The unit that people read for an SI unit, and the factor to it; other units stay as they are."""
    return _SHOWN.get(unit, (unit, 1.0))


def decimals_of(u: float, digits: int = 2) -> int:
    """Decimal places that show `u` > 0 with so many significant digits; negative for tens and hundreds."""
    return digits - 1 - int(f"{u:.{digits - 1}e}".split("e")[1])  # after rounding: 0.0996 is 0.10


def fixed(value: float, decimals: int) -> str:
    """A number with so many decimal places, a real minus sign, and no negative zero."""
    text = f"{value:.{decimals}f}" if decimals >= 0 else f"{round(value, decimals):.0f}"
    if text.startswith("-"):
        text = MINUS + text[1:] if any(digit in "123456789" for digit in text) else text[1:]
    return text


def with_uncertainty(value: float, u: float) -> tuple[str, str, int]:
    """Value and u as text, and the decimal places of both (GUM 7.2.6)."""
    if not u > 0.0:
        return plain(value), NOTHING, 6
    decimals = decimals_of(u)
    return fixed(value, decimals), fixed(u, decimals), decimals


def plain(value: float, fewest: int = 0) -> str:
    """An exact number such as a limit: as many of six decimals as it needs, at least `fewest`."""
    text = f"{value:.6f}".rstrip("0")
    return fixed(value, max(fewest, len(text.partition(".")[2])))


def against_limit(value: float, limit: float) -> tuple[str, str]:
    """Value and limit with three digits of the larger, and more where they would look the same."""
    if value.is_integer() and limit.is_integer():
        return fixed(value, 0), fixed(limit, 0)
    largest = max(abs(value), abs(limit))
    decimals = min(max(decimals_of(largest, 3), 0), 6)
    while value != limit and decimals < 9 and fixed(value, decimals) == fixed(limit, decimals):
        decimals += 1
    return fixed(value, decimals), fixed(limit, decimals)


def percent(probability: float) -> str:
    """A probability; near 0 and 1 as a bound, since 100.00 % would claim certainty."""
    if probability > 0.9999:
        return "> 99.99 %"
    if probability < 0.0001:
        return "< 0.01 %"
    return f"{100.0 * probability:.2f} %"


def share(fraction: float) -> str:
    """A part of a whole, in whole percent."""
    return f"{100.0 * fraction:.0f} %"
