"""The scene: rays and touches against a mesh of the same CAD, and the declared deviations."""

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation.errors import CellFileError
from estimation.transform import FloatArray
from simulators.world.solid import Solid
from simulators.world.step_faces import read_faces
from simulators.world.truth import FaceDeviation, Truth, draw_truth, stream
from simulators.world.world import World
from simulators.world.world_file import WorldFile

DOWN = np.array([0.0, 0.0, -1.0])


class Still:
    """An arm that stands where it is put."""

    def __init__(self, joints_rad: FloatArray) -> None:
        self.joints_rad, self.key = joints_rad, 0

    def advance(self, time_s: float) -> None:
        pass

    def joints_at(self, time_s: float) -> FloatArray:
        return self.joints_rad

    def standstill(self, time_s: float) -> tuple[int, ...] | None:
        return (self.key,)


@pytest.fixture(scope="module")
def solid(world_file: WorldFile, nominal: Truth) -> Solid:
    return Solid(read_faces(world_file.part.cad), world_file.part.features, nominal.features)


@pytest.fixture(scope="module")
def mesh(world_file: WorldFile) -> Any:
    import cascadio
    import trimesh

    glb = cascadio.load(world_file.part.cad.read_bytes(), tol_linear=0.001, tol_angular=0.02)
    scene = trimesh.load(io.BytesIO(glb), file_type="glb")
    (geometry,) = scene.geometry.values()
    return trimesh.Trimesh(geometry.vertices, geometry.faces)


def test_rays_meet_the_part_where_its_mesh_is(solid: Solid, mesh: Any) -> None:
    rng = np.random.default_rng(1)
    aims = rng.uniform([-0.02, -0.02, -0.02], [0.12, 0.17, 0.13], (400, 3))
    starts = aims + 0.4 * (unit := rng.standard_normal((400, 3))) / np.linalg.norm(
        unit, axis=1, keepdims=True
    )
    ways = (aims - starts) / np.linalg.norm(aims - starts, axis=1, keepdims=True)
    points, rays, _ = mesh.ray.intersects_location(starts, ways, multiple_hits=False)
    expected = dict(zip(rays.tolist(), np.linalg.norm(points - starts[rays], axis=1), strict=True))
    wrong = []
    for i, (start, way) in enumerate(zip(starts, ways, strict=True)):
        hit = solid.hit(start, way, 10.0)
        if (hit is None) != (i not in expected) or (hit and abs(hit.distance_m - expected[i]) > 2e-5):
            wrong.append(i)
    assert len(expected) > 200
    assert len(wrong) <= 2  # rays that graze an edge


def test_distances_to_the_part_are_those_to_its_mesh(solid: Solid, mesh: Any) -> None:
    import trimesh

    rng = np.random.default_rng(2)
    points = rng.uniform([-0.008, -0.008, -0.008], [0.108, 0.158, 0.123], (300, 3))
    outside = trimesh.proximity.signed_distance(mesh, points) < 0
    _, expected, _ = trimesh.proximity.closest_point(mesh, points[outside])
    got = [solid.signed_distance(point) for point in points[outside]]
    near = expected < 0.0099
    np.testing.assert_allclose(np.array(got)[near], expected[near], atol=5e-6)
    assert near.sum() > 40


@pytest.mark.parametrize(
    ("start_mm", "way", "surface", "distance_mm"),
    [
        ((50, 20, 150), (0, 0, -1), "top", 50),
        ((35, 45, 150), (0, 0, -1), "face 9", 75),  # the floor of the bore
        ((65, 105, 150), (0, 0, -1), "face 10", 35),  # the boss
        ((50, -80, 50), (0, 1, 0), "front", 80),
        ((35, 45, 90), (1, 0, 0), "bore", 15),
        ((20, 105, 110), (1, 0, 0), "boss", 32.5),
    ],
)
def test_named_faces(solid: Solid, start_mm: Any, way: Any, surface: str, distance_mm: float) -> None:
    hit = solid.hit(np.array(start_mm) * 1e-3, np.array(way, dtype=float), 1.0)
    assert hit is not None and hit.surface == surface
    assert hit.distance_m == pytest.approx(distance_mm * 1e-3, abs=1e-9)
    assert hit.cosine == pytest.approx(1.0)


