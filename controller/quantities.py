"""Quantities with units: "12.5 mm" to SI floats and back.

Outside (cell files, console, reports) a quantity is text with its unit; inside it is a float in SI.
A bare number is refused: nobody can tell whether 12.5 is millimetres, inches or metres.
"""

import difflib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Annotated, Any, Final

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from estimation.errors import CellError

MAX_SHOWN_CHARACTERS: Final = 60

# Only ASCII digits: `\d` would also take digits of other scripts.
_QUANTITY = re.compile(
    r"(?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*(?P<unit>[^0-9.,+\s-].*)?"
)
_DECIMAL_COMMA = re.compile(r"[+-]?[0-9]+,[0-9]+(?!.*[,.])")
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)\b", re.IGNORECASE)
_DEGREE: Final = Decimal("0.01745329251994329576923690768489")


class QuantityError(CellError):
    """Text that is not a quantity of the wanted dimension."""


@dataclass(frozen=True, slots=True)
class Dimension:
    """A kind of quantity: its SI unit and the units that may be written."""

    name: str  # with its article, as used in messages
    si_unit: str
    units: dict[str, Decimal] = field(
        hash=False
    )  # unit as written: SI units in one of it; the first is usual

    @property
    def usual_unit(self) -> str:
        """The unit that messages, console and reports use."""
        return next(iter(self.units))


LENGTH = Dimension(
    "a length",
    "m",
    {
        "mm": Decimal("1e-3"),
        "um": Decimal("1e-6"),
        "µm": Decimal("1e-6"),
        "cm": Decimal("1e-2"),
        "m": Decimal(1),
        "in": Decimal("0.0254"),
    },
)
ANGLE = Dimension(
    "an angle", "rad", {"deg": _DEGREE, "°": _DEGREE, "rad": Decimal(1), "mrad": Decimal("1e-3")}
)
DURATION = Dimension(
    "a duration",
    "s",
    {
        "ms": Decimal("1e-3"),
        "s": Decimal(1),
        "us": Decimal("1e-6"),
        "µs": Decimal("1e-6"),
        "min": Decimal(60),
        "h": Decimal(3600),
        "day": Decimal(86400),
        "days": Decimal(86400),
    },
)
SPEED = Dimension(
    "a speed", "m/s", {"mm/s": Decimal("1e-3"), "m/s": Decimal(1), "mm/min": Decimal("1e-3") / Decimal(60)}
)
ANGULAR_SPEED = Dimension(
    "an angular speed", "rad/s", {"deg/s": _DEGREE, "°/s": _DEGREE, "rad/s": Decimal(1)}
)
ANGULAR_ACCELERATION = Dimension(
    "an angular acceleration",
    "rad/s^2",
    {
        "deg/s^2": _DEGREE,
        "deg/s²": _DEGREE,
        "°/s²": _DEGREE,
        "rad/s^2": Decimal(1),
        "rad/s²": Decimal(1),
    },
)
RATIO = Dimension("a ratio", "", {"%": Decimal("1e-2"), "ppm": Decimal("1e-6")})
MASS = Dimension("a mass", "kg", {"kg": Decimal(1), "g": Decimal("1e-3")})
FREQUENCY = Dimension("a frequency", "Hz", {"Hz": Decimal(1), "kHz": Decimal(1000), "MHz": Decimal("1e6")})

DIMENSIONS: Final = (
    LENGTH,
    ANGLE,
    DURATION,
    SPEED,
    ANGULAR_SPEED,
    ANGULAR_ACCELERATION,
    RATIO,
    MASS,
    FREQUENCY,
)


def parse(value: object, dimension: Dimension) -> float:
    """The SI value of a quantity such as "12.5 mm".

    Raises QuantityError: no unit, a unit of another dimension, an unknown unit, a decimal comma,
    not finite, or not text at all.
    """
    example = f'"12.5 {dimension.usual_unit}"'
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise QuantityError(f"{value}: not a finite number", f"write {dimension.name} such as {example}")
        raise QuantityError(f"{value}: unit missing", f'write "{value} {dimension.usual_unit}"')
    if not isinstance(value, str):
        raise QuantityError(f"{shown(value)}: not {dimension.name}", f"write text such as {example}")
    text = value.strip()
    if _NOT_FINITE.match(text):
        raise QuantityError(
            f"{shown(value)}: not a finite number", f"write {dimension.name} such as {example}"
        )
    if _DECIMAL_COMMA.match(text):
        raise QuantityError(f"{shown(value)}: decimal comma", f"write {shown(text.replace(',', '.'))}")
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise QuantityError(f"{shown(value)}: not {dimension.name}", f"write for example {example}")
    number, unit = match["number"], match["unit"] or ""
    if not unit:
        raise QuantityError(f"{shown(value)}: unit missing", f'write "{number} {dimension.usual_unit}"')
    if unit not in dimension.units:
        raise _wrong_unit(shown(value), number, unit, dimension)
    try:
        # Decimal, because 260.4 * 1e-3 is not the float nearest to 0.2604
        si_value = float(Decimal(number) * dimension.units[unit])
    except ArithmeticError:
        si_value = math.inf
    if not math.isfinite(si_value):
        raise QuantityError(
            f"{shown(value)}: not a finite number", f"write {dimension.name} such as {example}"
        )
    return si_value


