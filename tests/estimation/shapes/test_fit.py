"""Surfaces from points: against references to 50 digits, against chance, and points that must be refused."""

import numpy as np
import pytest

from estimation.shapes import passes
from estimation.shapes.fit import KINDS, fit_surface
from estimation.shapes.refusals import Cause, FitRefused
from estimation.shapes.result import SurfaceFit
from estimation.transform import FloatArray
from tests.estimation.shapes import reference
from tests.estimation.shapes.clouds import cloud

_POINT = {
    "plane": "point_m",
    "sphere": "center_m",
    "cylinder": "axis_point_m",
    "cone": "apex_m",
    "torus": "center_m",
}
_AXIS = {"plane": "normal", "cylinder": "axis", "cone": "axis", "torus": "axis"}
_LIMIT_M, _LIMIT_RAD = 1e-9, np.radians(1e-6)  # 1e-6 mm and 1e-6 deg


@pytest.mark.parametrize("arc_deg", [360.0, 90.0])
@pytest.mark.parametrize("kind", list(KINDS))
def test_agrees_with_references_to_fifty_digits(kind: str, arc_deg: float) -> None:
    data = cloud(kind, seed=int(arc_deg) + len(kind), count=40, arc_deg=arc_deg)
    point, axis, sizes = (np.array(part, dtype=float) for part in reference.fit(kind, data))
    fit = fit_surface(kind, data.points_m)
    found = fit.shape.parameters()
    assert np.linalg.norm(found[_POINT[kind]] - point) < _LIMIT_M
    if kind in _AXIS:
        assert np.linalg.norm(np.cross(np.asarray(found[_AXIS[kind]]), axis)) < _LIMIT_RAD
    if kind == "cone":
        assert fit.shape.sizes[1] == pytest.approx(float(sizes[0]), abs=_LIMIT_RAD)
    else:
        assert fit.shape.sizes == pytest.approx(sizes, abs=_LIMIT_M)


@pytest.mark.parametrize("count", [10, 12])
def test_the_torus_through_few_points_is_found(count: int) -> None:
    """They leave many local minima; that of the truth has no residuals."""
    for seed in range(20):
        data = cloud("torus", seed, count=count, arc_deg=200.0, sigma_m=1e-8)
        assert fit_surface("torus", data.points_m).rms_m < 3e-8


def _freedom_errors(fit: SurfaceFit, kind: str, seed: int) -> FloatArray:
    """Of the true surface, seen from the fitted one, in the freedoms of its covariance."""
    truth = cloud(kind, seed, count=60)
    u, v, w = fit.frame.axes.T
    offset = truth.centre_m - fit.frame.origin_m
    axis = truth.axis * np.sign(truth.axis @ w)
    error = {
        "shift_u": u @ offset,
        "shift_v": v @ offset,
        "shift_w": (axis if kind == "plane" else w) @ offset,
        "tilt_u": -axis @ v,
        "tilt_v": axis @ u,
    }
    if kind == "cylinder":  # where the true axis crosses the plane w = 0 of the fitted frame
        start = truth.centre_m - fit.frame.origin_m
        crossing = start - axis * (start @ w) / (axis @ w)
        error |= {"shift_u": u @ crossing, "shift_v": v @ crossing}
    sizes = fit.parameter_names[len(fit.parameter_names) - len(truth.sizes) :]
    fitted = fit.shape.sizes[len(fit.shape.sizes) - len(truth.sizes) :]
    error |= {name: true - own for name, true, own in zip(sizes, truth.sizes, fitted, strict=True)}
    return np.array([error[name] for name in fit.parameter_names])


@pytest.mark.parametrize("kind", list(KINDS))
def test_covariance_holds_the_truth(kind: str) -> None:
    """The mean of e^T P^-1 e over many fits is the number of freedoms, within its 99.9 % band."""
    squares = []
    runs = 40 if kind == "torus" else 150  # its many starts take longer
    for seed in range(runs):
        fit = fit_surface(kind, cloud(kind, seed, count=60).points_m, sigma_m=1e-5)
        error = _freedom_errors(fit, kind, seed)
        squares.append(error @ np.linalg.solve(fit.covariance, error))
    count = len(error)
    assert np.mean(squares) == pytest.approx(count, abs=3.3 * np.sqrt(2.0 * count / runs))


