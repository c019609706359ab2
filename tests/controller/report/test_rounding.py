"""Rounding for display: two digits of u, and never a picture prettier than the number."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.report.pictures import ellipse_outline
from controller.report.rounding import against_limit, fixed, percent, plain, with_uncertainty


@pytest.mark.parametrize(
    ("value", "u", "shown", "shown_u"),
    [
        (12.34567, 0.0123, "12.346", "0.012"),
        (12.34567, 0.0996, "12.35", "0.10"),
        (-0.0004, 0.012, "0.000", "0.012"),
        (1234.5, 12.3, "1234", "12"),
        (12345.0, 230.0, "12340", "230"),
        (-3.14159, 1.0, "\u22123.1", "1.0"),
    ],
)
def test_value_has_the_place_of_its_uncertainty(value: float, u: float, shown: str, shown_u: str) -> None:
    assert with_uncertainty(value, u)[:2] == (shown, shown_u)


@given(value=st.floats(-1e4, 1e4), u=st.floats(1e-6, 1e2))
def test_rounding_never_moves_a_value_by_a_tenth_of_u(value: float, u: float) -> None:
    shown, shown_u, _ = with_uncertainty(value, u)
    assert abs(float(shown.replace("\u2212", "-")) - value) <= 0.0501 * u + 1e-9
    assert float(shown_u) == pytest.approx(u, rel=0.051)


def test_value_beyond_its_limit_never_looks_like_it() -> None:
    assert against_limit(0.4002, 0.4) == ("0.4002", "0.4000")
    assert against_limit(0.262, 0.4) == ("0.262", "0.400")
    assert against_limit(0.0, 0.0) == ("0", "0")


@given(value=st.floats(0, 1e3), limit=st.floats(1e-3, 1e3))
def test_what_differs_looks_different(value: float, limit: float) -> None:
    shown, shown_limit = against_limit(value, limit)
    assert shown != shown_limit or abs(value - limit) < 1e-8


def test_certainty_is_never_claimed() -> None:
    assert percent(0.999999) == "> 99.99 %"
    assert percent(1e-9) == "< 0.01 %"
    assert percent(0.953) == "95.30 %"


def test_exact_numbers() -> None:
    assert plain(30.0, fewest=2) == "30.00"
    assert plain(0.0125) == "0.0125"
    assert fixed(-0.0001, 2) == "0.00"


def test_shadow_of_an_ellipsoid() -> None:
    turned, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    sphere = ellipse_outline(np.array([2.0, 2.0, 2.0]), turned, (0, 2))
    assert np.hypot(*sphere) == pytest.approx(2.0)
    flat = ellipse_outline(np.array([1.0, 2.0, 3.0]), np.eye(3), (0, 1))
    assert np.abs(flat).max(axis=1) == pytest.approx([1.0, 2.0])
