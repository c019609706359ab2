"""Nearest points of meshes against brute force, against trimesh, and against a sphere."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import EstimationError
from estimation.surfaces import mesh as mesh_module
from estimation.surfaces import signed_distance
from estimation.surfaces.feature import freeform
from estimation.surfaces.mesh import TriangleMesh
from estimation.transform import FloatArray
from tests.estimation.blade import blade_arrays, blade_mesh, points_on

MESH = blade_mesh()
needs_numba = pytest.mark.skipif(mesh_module.kernels is None, reason="numba is not installed")


def by_brute_force(mesh: TriangleMesh, points: FloatArray) -> FloatArray:
    """Least distances to all triangles by trimesh, in units in which its fixed tolerances do no harm."""
    corners = mesh.corners_m * 1e3
    each = [
        np.linalg.norm(
            trimesh.triangles.closest_point(corners, np.broadcast_to(p, (len(corners), 3))) - p, axis=1
        ).min()
        for p in points * 1e3
    ]
    return np.array(each) * 1e-3


@pytest.mark.parametrize("away_m", [0.0, 1e-4, 3e-3, 0.05, 2.0])
def test_the_nearest_triangle_is_found_at_any_distance(away_m: float) -> None:
    rng = np.random.default_rng(1)
    points = points_on(MESH, 40, rng) + away_m * rng.normal(size=(40, 3))
    found = MESH.nearest(points)
    apart = np.linalg.norm(points - found.foot_m, axis=1)
    assert apart == pytest.approx(by_brute_force(MESH, points), abs=1e-12)
    assert (np.abs(found.distance_m) <= apart + 1e-12).all()
    assert np.abs(found.distance_m)[~found.beyond] == pytest.approx(apart[~found.beyond])


@pytest.mark.parametrize(
    "solid",
    [
        trimesh.creation.box((0.05, 0.08, 0.12)).subdivide(),
        trimesh.creation.cone(radius=0.01, height=0.1, sections=5),
        trimesh.creation.torus(0.05, 0.01, major_sections=40, minor_sections=9),
        trimesh.creation.annulus(0.02, 0.0203, 0.05, sections=24),  # a wall of 0.3 mm
    ],
    ids=["box", "spike", "torus", "thin wall"],
)
def test_near_folds_and_through_thin_walls_too(solid: trimesh.Trimesh) -> None:
    mesh, rng = TriangleMesh(solid.vertices, solid.faces), np.random.default_rng(8)
    away = np.repeat([1e-6, 1e-4, 2e-3], 60)[:, None] * rng.normal(size=(180, 3))
    points = points_on(mesh, 180, rng) + away
    apart = np.linalg.norm(points - mesh.nearest(points).foot_m, axis=1)
    assert apart == pytest.approx(by_brute_force(mesh, points), abs=1e-12)


def _relief(rough_m: float, rng: np.random.Generator) -> TriangleMesh:
    """A hilly field of 0.1 m with 2 x 24 x 24 irregular triangles, and below it the same, 0.2 mm lower."""
    x, y = np.meshgrid(np.linspace(0, 0.1, 25), np.linspace(0, 0.1, 25), indexing="ij")
    z = 0.01 * np.sin(40 * x) + rough_m * rng.normal(size=x.shape)
    upper = np.stack([x, y, z], -1).reshape(-1, 3) + 3e-4 * rng.normal(size=(625, 3)) * [1, 1, 0]
    place = np.arange(625).reshape(25, 25)
    a, b, c, d = (part.ravel() for part in (place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    below = upper - np.array([0.0, 0.0, 2e-4])
    return TriangleMesh(np.vstack([upper, below]), np.vstack([triangles, triangles[:, ::-1] + 625]))


@needs_numba
@pytest.mark.parametrize("rough_m", [0.0, 1e-3, 5e-3])
def test_what_is_proven_without_a_look_around_is_what_a_look_around_finds(rough_m: float) -> None:
    rng = np.random.default_rng(9)
    mesh = _relief(rough_m, rng)
    assert mesh.grid is not None
    proofs = mesh.grid.clear.copy()
    for away_m in (1e-6, 3e-5, 3e-4, 2e-3):
        points = points_on(mesh, 4000, rng) + away_m * rng.normal(size=(4000, 3))
        quick = np.linalg.norm(points - mesh.nearest(points).foot_m, axis=1)
        mesh.grid.clear[:] = -1.0  # nothing is proven
        full = np.linalg.norm(points - mesh.nearest(points).foot_m, axis=1)
        mesh.grid.clear[:] = proofs
        assert quick == pytest.approx(full, abs=1e-15)


@pytest.mark.parametrize("flipped", [False, True])
def test_a_triangle_that_is_listed_twice_proves_nothing(flipped: bool) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x, y = np.meshgrid(np.arange(6) * 3e-3, np.arange(6) * 3e-3, indexing="ij")
        vertices = np.column_stack([x.ravel(), y.ravel(), 1e-3 * rng.normal(size=36)])
        place = np.arange(36).reshape(6, 6)
        a, b, c, d = (
            part.ravel() for part in (place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:])
        )
        triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        twice = triangles[:1, ::-1] if flipped else triangles[:1]
        mesh = TriangleMesh(vertices, np.concatenate([triangles, twice]))
        points = points_on(mesh, 100, rng) + 3e-4 * rng.normal(size=(100, 3))
        apart = np.linalg.norm(points - mesh.nearest(points).foot_m, axis=1)
        assert apart == pytest.approx(by_brute_force(mesh, points), abs=1e-12)


@needs_numba
def test_without_numba_the_numbers_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    points = (
        points_on(MESH, 300, rng) + rng.normal(size=(300, 3)) * np.repeat([1e-4, 5e-3, 0.05], 100)[:, None]
    )
    compiled = MESH.nearest(points)
    monkeypatch.setattr(mesh_module, "kernels", None)
    plain = blade_mesh().nearest(points)
    assert plain.distance_m == pytest.approx(compiled.distance_m, abs=1e-14)
    assert plain.normal == pytest.approx(compiled.normal, abs=1e-10)
    assert (plain.beyond == compiled.beyond).all()


def test_a_point_knows_its_side_even_where_the_foot_is_a_sharp_edge_or_corner() -> None:
    wedge = trimesh.creation.cone(radius=0.01, height=0.1, sections=5)  # acute edges, one very acute corner
    mesh = TriangleMesh(wedge.vertices, wedge.faces)
    points = np.random.default_rng(3).uniform([-0.02, -0.02, -0.02], [0.02, 0.02, 0.15], (2000, 3))
    found = mesh.nearest(points)
    outside = ~wedge.contains(points)
    assert not found.beyond.any()
    assert ((found.distance_m > 0) == outside).all()


def test_a_fine_sphere_is_a_sphere() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    mesh = TriangleMesh(ball.vertices, ball.faces)
    points = np.random.default_rng(4).normal(size=(500, 3)) * 0.05
    found = mesh.nearest(points)
    assert found.distance_m == pytest.approx(np.linalg.norm(points, axis=1) - 0.05, abs=3e-5)


def test_beside_an_open_edge_the_distance_is_the_height_and_the_point_is_flagged() -> None:
    square = TriangleMesh(
        np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    points = np.array([[0.05, 0.02, 0.001], [0.05, -0.02, 0.001], [-0.01, -0.01, -0.002], [0.03, 0.03, 0.5]])
    found = square.nearest(points)
    assert found.distance_m == pytest.approx([0.001, 0.001, -0.002, 0.5])
    assert found.beyond.tolist() == [False, True, True, False]


@given(st.integers(0, 2**32 - 1))
def test_row_20_gradient_against_central_differences_away_from_facet_edges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features = (freeform("blade", MESH),)
    points = points_on(MESH, 20, rng) + 1e-3 * rng.normal(size=(20, 3))
    index, h = np.zeros(20, dtype=np.intp), 1e-7
    steps = [np.zeros(3), *(np.eye(3) * h), *(-np.eye(3) * h)]
    found = [signed_distance(features, index, points + step) for step in steps]
    places = [MESH.nearest(points + step) for step in steps]
    same = np.all([each.place == places[0].place for each in places], axis=(0, 2)) & ~found[0].beyond
    numeric = np.column_stack(
        [(found[1 + k].distance_m - found[4 + k].distance_m) / (2 * h) for k in range(3)]
    )
    # A foot on an edge or corner bends the distance by 1 / distance.
    assert numeric[same] == pytest.approx(found[0].gradient[same], abs=2e-5)
    assert same.sum() > 10


@needs_numba
def test_sums_of_the_compiled_pass_are_those_of_the_nearest_points() -> None:
    rng = np.random.default_rng(5)
    points, weight = points_on(MESH, 5000, rng) + 2e-3 * rng.normal(size=(5000, 3)), rng.uniform(0.5, 2, 5000)
    total = MESH.sums(points, weight, np.eye(4), MESH.new_hints(len(points)))
    found = MESH.nearest(points)
    rows = -weight[:, None] * np.concatenate([found.normal, np.cross(points, found.normal)], axis=1)
    assert total.information == pytest.approx(rows.T @ rows, rel=1e-9)
    assert total.vector == pytest.approx(rows.T @ (weight * found.distance_m), rel=1e-9)
    assert total.cost == pytest.approx(np.sum((weight * found.distance_m) ** 2))


def test_meshes_that_cannot_be_are_refused() -> None:
    vertices, triangles = blade_arrays(4, 5)
    with pytest.raises(EstimationError, match="not there"):
        TriangleMesh(vertices, triangles + 1)
    with pytest.raises(EstimationError, match="no triangle with an area"):
        TriangleMesh(vertices, triangles[:, [0, 1, 1]])
    with pytest.raises(EstimationError, match=r"\(20, 2\)"):
        TriangleMesh(vertices[:, :2], triangles)