def deviated(world_file: WorldFile, nominal: Truth, **changes: FaceDeviation) -> Solid:
    faces = read_faces(world_file.part.cad)
    return Solid(faces, world_file.part.features, {**nominal.features, **changes})


def deviation(offset_m: float = 0.0, shift_m: tuple[float, float, float] = (0, 0, 0)) -> FaceDeviation:
    return FaceDeviation(offset_m, np.array(shift_m), 0.0, 0.04, np.zeros(2))


def test_signs_of_the_deviations(world_file: WorldFile, nominal: Truth) -> None:
    """Planes move outward; radii grow, of a hole too; shifts are along the axes of the part."""
    part = deviated(
        world_file,
        nominal,
        top=deviation(1e-4),
        front=deviation(-2e-4),
        bore=deviation(1e-4, (3e-4, 0, 0)),
        boss=deviation(1e-4, (0, -2e-4, 0)),
    )

    def distance(start_mm: tuple[float, float, float], way: tuple[float, float, float]) -> float:
        hit = part.hit(np.array(start_mm) * 1e-3, np.array(way), 1.0)
        assert hit is not None
        return hit.distance_m * 1e3

    assert distance((50, 20, 150), (0, 0, -1)) == pytest.approx(50 - 0.1)
    assert distance((50, -80, 50), (0, 1, 0)) == pytest.approx(80 + 0.2)
    assert distance((35, 45, 90), (1, 0, 0)) == pytest.approx(15 + 0.1 + 0.3)
    assert distance((35, 45, 90), (-1, 0, 0)) == pytest.approx(15 + 0.1 - 0.3)
    assert distance((65, 80, 110), (0, 1, 0)) == pytest.approx(25 - 12.5 - 0.1 - 0.2)
    assert part.signed_distance(np.array([50, 20, 105]) * 1e-3) == pytest.approx(4.9e-3)
    assert part.signed_distance(np.array([45, 45, 85]) * 1e-3) == pytest.approx(5.4e-3)


def test_a_feature_must_name_one_face(world_file: WorldFile, nominal: Truth) -> None:
    astray = replace(world_file.part.features[0], at_m=np.array([0.05, 0.05, 0.2]))
    with pytest.raises(CellFileError, match=r"top: 0 faces at \[50.0, 50.0, 200.0\] mm"):
        Solid(read_faces(world_file.part.cad), (astray,), nominal.features)


def test_parsed_faces_are_kept(world_file: WorldFile, tmp_path: Path) -> None:
    made = read_faces(world_file.part.cad, tmp_path)
    read_faces.cache_clear()
    kept = read_faces(world_file.part.cad, tmp_path)
    for first, second in zip(made, kept, strict=True):
        np.testing.assert_array_equal(first.outline, second.outline)
        assert first.radius == second.radius and first.outward == second.outward


# -- the whole scene -----------------------------------------------------------------------------


@pytest.fixture
def arm(world_file: WorldFile) -> Still:
    return Still(world_file.arm.start_joints_rad)


@pytest.fixture
def world(world_file: WorldFile, nominal: Truth, arm: Still) -> World:
    return World(world_file, nominal, arm)


def over(world: World, matrix: FloatArray, point_m: tuple[float, float, float]) -> FloatArray:
    return matrix[:3, :3] @ np.array(point_m) + matrix[:3, 3]


def test_artefacts_are_where_the_truth_says(world_file: WorldFile, arm: Still) -> None:
    truth = draw_truth(world_file, 5)
    world = World(world_file, truth, arm)
    for name, matrix, point, radius in (
        ("bar.1", truth.base_T_bar, (0, 0, 0), truth.bar_radii_m[0]),
        ("bar.2", truth.base_T_bar, (0, 0, truth.bar_length_m), truth.bar_radii_m[1]),
        ("sphere", truth.base_T_sphere, (0, 0, 0), truth.sphere_radius_m),
    ):
        centre = over(world, matrix, point)
        hit = world.ray_hit(centre - 0.1 * DOWN, DOWN)
        assert hit is not None and (hit.surface, hit.cosine) == (name, pytest.approx(1.0))
        assert hit.distance_m == pytest.approx(0.1 - radius)
        gaps = dict(world.ball_clearances_m(centre - 0.02 * DOWN))
        assert gaps[name] == pytest.approx(0.02 - radius - truth.probe_radius_m)
    plate = over(world, truth.base_T_plate, (0.1, -0.1, 0.05))
    normal = truth.base_T_plate[:3, 2]
    hit = world.ray_hit(plate, -normal)
    assert hit is not None and hit.surface == "plate" and hit.distance_m == pytest.approx(0.05)
    assert dict(world.ball_clearances_m(plate))["plate"] == pytest.approx(0.05 - truth.probe_radius_m)


