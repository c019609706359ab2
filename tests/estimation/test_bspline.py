"""Patches against scipy, foot points against brute force, and closed patches without a seam."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import NdBSpline
from scipy.optimize import minimize

from estimation.errors import EstimationError
from estimation.surfaces import bspline_cells, signed_distance
from estimation.surfaces.bspline import BSplinePatch
from estimation.surfaces.bspline_fit import fit_patch
from estimation.surfaces.feature import freeform
from estimation.transform import FloatArray, exp_pose
from tests.estimation.blade import closed_blade_patch, patch

PATCH = patch()
needs_numba = pytest.mark.skipif(not bspline_cells.COMPILED, reason="numba is not installed")


def near(surface: BSplinePatch, count: int, away_m: float, rng: np.random.Generator) -> FloatArray:
    """Points off the surface, in no order."""
    ends = np.array([[k[3], k[-4]] for k in (surface.knots_u, surface.knots_v)])
    place = rng.uniform(ends[:, 0], ends[:, 1], (count, 2))
    return surface.points(place) + away_m * rng.normal(size=(count, 3))


def test_points_and_derivatives_are_those_of_scipy() -> None:
    place = np.random.default_rng(1).uniform([0, 0], [1, 1], (50, 2))
    spline = NdBSpline((PATCH.knots_u, PATCH.knots_v), PATCH.control_m, 3)
    jets = PATCH.cells.jets(place)
    for row, order in enumerate([(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]):
        assert jets[:, row] == pytest.approx(spline(place, nu=order), rel=1e-9, abs=1e-10)


@pytest.mark.parametrize("away_m", [1e-4, 3e-3, 0.03])
def test_feet_are_the_nearest_of_all_points_of_the_surface(away_m: float) -> None:
    rng = np.random.default_rng(2)
    points = near(PATCH, 60, away_m, rng)
    found = PATCH.nearest(points)
    u, v = np.meshgrid(np.linspace(0, 1, 301), np.linspace(0, 1, 301), indexing="ij")
    everywhere = PATCH.points(np.column_stack([u.ravel(), v.ravel()]))
    dense = np.linalg.norm(points[:, None] - everywhere, axis=2).min(axis=1)
    apart = np.linalg.norm(points - found.foot_m, axis=1)
    assert (apart <= dense + 1e-12).all()
    inside = ~found.beyond
    assert np.abs(found.distance_m[inside]) == pytest.approx(apart[inside], abs=1e-9)


def test_a_foot_is_as_good_as_that_of_a_general_optimizer() -> None:
    point = near(PATCH, 1, 2e-3, np.random.default_rng(3))
    found = PATCH.nearest(point)
    scale = 1e6
    other = minimize(
        lambda place: scale * float(np.sum((PATCH.points(place[None]) - point) ** 2)),
        found.place[0] + 0.01,
        method="Nelder-Mead",
        options={"xatol": 1e-10, "fatol": 1e-14},
    )
    assert found.place[0] == pytest.approx(other.x, abs=1e-6)


@needs_numba
@pytest.mark.parametrize("surface", [PATCH, closed_blade_patch()], ids=["open", "closed"])
def test_without_numba_the_numbers_are_the_same(
    surface: BSplinePatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = near(surface, 300, 3e-3, np.random.default_rng(4))
    weight = np.full(300, 2.0)
    pose = exp_pose(np.array([1e-3, 0, 0, 0, 0.01, 0]))
    compiled, sums = surface.nearest(points), surface.sums(points, weight, pose, surface.new_hints(300))
    monkeypatch.setattr(bspline_cells, "COMPILED", False)
    plain, plain_sums = surface.nearest(points), surface.sums(points, weight, pose, surface.new_hints(300))
    assert plain.distance_m == pytest.approx(compiled.distance_m, abs=1e-13)
    assert (plain.beyond == compiled.beyond).all()
    assert plain_sums.information == pytest.approx(sums.information, rel=1e-9, abs=1e-9)
    assert plain_sums.vector == pytest.approx(sums.vector, rel=1e-9, abs=1e-12)
    assert plain_sums.cost == pytest.approx(sums.cost)


def test_a_closed_patch_has_no_edge_at_its_seam() -> None:
    blade = closed_blade_patch()
    assert (blade.cells.closed_u, blade.cells.closed_v) == (True, False)
    v = np.full(40, 0.5)
    seam = blade.knots_u[3]
    place = np.column_stack([seam + np.linspace(1e-4, 1e-3, 40), v])
    jets = blade.cells.jets(place)
    normal = np.cross(jets[:, 1], jets[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Starts from the other side of the seam, where the nearest grid point may be.
    found = blade.nearest(jets[:, 0] + 1e-3 * normal)
    assert found.distance_m == pytest.approx(1e-3, abs=1e-12)
    assert not found.beyond.any()


def test_knots_need_not_be_uniform_and_may_be_repeated() -> None:
    knots = np.array([0, 0, 0, 0, 0.1, 0.5, 0.5, 1, 1, 1, 1.0])
    rng = np.random.default_rng(5)
    control = np.stack(np.meshgrid(np.linspace(0, 0.1, 7), np.linspace(0, 0.1, 7), indexing="ij"), -1)
    control = np.concatenate([control, 0.003 * rng.normal(size=(7, 7, 1))], axis=2)
    surface = BSplinePatch(knots, knots, control)
    place = rng.uniform(0, 1, (30, 2))
    expected = NdBSpline((knots, knots), control, 3)(place)
    assert surface.points(place) == pytest.approx(expected, abs=1e-12)
    found = surface.nearest(expected)
    assert found.distance_m == pytest.approx(np.zeros(30), abs=1e-12)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_row_20_derivatives_against_central_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features = (freeform("skin", PATCH, block="skin"),)
    points = near(PATCH, 5, 1e-3, rng)
    index, h = np.zeros(5, dtype=np.intp), 1e-6
    values = 1e-4 * rng.normal(size=PATCH.control_m.size)
    found = signed_distance(features, index, points, values)
    inside = ~found.beyond
    for k in range(3):
        step = h * np.eye(3)[k]
        up, down = (signed_distance(features, index, points + s, values) for s in (step, -step))
        numeric = (up.distance_m - down.distance_m) / (2 * h)
        assert numeric[inside] == pytest.approx(found.gradient[inside, k], abs=1e-6)
    for column in rng.integers(0, values.size, 5):
        step = np.zeros(values.size)
        step[column] = h
        up, down = (signed_distance(features, index, points, values + s) for s in (step, -step))
        numeric = (up.distance_m - down.distance_m) / (2 * h)
        assert numeric[inside] == pytest.approx(found.deviation[inside, column], abs=1e-6)


def test_a_patch_goes_through_its_points_and_their_noise_comes_out() -> None:
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 8), indexing="ij")
    grid = PATCH.points(np.column_stack([u.ravel(), v.ravel()])).reshape(9, 8, 3)
    fitted = fit_patch(grid, std_m=1e-5)
    assert fitted.patch.nearest(grid.reshape(-1, 3)).distance_m == pytest.approx(np.zeros(72), abs=1e-12)
    # Points of the surface between the measured ones scatter as the covariance of the control points says.
    place = np.random.default_rng(6).uniform(0.1, 0.9, (4, 2))
    weights = fitted.patch.weights(place)
    claimed = np.sqrt(np.einsum("ma,ab,mb->m", weights, fitted.covariance_m2, weights))
    rng, still = np.random.default_rng(7), fitted.patch.points(place)
    seen = [
        fit_patch(grid + 1e-5 * rng.normal(size=grid.shape), 1e-5).patch.nearest(still).distance_m
        for _ in range(400)
    ]
    assert np.std(seen, axis=0) == pytest.approx(claimed, rel=0.12)


@pytest.mark.parametrize(
    ("knots", "control", "message"),
    [
        (np.arange(7.0), np.zeros((4, 4, 3)), "knots"),
        (np.arange(8.0)[::-1], np.zeros((4, 4, 3)), "fall"),
        (np.arange(8.0), np.full((4, 4, 3), np.nan), "not finite"),
        (np.arange(7.0), np.zeros((3, 3, 3)), "at least 4"),
    ],
)
def test_patches_that_cannot_be_are_refused(knots: FloatArray, control: FloatArray, message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        BSplinePatch(knots, knots, control)
    with pytest.raises(EstimationError, match="4 by 4"):
        fit_patch(np.zeros((3, 5, 3)), 1e-5)
