"""The kind of surface, chosen from points alone."""

import numpy as np
import pytest
import trimesh

from estimation.shapes.automatic import fit_any
from tests.estimation.shapes.clouds import cloud


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder", "cone", "torus"])
def test_the_kind_that_the_points_lie_on_is_chosen(kind: str) -> None:
    assert kind == fit_any(cloud(kind, 1).points_m).fit.shape.KIND


def test_rounding_to_single_precision_is_no_noise_that_a_richer_surface_may_follow() -> None:
    """The vertices of a mesh without noise: a torus follows their rounding better than a sphere does."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=12.7)
    ball.apply_translation([100.0, 0.0, 0.0])
    stored_mm = np.asarray(ball.vertices, dtype=np.float32).astype(np.float64)
    assert fit_any(stored_mm / 1e3).fit.shape.KIND == "sphere"
