"""Localization of a blade and thinning of stripes, against what users take today, on the same arrays.

Run with `python -m benchmarks.localization`. Needs the extra `bench`. Two threads for everybody.
"""

import statistics
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import open3d
import small_gicp
from scipy.interpolate import NdBSpline
from scipy.spatial import cKDTree

from estimation.localization.alignment import align, descent
from estimation.localization.voxels import Voxels
from estimation.surfaces.mesh import TriangleMesh
from estimation.transform import FloatArray, Transform, exp_pose
from tests.estimation.blade import blade_arrays, patch, points_on

STD_M = 3e-5
START = exp_pose(np.array([2e-3, -3e-3, 1e-3, 0.02, -0.01, 0.015]))


@dataclass(frozen=True, slots=True)
class Measured:
    """Median seconds and peak memory of the peer and of ours; how far ours is from the peer's optimum."""

    task: str
    peer: str
    peer_s: float
    ours_s: float
    peer_mb: float
    ours_mb: float
    error_sigma: float  # largest freedom of the pose, against the tight solution; NaN where there is none
    cost_excess: float  # of ours over the peer's, relative

    def __str__(self) -> str:
        return (
            f"{self.task}: {self.peer_s / self.ours_s:.1f} times {self.peer} "
            f"({self.peer_s * 1e3:.1f} against "
            f"{self.ours_s * 1e3:.1f} ms; {self.peer_mb:.0f} against {self.ours_mb:.0f} MB; "
            f"{self.error_sigma:.1e} sigma, cost {self.cost_excess:+.1e})"
        )


def mesh_localization(count: int, repeat: int = 5) -> Measured:
    """Points on a blade of 80,000 triangles against Open3D's closest points with Gauss-Newton."""
    vertices, triangles = blade_arrays(200, 200)
    mesh = TriangleMesh(vertices, triangles)
    rng = np.random.default_rng(1)
    points = points_on(mesh, count, rng) + STD_M * rng.normal(size=(count, 3))
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    start = Transform("base", "blade", START)

    def ours() -> FloatArray:
        return align(mesh, points, STD_M, start).base_T_object.matrix

    def peer() -> FloatArray:
        pose = START
        for level, steps in (
            (points[rng.integers(0, count, 400)], 6),
            (points[rng.integers(0, count, 1_500)], 3),
            (points, 3),
        ):
            for _ in range(steps):
                pose = _open3d_step(scene, level, pose)
        return pose

    tight = descent(mesh, points, np.full(count, 1.0 / STD_M), ours(), tolerance=1e-9)
    return _measured(
        f"mesh, {count} points", "Open3D and Gauss-Newton", ours, peer, repeat,
        lambda pose: mesh.sums(points, np.full(count, 1.0 / STD_M), pose, mesh.new_hints(count)).cost,
        tight.pose, np.sqrt(np.diag(np.linalg.inv(tight.sums.information))),
    )  # fmt: skip


def patch_localization(count: int = 2304, repeat: int = 5) -> Measured:
    """Points on a B-spline patch against scipy's NdBSpline with Newton's method and Gauss-Newton."""
    surface = patch()
    rng = np.random.default_rng(2)
    points = surface.points(rng.uniform(0, 1, (count, 2))) + STD_M * rng.normal(size=(count, 3))
    weight = np.full(count, 1.0 / STD_M)
    spline = NdBSpline((surface.knots_u, surface.knots_v), surface.control_m, 3)
    u, v = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40), indexing="ij")
    grid = np.column_stack([u.ravel(), v.ravel()])
    tree = cKDTree(spline(grid))
    start = Transform("base", "skin", START)

    def ours() -> FloatArray:
        return align(surface, points, STD_M, start).base_T_object.matrix

    def peer() -> FloatArray:
        pose, place = START, grid[tree.query((points - START[:3, 3]) @ START[:3, :3])[1]]
        for _ in range(6):
            pose, place, length = _scipy_step(spline, points, pose, place)
            if length < 1e-4:
                break
        return pose

    tight = descent(surface, points, weight, START, tolerance=1e-9)
    return _measured(
        f"B-spline, {count} points", "scipy and Gauss-Newton", ours, peer, repeat,
        lambda pose: surface.sums(points, weight, pose, surface.new_hints(count)).cost,
        tight.pose, np.sqrt(np.diag(np.linalg.inv(tight.sums.information))),
    )  # fmt: skip


