"""Rows 10 to 12: covariance of surfaces through points whose noise differs along the axes of the world."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.shapes.fit import fit_surface
from estimation.shapes.result import SurfaceFit

FloatArray = NDArray[np.float64]
MM = 1e-3
NOISE_MM = np.array([0.010, 0.013, 0.015])
TILTED = Rotation.from_euler("xyz", [5, 5, 0], degrees=True).as_matrix()  # about fixed x, then fixed y
TURN = np.arange(12) * np.pi / 6
AROUND = np.column_stack([np.cos(TURN), np.sin(TURN), np.zeros(12)])


def fitted(kind: str, points_mm: FloatArray, normals: FloatArray) -> SurfaceFit:
    """Fit of exact points, each believed as its noise along the normal deserves."""
    sigma_mm = np.linalg.norm(normals * NOISE_MM, axis=1)
    return fit_surface(kind, points_mm * MM, sigma_mm * MM)


def stds(fit: SurfaceFit) -> dict[str, float]:
    """mm and deg."""
    units = [1.0 / MM if unit == "m" else 180.0 / np.pi for unit in fit.units]
    return dict(zip(fit.parameter_names, np.sqrt(np.diag(fit.covariance)) * units, strict=True))


def test_row_10_plane_through_12_points_of_a_tilted_circle() -> None:
    found = stds(fitted("plane", 50.0 * AROUND @ TILTED.T, np.tile(TILTED[:, 2], (12, 1))))
    assert found["shift_w"] == pytest.approx(0.004317, rel=1e-3)
    assert [found["tilt_u"], found["tilt_v"]] == pytest.approx([0.006996] * 2, rel=1e-3)


def test_row_11_cylinder_through_12_points_of_a_tilted_pipe() -> None:
    points = 75.0 * AROUND + np.outer(np.where(np.arange(12) % 2, 50.0, -50.0), [0, 0, 1])
    fit = fitted("cylinder", points @ TILTED.T, AROUND @ TILTED.T)
    found, along_x = stds(fit), bool(np.abs(fit.frame.axes[0, 0]) > 0.7)
    # Shifts and tilts are those of the fit's own frame, whose u may lie along x or along y.
    x, y = ("u", "v") if along_x else ("v", "u")
    assert [found[f"shift_{x}"], found[f"shift_{y}"]] == pytest.approx([0.004395, 0.005002], rel=1e-3)
    assert [found[f"tilt_{x}"], found[f"tilt_{y}"]] == pytest.approx([0.005732, 0.005036], rel=1e-3)
    assert found["radius"] == pytest.approx(0.003301, rel=1e-3)


def test_row_12_sphere_through_six_axis_points() -> None:
    poles = np.concatenate([np.eye(3), -np.eye(3)])
    found = stds(fitted("sphere", 75.0 * poles, poles))
    centre = [found[f"shift_{axis}"] for axis in "uvw"]
    assert centre == pytest.approx([0.007071, 0.009192, 0.010607], rel=1e-3)
    assert found["radius"] == pytest.approx(0.004955, rel=1e-3)