def test_the_plate_ends_at_its_rim_and_has_a_back(world: World) -> None:
    matrix = world.truth.base_T_plate
    assert world.ray_hit(over(world, matrix, (0.149, 0.149, 0.05)), -matrix[:3, 2]) is not None
    assert world.ray_hit(over(world, matrix, (0.151, 0.0, 0.05)), -matrix[:3, 2]) is None
    beside = dict(world.ball_clearances_m(over(world, matrix, (0.153, 0.0, 0.004))))["plate"]
    assert beside == pytest.approx(math.hypot(3e-3, 4e-3) - world.truth.probe_radius_m)
    inside = dict(world.ball_clearances_m(over(world, matrix, (0.0, 0.0, -0.002))))["plate"]
    assert inside == pytest.approx(-2e-3 - world.truth.probe_radius_m)


def test_a_missing_part_is_neither_seen_nor_touched(world: World) -> None:
    above = over(world, world.truth.base_T_part, (0.05, 0.02, 0.15))
    seen = world.ray_hit(above, DOWN)
    assert seen is not None and seen.surface == "top"
    world.part_present = False
    assert world.ray_hit(above, DOWN) is None
    assert "part" not in dict(world.ball_clearances_m(above))


def test_a_bump_moves_the_beam(world: World, arm: Still) -> None:
    before = world.flange_T_laser.copy()
    world.bump_laser(np.array([1e-3, 0, 0]), np.array([0, 0.01, 0]))
    np.testing.assert_allclose(world.flange_T_laser[:3, 3] - before[:3, 3], before[:3, 0] * 1e-3, atol=1e-12)
    tilt = math.acos(float(world.flange_T_laser[:3, 2] @ before[:3, 2]))
    assert tilt == pytest.approx(0.01)


def aim_at_plate(world: World, arm: Still, tilt_rad: float = 0.0) -> None:
    """Put the plate 80 mm before the laser."""
    beam = world.flange_pose(arm.joints_rad) @ world.flange_T_laser
    plate = np.eye(4)
    c, s = math.cos(tilt_rad), math.sin(tilt_rad)
    plate[:3, :3] = beam[:3, :3] @ np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    plate[:3, :3] = plate[:3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    plate[:3, 3] = beam[:3, 3] + 0.08 * beam[:3, 2]
    world._plate_T_base = np.linalg.inv(plate)


def test_scatter_belongs_to_the_standstill(world: World, arm: Still, world_file: WorldFile) -> None:
    aim_at_plate(world, arm)
    lengths = []
    for key in range(400):
        arm.key = key
        window = world.beam_lengths_m(np.linspace(0.0, 0.06, 120))
        assert np.ptp(window) == 0
        again = world.beam_lengths_m(np.linspace(0.1, 0.2, 10))
        assert again[0] == window[0]
        lengths.append(window[0] - 0.08)
    sigma = math.hypot(world_file.laser.point_noise_m, world_file.plate.flatness_m)
    assert np.std(lengths) == pytest.approx(sigma, rel=0.15)
    assert abs(np.mean(lengths)) < 4.5 * sigma / 20


def test_a_steep_surface_sends_nothing_back(world: World, arm: Still) -> None:
    aim_at_plate(world, arm, math.radians(58))
    assert np.isfinite(world.beam_lengths_m(np.zeros(1))).all()
    arm.key += 1
    aim_at_plate(world, arm, math.radians(62))
    assert np.isnan(world.beam_lengths_m(np.zeros(1))).all()


def test_the_ball_is_never_faster_than_its_bound(world: World) -> None:
    rng = stream(1, "test")
    reaches = world.ball_reaches_m()
    for _ in range(50):
        joints, step = rng.uniform(-2, 2, 6), rng.standard_normal(6) * 1e-6

        def ball(q: FloatArray) -> FloatArray:
            pose = world.flange_pose(q)
            return pose[:3, :3] @ world.truth.flange_T_probe[:3, 3] + pose[:3, 3]

        moved = np.linalg.norm(ball(joints + step) - ball(joints))
        assert moved <= np.abs(step) @ reaches