def shown(value: object) -> str:
    """A value as a message shows it: as written in the file, on one line, cut if long."""
    if isinstance(value, str):
        text = '"' + "".join(c if c.isprintable() else ascii(c)[1:-1] for c in value) + '"'
    elif isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, (list, tuple)):
        text = "[" + ", ".join(shown(item) for item in value[:8]) + (", ..." if len(value) > 8 else "") + "]"
    elif isinstance(value, dict):
        text = "a table"
    else:
        text = str(value)
    return text if len(text) <= MAX_SHOWN_CHARACTERS else text[: MAX_SHOWN_CHARACTERS - 3] + "..."


def dimension_of(value: object) -> Dimension | None:
    """The dimension that the unit of a written quantity belongs to, or None."""
    match = _QUANTITY.fullmatch(value.strip()) if isinstance(value, str) else None
    return _dimension_of_unit(match["unit"] or "") if match else None


def _dimension_of_unit(unit: str) -> Dimension | None:
    return next((dimension for dimension in DIMENSIONS if unit in dimension.units), None)


def _wrong_unit(value: str, number: str, unit: str, dimension: Dimension) -> QuantityError:
    other = _dimension_of_unit(unit)
    if other is not None:
        return QuantityError(
            f"{value}: {other.name}, expected {dimension.name}", f'write "{number} {dimension.usual_unit}"'
        )
    nearest = difflib.get_close_matches(unit.lower(), dimension.units, n=1)
    suggestion = f'write "{number} {nearest[0] if nearest else dimension.usual_unit}"'
    return QuantityError(
        f"{value}: unknown unit {shown(unit)}",
        f"{suggestion}; units of {dimension.name}: {', '.join(dimension.units)}",
    )


def format_as(value: float, dimension: Dimension, unit: str, decimals: int | None = None) -> str:
    """An SI value in a given unit; `decimals` places, or as many as 9 significant digits need."""
    number = value / float(dimension.units[unit])
    if decimals is None:
        return f"{number:.9g} {unit}"
    return f"{number:.{decimals}f} {unit}"


def format_length(length_m: float, decimals: int | None = None) -> str:
    """Metres as "12.5 mm"."""
    return format_as(length_m, LENGTH, "mm", decimals)


def format_angle(angle_rad: float, decimals: int | None = None) -> str:
    """Radians as "3 deg"."""
    return format_as(angle_rad, ANGLE, "deg", decimals)


def format_duration(duration_s: float, decimals: int | None = None) -> str:
    """Seconds in the unit that suits the size: "20 ms", "45 s", "15 min", "30 days"."""
    size_s = abs(duration_s)
    limits = ((1.0, "ms"), (120.0, "s"), (7200.0, "min"), (172800.0, "h"))
    unit = "s" if size_s == 0 else next((unit for limit_s, unit in limits if size_s < limit_s), "days")
    return format_as(duration_s, DURATION, unit, decimals)


def format_speed(speed_m_s: float, decimals: int | None = None) -> str:
    """Metres per second as "8 mm/s"."""
    return format_as(speed_m_s, SPEED, "mm/s", decimals)


def format_angular_speed(speed_rad_s: float, decimals: int | None = None) -> str:
    """Radians per second as "60 deg/s"."""
    return format_as(speed_rad_s, ANGULAR_SPEED, "deg/s", decimals)


def format_angular_acceleration(acceleration_rad_s2: float, decimals: int | None = None) -> str:
    """Radians per second squared as "200 deg/s^2"."""
    return format_as(acceleration_rad_s2, ANGULAR_ACCELERATION, "deg/s^2", decimals)


def format_ratio(ratio: float, decimals: int | None = None) -> str:
    """A ratio as "0.02 %"."""
    return format_as(ratio, RATIO, "%", decimals)


def format_mass(mass_kg: float, decimals: int | None = None) -> str:
    """Kilograms as "6 kg"."""
    return format_as(mass_kg, MASS, "kg", decimals)


def format_frequency(frequency_hz: float, decimals: int | None = None) -> str:
    """Hertz as "50 Hz", from 1000 on as "2 kHz"."""
    return format_as(frequency_hz, FREQUENCY, "kHz" if abs(frequency_hz) >= 1000 else "Hz", decimals)


FORMATTERS: Final[dict[str, Callable[[float], str]]] = {
    LENGTH.name: format_length,
    ANGLE.name: format_angle,
    DURATION.name: format_duration,
    SPEED.name: format_speed,
    ANGULAR_SPEED.name: format_angular_speed,
    ANGULAR_ACCELERATION.name: format_angular_acceleration,
    RATIO.name: format_ratio,
    MASS.name: format_mass,
    FREQUENCY.name: format_frequency,
}


@dataclass(frozen=True, slots=True)
class _QuantityOf:
    """Tells pydantic how to validate a float that is written with its unit."""

    dimension: Dimension

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        def validate(value: object) -> float:
            try:
                return parse(value, self.dimension)
            except QuantityError as error:
                raise PydanticCustomError(
                    "quantity", "{problem}", {"problem": error.problem, "remedy": error.remedy}
                ) from None

        # the inner schema holds the bounds, in SI
        return core_schema.no_info_before_validator_function(validate, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {**handler(schema), "type": "string", "quantity": self.dimension.name}


Length = Annotated[float, _QuantityOf(LENGTH)]
Angle = Annotated[float, _QuantityOf(ANGLE)]
Duration = Annotated[float, _QuantityOf(DURATION)]
Speed = Annotated[float, _QuantityOf(SPEED)]
AngularSpeed = Annotated[float, _QuantityOf(ANGULAR_SPEED)]
AngularAcceleration = Annotated[float, _QuantityOf(ANGULAR_ACCELERATION)]
Ratio = Annotated[float, _QuantityOf(RATIO)]
Mass = Annotated[float, _QuantityOf(MASS)]
Frequency = Annotated[float, _QuantityOf(FREQUENCY)]
