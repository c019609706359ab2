"""What a fit says of its points although no standard deviation is stated to compare them with."""

import numpy as np
import pytest

from estimation.shapes.fit import KINDS, fit_surface
from estimation.shapes.refusals import Cause, FitRefused
from estimation.transform import FloatArray
from tests.estimation.shapes.clouds import cloud


def _said(kind: str, points_m: FloatArray, robust: bool = False) -> list[tuple[Cause, bool]]:
    return [(flag.cause, flag.spoils) for flag in fit_surface(kind, points_m, robust=robust).flags]


@pytest.mark.parametrize("count", [10, 60, 2500])
@pytest.mark.parametrize("kind", list(KINDS))
def test_sound_points_raise_no_suspicion(kind: str, count: int) -> None:
    for seed in range(40 if count < 100 else 4):
        said = _said(kind, cloud(kind, 100 + seed, count=count).points_m)
        assert [cause for cause, _ in said if cause is not Cause.AMBIGUOUS] == []


@pytest.mark.parametrize("count", [20, 100, 2500])
@pytest.mark.parametrize("named", list(KINDS))
@pytest.mark.parametrize("true", list(KINDS))
def test_another_surface_is_never_taken_for_the_named_one(true: str, named: str, count: int) -> None:
    if true == named:
        return
    for seed in range(4):
        try:
            fit = fit_surface(named, cloud(true, seed, count=count).points_m)
        except FitRefused:
            continue
        assert any(flag.cause is Cause.WRONG_SURFACE and flag.spoils for flag in fit.flags), fit.flags


def test_the_right_surface_is_named() -> None:
    fit = fit_surface("cone", cloud("sphere", 0, count=40).points_m)
    assert "off a sphere" in fit.flags[0].text


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("outliers", [1, 3, 8])
def test_points_far_off_spoil_a_fit_unless_they_are_left_out(kind: str, outliers: int) -> None:
    points = cloud(kind, seed=9, count=100).points_m.copy()
    points[:outliers] += np.array([0.002, 0.0015, 0.0025])
    assert _said(kind, points) == [(Cause.OUTLIERS, True)]
    assert _said(kind, points, robust=True) == [(Cause.OUTLIERS, False)]


def test_points_told_again_and_again_are_not_measurements() -> None:
    points = cloud("plane", 1, count=4).points_m
    assert (Cause.DUPLICATED_POINTS, True) in _said("plane", np.repeat(points, 15, axis=0))
    points = cloud("plane", 1, count=60).points_m
    assert _said("plane", np.vstack([points, points[:12]])) == [(Cause.DUPLICATED_POINTS, False)]


def test_a_form_error_is_told_from_noise() -> None:
    points = cloud("plane", 4, count=400, sigma_m=1e-6, offset_m=0.0).points_m
    fit = fit_surface("plane", points)
    u = (points - fit.frame.origin_m) @ fit.frame.axes[:, 0]
    wavy = points + 2e-5 * np.outer(np.sin(300.0 * u), fit.frame.axes[:, 2])
    assert [cause for cause, _ in _said("plane", wavy)] == [Cause.FORM_ERROR]


def test_a_single_distant_point_of_few_is_found() -> None:
    points = cloud("sphere", 2, count=12).points_m.copy()
    points[3] *= 1.003
    assert (Cause.OUTLIERS, True) in _said("sphere", points)