@pytest.mark.parametrize("kind", list(KINDS))
def test_numpy_gives_the_numbers_of_the_compiled_kernels(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if not passes.COMPILED:
        pytest.skip("numba is not installed")
    points = cloud(kind, seed=3, count=500).points_m
    weights = np.linspace(0.5, 2.0, 500)
    shape = fit_surface(kind, points).shape
    compiled = passes.products(shape, points, weights)
    monkeypatch.setattr(passes, "COMPILED", False)
    plain = passes.products(shape, points, weights)
    scale = np.sqrt(np.diag(plain))
    assert np.max(np.abs(compiled - plain) / np.outer(scale, scale)) < 1e-12


@pytest.mark.parametrize("kind", list(KINDS))
def test_jacobian_is_that_of_central_differences(kind: str) -> None:
    points = cloud(kind, seed=5).points_m
    shape = fit_surface(kind, points).shape
    rows = shape.rows(points)[:-1]
    for place, row in enumerate(rows):
        step = np.zeros(len(rows))
        step[place] = 1e-6
        difference = (shape.moved(step).distance(points) - shape.moved(-step).distance(points)) / 2e-6
        assert np.max(np.abs(difference - row)) < 1e-6 * max(1.0, float(np.linalg.norm(row)))


@pytest.mark.parametrize("kind", list(KINDS))
def test_robust_fit_leaves_out_gross_outliers(kind: str) -> None:
    points = cloud(kind, seed=9, count=200).points_m.copy()
    clean = fit_surface(kind, points[5:])
    points[:5] += np.array([0.004, 0.003, 0.005])
    fit = fit_surface(kind, points, robust=True)
    assert set(range(5)) <= set(fit.rejected.tolist())
    assert fit.shape.distance(points[5:]) == pytest.approx(clean.shape.distance(points[5:]), abs=5e-6)


def test_sigma_that_does_not_fit_the_scatter_is_flagged() -> None:
    fit = fit_surface("sphere", cloud("sphere", seed=2, count=200).points_m, sigma_m=1e-5 / 25.4)
    assert [flag.cause for flag in fit.flags] == [Cause.SCATTER_NOT_AS_STATED]
    assert fit.variance_factor == pytest.approx(25.4**2, rel=0.25)


_ARC = np.linspace(0.0, 6.0, 40)
_REFUSED: dict[str, tuple[str, FloatArray, Cause]] = {
    "three columns missing": ("plane", np.zeros((10, 2)), Cause.WRONG_SHAPE),
    "not a number": ("plane", np.vstack([cloud("plane", 1).points_m, [0, np.nan, 0]]), Cause.NOT_FINITE),
    "too few": ("cylinder", cloud("cylinder", 1, count=4).points_m, Cause.TOO_FEW_POINTS),
    "no redundancy": ("cylinder", cloud("cylinder", 1, count=5).points_m, Cause.NO_REDUNDANCY),
    "duplicates": ("sphere", np.tile(cloud("sphere", 1, count=3).points_m, (9, 1)), Cause.DUPLICATED_POINTS),
    "a line": ("plane", np.outer(_ARC, [0.1, 0.2, 0.3]), Cause.POINTS_ON_A_LINE),
    "a circle": ("cylinder", np.column_stack([np.cos(_ARC), np.sin(_ARC), 0 * _ARC]), Cause.NEARLY_FLAT),
    "a cylinder": ("cone", cloud("cylinder", 4, count=200).points_m, Cause.SIMPLER_SURFACE),
    "a plane": ("cone", cloud("plane", 3, count=100).points_m, Cause.SIMPLER_SURFACE),
    "noise": ("sphere", np.random.default_rng(1).normal(size=(100, 3)), Cause.WRONG_SURFACE),
}


@pytest.mark.parametrize("case", list(_REFUSED))
def test_points_that_give_no_surface_are_refused_by_cause(case: str) -> None:
    kind, points, cause = _REFUSED[case]
    with pytest.raises(FitRefused) as refusal:
        fit_surface(kind, points)
    assert refusal.value.cause is cause


@pytest.mark.parametrize("true", ["plane", "cylinder"])
def test_a_cone_where_there_is_none_is_called_that(true: str) -> None:
    """Whether it settles or not, which is a matter of rounding."""
    for seed in range(20):
        with pytest.raises(FitRefused) as refusal:
            fit_surface("cone", cloud(true, seed, count=100).points_m)
        assert refusal.value.cause in (Cause.SIMPLER_SURFACE, Cause.UNDETERMINED)
        assert "simpler" in refusal.value.remedy or f"Fit a {true}" in refusal.value.remedy


def test_a_surface_that_fits_badly_is_never_advised() -> None:
    """A torus that does not settle, and a cylinder 64 stated standard deviations off."""
    points = cloud("torus", 20, count=100, arc_deg=40, sigma_m=1e-5).points_m
    with pytest.raises(FitRefused) as refusal:
        fit_surface("torus", points, sigma_m=1e-5)
    assert "cylinder" not in str(refusal.value)
    with pytest.raises(FitRefused) as refusal:
        fit_surface("sphere", cloud("torus", 13, count=12, sigma_m=5e-4).points_m)
    assert "plane" not in str(refusal.value)


def test_a_flat_piece_does_not_determine_a_sphere() -> None:
    points = cloud("plane", seed=1, count=200).points_m
    with pytest.raises(FitRefused) as refusal:
        fit_surface("sphere", points)
    assert refusal.value.cause in (Cause.UNDETERMINED, Cause.SIMPLER_SURFACE)