def stripe_thinning(stripes: int = 8_000, repeat: int = 3) -> Measured:
    """640 points a stripe into voxels of 0.5 mm, against numpy's transform with small_gicp's voxel grid."""
    rng = np.random.default_rng(3)
    y = np.linspace(-0.03, 0.03, 640)
    z = 0.1 + 0.002 * np.sin(100 * y) + STD_M * rng.normal(size=(stripes, 640))
    yz = np.stack([np.broadcast_to(y, z.shape), z], axis=-1).astype(np.float32)
    poses = np.tile(exp_pose(np.array([0.5, 0.2, 0.3, 0.3, 0.2, 0.1])), (stripes, 1, 1))
    poses[:, 0, 3] += 5e-5 * np.arange(stripes)

    def ours() -> int:
        voxels = Voxels(5e-4)
        for begin in range(0, stripes, 100):
            voxels.add(yz[begin : begin + 100], poses[begin : begin + 100])
        return len(voxels.points[0])

    def peer() -> int:
        turned = np.einsum("kij,knj->kni", poses[:, :3, 1:3], yz) + poses[:, None, :3, 3]
        thinned = small_gicp.voxelgrid_sampling(turned.reshape(-1, 3), 5e-4, num_threads=2)
        return len(thinned.points())

    taken = _medians(ours, peer, repeat)
    return Measured(
        f"stripes, {stripes * 640} points", "numpy and small_gicp", taken[1], taken[0],
        _peak_mb(peer), _peak_mb(ours), float("nan"), ours() / peer() - 1.0,
    )  # fmt: skip


def _open3d_step(
    scene: "open3d.t.geometry.RaycastingScene", points: FloatArray, pose: FloatArray
) -> FloatArray:
    object_p = (points - pose[:3, 3]) @ pose[:3, :3]
    found = scene.compute_closest_points(object_p.astype(np.float32))
    foot, normal = found["points"].numpy().astype(float), found["primitive_normals"].numpy().astype(float)
    distance = np.einsum("mi,mi->m", object_p - foot, normal)
    rows = np.concatenate([normal, np.cross(object_p, normal)], axis=1)
    return np.asarray(pose @ exp_pose(np.linalg.solve(rows.T @ rows, rows.T @ distance)))


def _scipy_step(
    spline: NdBSpline, points: FloatArray, pose: FloatArray, place: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    object_p = (points - pose[:3, 3]) @ pose[:3, :3]
    for _ in range(3):
        away, u, v = spline(place) - object_p, spline(place, nu=(1, 0)), spline(place, nu=(0, 1))
        slope = np.stack([np.sum(away * u, 1), np.sum(away * v, 1)], axis=1)
        bend = [np.sum(away * spline(place, nu=nu), 1) for nu in ((2, 0), (1, 1), (0, 2))]
        a, b, c = np.sum(u * u, 1) + bend[0], np.sum(u * v, 1) + bend[1], np.sum(v * v, 1) + bend[2]
        step = np.stack([c * slope[:, 0] - b * slope[:, 1], a * slope[:, 1] - b * slope[:, 0]], axis=1)
        place = np.clip(place - step / (a * c - b * b)[:, None], 0.0, 1.0)
    normal = np.cross(spline(place, nu=(1, 0)), spline(place, nu=(0, 1)))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.einsum("mi,mi->m", object_p - spline(place), normal)
    rows = np.concatenate([normal, np.cross(object_p, normal)], axis=1)
    information = rows.T @ rows
    move = np.linalg.solve(information, rows.T @ distance)
    return pose @ exp_pose(move), place, float(np.sqrt(move @ information @ move)) / STD_M


def _measured(
    task: str, peer_name: str, ours: Callable[[], FloatArray], peer: Callable[[], FloatArray], repeat: int,
    cost: Callable[[FloatArray], float], tight: FloatArray, std: FloatArray,
) -> Measured:  # fmt: skip
    taken = _medians(ours, peer, repeat)
    gap = np.linalg.inv(tight) @ ours()
    error = np.array([*gap[:3, 3], gap[2, 1], gap[0, 2], gap[1, 0]])
    return Measured(
        task, peer_name, taken[1], taken[0], _peak_mb(peer), _peak_mb(ours),
        float(np.max(np.abs(error) / std)), cost(ours()) / cost(peer()) - 1.0,
    )  # fmt: skip


def _medians(ours: Callable[[], object], peer: Callable[[], object], repeat: int) -> tuple[float, float]:
    taken: tuple[list[float], list[float]] = ([], [])
    for each in (ours, peer):
        each()
    for _ in range(repeat):
        for call, times in zip((ours, peer), taken, strict=True):
            begin = time.perf_counter()
            call()
            times.append(time.perf_counter() - begin)
    return statistics.median(taken[0]), statistics.median(taken[1])


def _peak_mb(call: Callable[[], object]) -> float:
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def measured() -> list[Measured]:
    """All rows, in the order of the page."""
    return [mesh_localization(2_304), mesh_localization(100_000), patch_localization(), stripe_thinning()]


if __name__ == "__main__":
    for row in measured():
        print(row, flush=True)
