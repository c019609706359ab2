"""Localization of a blade and of a patch, and thinning of stripes, against what users take today."""

from collections.abc import Callable

import numpy as np
import open3d
import small_gicp
from scipy.interpolate import NdBSpline
from scipy.spatial import cKDTree

from benchmarks.harness import Row, medians, peak_mb
from estimation.localization.alignment import align, descent
from estimation.localization.voxels import Voxels
from estimation.surfaces.mesh import TriangleMesh
from estimation.surfaces.shape import Shape
from estimation.transform import FloatArray, Transform, exp_pose, log_pose
from tests.estimation.blade import blade_arrays, patch, points_on

TITLE = "Localization"
WORDS = (
    "From the same start, 4 mm and 1.5 deg off. The blade has 80,000 triangles; its peer is "
    "Open3D's closest points with Gauss-Newton, few points first; the patch's is scipy's "
    "NdBSpline with Newton and Gauss-Newton. Stripes go into voxels of 0.5 mm; the peer is "
    "numpy's transform with small_gicp's voxel grid, and its cost is the number of voxels."
)
STD_M = 3e-5
START = exp_pose(np.array([2e-3, -3e-3, 1e-3, 0.02, -0.01, 0.015]))


def rows() -> list[Row]:
    """Each task."""
    out = []
    for count, goal, repeat in ((2_304, None, 9), (100_000, 5.0, 5), (1_000_000, None, 1)):
        out.append(mesh_localization(count, goal, repeat))
        print(out[-1], flush=True)
    for task in (patch_localization, stripe_thinning):
        out.append(task())
        print(out[-1], flush=True)
    return out


def mesh_localization(count: int, goal: float | None, repeat: int) -> Row:
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

    return _row(f"mesh, {count:,} points", "Open3D, Gauss-Newton", goal, ours, peer, repeat, mesh, points)


def patch_localization(count: int = 2304, repeat: int = 9) -> Row:
    """Points on a B-spline patch against scipy's NdBSpline with Newton's method and Gauss-Newton."""
    surface = patch()
    rng = np.random.default_rng(2)
    points = surface.points(rng.uniform(0, 1, (count, 2))) + STD_M * rng.normal(size=(count, 3))
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

    return _row(
        f"B-spline, {count:,} points",
        "scipy NdBSpline, Gauss-Newton",
        10.0,
        ours,
        peer,
        repeat,
        surface,
        points,
    )


def stripe_thinning(stripes: int = 8_000, repeat: int = 3) -> Row:
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
        thinned = small_gicp.voxelgrid_sampling(turned.reshape(-1, 3), 5e-4, num_threads=1)
        return len(thinned.points())

    peer_s, ours_s = medians(peer, ours, repeat=repeat)
    return Row(
        f"stripes, {stripes * 640:,} points",
        "numpy and small_gicp",
        4.0,
        peer_s,
        ours_s,
        peak_mb(peer),
        peak_mb(ours),
        cost_excess=ours() / peer() - 1.0,
    )


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


def _row(
    task: str,
    name: str,
    goal: float | None,
    ours: Callable[[], FloatArray],
    peer: Callable[[], FloatArray],
    repeat: int,
    shape: Shape,
    points: FloatArray,
) -> Row:
    peer_s, ours_s = medians(peer, ours, repeat=repeat)
    weight, own = np.full(len(points), 1.0 / STD_M), ours()
    tight = descent(shape, points, weight, own, tolerance=1e-9)
    std = np.sqrt(np.diag(np.linalg.inv(tight.sums.information)))
    costs = [shape.sums(points, weight, pose, shape.new_hints(len(points))).cost for pose in (own, peer())]
    return Row(
        task,
        name,
        goal,
        peer_s,
        ours_s,
        peak_mb(peer),
        peak_mb(ours),
        float(np.max(np.abs(log_pose(np.linalg.inv(tight.pose) @ own)) / std)),
        costs[0] / costs[1] - 1.0,
        float(np.max(np.abs(log_pose(own)) / std)),  # the points were made where they are
    )
