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


@pytest.mark.parametrize("count", [20, 60, 100, 2500])
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


@pytest.mark.parametrize("seed", [12, 20, 27, 35])
def test_sixty_points_of_a_sphere_are_no_cone(seed: int) -> None:
    """Their distances look independent of those of their neighbours."""
    assert _said("cone", cloud("sphere", seed, count=60).points_m) == [(Cause.WRONG_SURFACE, True)]


def test_the_right_surface_is_named() -> None:
    fit = fit_surface("cone", cloud("sphere", 0, count=40).points_m)
    assert "off a sphere" in fit.flags[0].text


def _plane(count: int, sigma_m: float, seed: int = 1) -> FloatArray:
    rng = np.random.default_rng(seed)
    across = rng.uniform(-0.05, 0.05, (count, 2))
    return np.column_stack([across, 0.1 + sigma_m * rng.normal(size=count)])


def _pipe(rings: int, each: int, sigma_m: float, seed: int = 1) -> FloatArray:
    """A regular scan of a cylinder of 30 mm radius."""
    rng = np.random.default_rng(seed)
    turn = np.tile(np.linspace(0.0, 2.0 * np.pi, each, endpoint=False), rings)
    radius = 0.03 + sigma_m * rng.normal(size=len(turn))
    along = np.repeat(np.linspace(0.0, 0.1, rings), each)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), along])


@pytest.mark.parametrize("sigma_um", [0.1, 0.25, 0.5, 1.0, 3.0])
def test_rounded_coordinates_are_no_outliers(sigma_um: float) -> None:
    for seed in range(10):
        assert _said("plane", np.round(_plane(200, sigma_um * 1e-6, seed), 6)) == []
    tilted = _plane(900, 1e-7) + np.outer(2e-4 * _plane(900, 0.0)[:, 0], [0.0, 0.0, 1.0])
    assert _said("plane", np.round(tilted, 6)) == []


@pytest.mark.parametrize("step_um", [1.0, 10.0])
def test_steps_of_a_sensor_above_an_exact_raster_are_known(step_um: float) -> None:
    x, y = (axis.ravel() * 1e-3 for axis in np.meshgrid(np.arange(20.0), np.arange(20.0)))
    z = 0.05 + 3e-6 * np.random.default_rng(3).normal(size=400)
    step = step_um * 1e-6
    points = np.column_stack([x, y, step * np.round(z / step)])
    assert _said("plane", points) == []
    points[7, 2] += 2e-3
    assert _said("plane", points) == [(Cause.OUTLIERS, True)]


@pytest.mark.parametrize(("rings", "each"), [(300, 10), (300, 12), (301, 10), (5, 1000), (600, 4), (30, 60)])
@pytest.mark.parametrize("sigma_mm", [0.01, 0.1, 0.4])
def test_regular_scans_raise_no_suspicion(rings: int, each: int, sigma_mm: float) -> None:
    for seed in range(3):
        assert _said("cylinder", _pipe(rings, each, sigma_mm * 1e-3, seed)) == []


def test_a_barrel_in_a_regular_scan_is_no_plane() -> None:
    points = _pipe(300, 10, 2e-6)
    points[:, :2] *= 1.0 - 0.003 * (20.0 * (points[:, 2:] - 0.05)) ** 2
    fit = fit_surface("cylinder", points)
    assert fit.flags and "plane" not in fit.flags[0].text and not fit.flags[0].spoils


@pytest.mark.parametrize("larger", [3.0, 10.0, 25.0])
def test_points_of_larger_stated_uncertainty_are_no_outliers(larger: float) -> None:
    sigma = np.where(np.arange(200) % 10 == 0, larger, 1.0) * 2e-6
    for seed in range(10):
        points = _plane(200, 1.0, seed)
        points[:, 2] = 0.1 + sigma * np.random.default_rng(seed).normal(size=200)
        assert fit_surface("plane", points, sigma).flags == ()


def test_long_tails_spoil_nothing() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        points = _plane(500, 0.0)
        points[:, 2] += 1e-5 * rng.laplace(size=500)
        assert not any(spoils for _, spoils in _said("plane", points))


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


@pytest.mark.parametrize("count", [5000, 90_000, 400_000])
def test_a_file_stacked_on_itself_is_known_whatever_its_length(count: int) -> None:
    points = _plane(count, 1e-5)
    assert (Cause.DUPLICATED_POINTS, True) in _said("plane", np.vstack([points, points]))
    assert (Cause.DUPLICATED_POINTS, True) in _said("plane", np.repeat(points, 2, axis=0))


@pytest.mark.parametrize("count", [99_999, 100_001])
def test_one_point_far_off_is_found_among_any_number(count: int) -> None:
    points = _plane(count, 1e-5)
    assert _said("plane", points) == []
    points[777, 2] += 0.1
    flags = fit_surface("plane", points).flags
    assert "Point 778 lies 100 mm off" in flags[0].text and flags[0].spoils


def test_a_form_error_is_told_from_noise() -> None:
    points = cloud("plane", 4, count=400, sigma_m=1e-6, offset_m=0.0).points_m
    fit = fit_surface("plane", points)
    u = (points - fit.frame.origin_m) @ fit.frame.axes[:, 0]
    wavy = points + 2e-5 * np.outer(np.sin(300.0 * u), fit.frame.axes[:, 2])
    assert [cause for cause, _ in _said("plane", wavy)] == [Cause.FORM_ERROR]


def test_a_single_distant_point_of_few_is_found() -> None:
    points = cloud("sphere", 2, count=12).points_m.copy()
    points[3] *= 1.006
    assert (Cause.OUTLIERS, True) in _said("sphere", points)
