"""Quantities with units: what is read, what is refused and why, and the way back."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller import quantities as q


@pytest.mark.parametrize(
    ("text", "dimension", "si_value"),
    [
        ("12.5 mm", q.LENGTH, 0.0125),
        ("260.4 mm", q.LENGTH, 0.2604),
        ("12.5mm", q.LENGTH, 0.0125),
        ("  -5 um ", q.LENGTH, -5e-6),
        ("5 µm", q.LENGTH, 5e-6),
        ("2 in", q.LENGTH, 0.0508),
        (".5 m", q.LENGTH, 0.5),
        ("1e-3 m", q.LENGTH, 0.001),
        ("180 deg", q.ANGLE, math.pi),
        ("-90°", q.ANGLE, -math.pi / 2),
        ("3 mrad", q.ANGLE, 0.003),
        ("20 ms", q.DURATION, 0.02),
        ("30 days", q.DURATION, 2592000.0),
        ("8 mm/s", q.SPEED, 0.008),
        ("60 mm/min", q.SPEED, 0.001),
        ("60 deg/s", q.ANGULAR_SPEED, math.pi / 3),
        ("180 deg/s^2", q.ANGULAR_ACCELERATION, math.pi),
        ("0.02 %", q.RATIO, 0.0002),
        ("50 ppm", q.RATIO, 5e-5),
        ("2 kHz", q.FREQUENCY, 2000.0),
    ],
)
def test_quantities_become_si(text: str, dimension: q.Dimension, si_value: float) -> None:
    assert q.parse(text, dimension) == pytest.approx(si_value, rel=1e-15)


def test_the_nearest_float_is_read_and_not_one_beside_it() -> None:
    assert all(q.parse(f"{n / 10} mm", q.LENGTH) == float(f"{n / 10}e-3") for n in range(10_000))


@pytest.mark.parametrize(
    ("value", "dimension", "problem", "remedy"),
    [
        (12.5, q.LENGTH, "12.5: unit missing", 'write "12.5 mm"'),
        (3, q.ANGLE, "3: unit missing", 'write "3 deg"'),
        ("12.5", q.LENGTH, '"12.5": unit missing', 'write "12.5 mm"'),
        ("3 deg", q.LENGTH, '"3 deg": an angle, expected a length', 'write "3 mm"'),
        ("8 mm", q.SPEED, '"8 mm": a length, expected a speed', 'write "8 mm/s"'),
        ("12,5 mm", q.LENGTH, '"12,5 mm": decimal comma', 'write "12.5 mm"'),
        ("nan mm", q.LENGTH, '"nan mm": not a finite number', "write a length such as"),
        ("-inf mm", q.LENGTH, '"-inf mm": not a finite number', "write a length such as"),
        (math.nan, q.LENGTH, "nan: not a finite number", "write a length such as"),
        ("1e309 m", q.LENGTH, '"1e309 m": not a finite number', "write a length such as"),
        ("1e99999999999999999999 m", q.LENGTH, "not a finite number", "write a length such as"),
        ("5 mn", q.LENGTH, '"5 mn": unknown unit "mn"', 'write "5 m'),
        ("5 MS", q.DURATION, 'unknown unit "MS"', 'write "5 ms"; units of a duration: ms, s'),
        ("five mm", q.LENGTH, '"five mm": not a length', 'write for example "12.5 mm"'),
        ("", q.LENGTH, '"": not a length', 'write for example "12.5 mm"'),
        ("1.2.3 mm", q.LENGTH, "not a length", "write for example"),
        ("1,234.5 mm", q.LENGTH, "not a length", "write for example"),
        ("٣ mm", q.LENGTH, "not a length", "write for example"),  # digits of another script
        (True, q.LENGTH, "true: not a length", "write text such as"),
        (None, q.LENGTH, "None: not a length", "write text such as"),
        ([1], q.LENGTH, "[1]: not a length", "write text such as"),
    ],
)
def test_what_is_no_quantity_is_refused(
    value: object, dimension: q.Dimension, problem: str, remedy: str
) -> None:
    with pytest.raises(q.QuantityError) as refused:
        q.parse(value, dimension)
    assert problem in refused.value.problem
    assert remedy in refused.value.remedy


@given(
    st.one_of(st.text(), st.floats(), st.integers(), st.from_regex(r"[0-9.,eE+-]{1,12} ?[a-zµ°%/^²2]{0,6}"))
)
def test_anything_is_read_or_refused(value: object) -> None:
    for dimension in q.DIMENSIONS:
        try:
            assert math.isfinite(q.parse(value, dimension))
        except q.QuantityError as refused:
            assert "\n" not in str(refused)
            assert len(refused.problem) < 250


FORMATS: list[tuple[Callable[[float], str], q.Dimension]] = [
    (q.format_length, q.LENGTH),
    (q.format_angle, q.ANGLE),
    (q.format_duration, q.DURATION),
    (q.format_speed, q.SPEED),
    (q.format_angular_speed, q.ANGULAR_SPEED),
    (q.format_angular_acceleration, q.ANGULAR_ACCELERATION),
    (q.format_ratio, q.RATIO),
    (q.format_mass, q.MASS),
    (q.format_frequency, q.FREQUENCY),
]


@given(st.floats(-1e9, 1e9, allow_subnormal=False), st.sampled_from(FORMATS))
def test_what_is_formatted_reads_back(
    value: float, written: tuple[Callable[[float], str], q.Dimension]
) -> None:
    formatted, dimension = written
    assert q.parse(formatted(value), dimension) == pytest.approx(value, rel=1e-8)


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (q.format_length(0.0125), "12.5 mm"),
        (q.format_length(0.1 * 3), "300 mm"),
        (q.format_length(0.00018999, 3), "0.190 mm"),
        (q.format_angle(math.radians(3)), "3 deg"),
        (q.format_angle(math.radians(0.0015), 4), "0.0015 deg"),
        (q.format_duration(0.0), "0 s"),
        (q.format_duration(0.02), "20 ms"),
        (q.format_duration(45.0), "45 s"),
        (q.format_duration(900.0), "15 min"),
        (q.format_duration(86400.0), "24 h"),
        (q.format_duration(2592000.0), "30 days"),
        (q.format_speed(0.008), "8 mm/s"),
        (q.format_angular_speed(math.radians(60)), "60 deg/s"),
        (q.format_angular_acceleration(math.radians(200)), "200 deg/s^2"),
        (q.format_ratio(0.0002), "0.02 %"),
        (q.format_frequency(2000.0), "2 kHz"),
        (q.format_frequency(50.0), "50 Hz"),
    ],
)
def test_formats_are_what_people_write(shown: str, expected: str) -> None:
    assert shown == expected
