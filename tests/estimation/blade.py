"""A small turbine blade without symmetry, as triangles: open at its root and tip."""

import numpy as np

from estimation.surfaces.bspline import BSplinePatch
from estimation.surfaces.mesh import TriangleMesh
from estimation.transform import FloatArray


def blade_arrays(along: int, around: int) -> tuple[FloatArray, FloatArray]:
    """Vertices (along * around, 3), metres, and triangles (2 (along - 1) around, 3); 250 mm long."""
    s, u = np.meshgrid(
        np.linspace(0, 1, along), np.linspace(0, 2 * np.pi, around, endpoint=False), indexing="ij"
    )
    x = 0.04 * (1 - 0.4 * s) * np.cos(u)
    y = 0.006 * (1 - 0.5 * s) * np.sin(u) + 0.006 * np.cos(u) ** 2 + 0.001 * np.cos(3 * u)
    twist = 0.6 * s
    vertices = np.stack(
        [
            x * np.cos(twist) - y * np.sin(twist) + 0.01 * s**2,
            x * np.sin(twist) + y * np.cos(twist),
            0.25 * s,
        ],
        axis=-1,
    )
    i, j = np.meshgrid(np.arange(along - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = a + around, b + around
    triangles = np.concatenate(
        [np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    )
    return vertices.reshape(-1, 3), triangles.astype(np.int32)


def blade_mesh(along: int = 60, around: int = 80) -> TriangleMesh:
    return TriangleMesh(*blade_arrays(along, around))


def points_on(mesh: TriangleMesh, count: int, rng: np.random.Generator) -> FloatArray:
    """Points (count, 3) spread over the triangles, as likely on each."""
    chosen = rng.integers(0, len(mesh.triangles), count)
    return np.einsum("mk,mki->mi", rng.dirichlet(np.ones(3), count), mesh.corners_m[chosen])


def patch() -> BSplinePatch:
    """A curved, twisted skin without symmetry, 160 by 100 mm, with two cells of different size along u."""
    knots_u = np.array([0, 0, 0, 0, 0.15, 0.3, 0.6, 0.8, 1, 1, 1, 1.0])
    knots_v = np.array([0, 0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1, 1.0])
    x, y = np.meshgrid(np.linspace(0, 0.16, 8), np.linspace(0, 0.1, 7), indexing="ij")
    z = 0.02 * np.sin(25 * x) + 0.25 * y**2 * np.cos(8 * x) + 1.2 * x * y + 30 * x**2 * y
    return BSplinePatch(knots_u, knots_v, np.stack([x, y, z], axis=-1))


def closed_blade_patch(along: int = 12, around: int = 24) -> BSplinePatch:
    """The blade as one smooth patch, closed around u and open at root and tip."""
    vertices = blade_arrays(along, around)[0].reshape(along, around, 3)
    control = np.concatenate([vertices, vertices[:, :3]], axis=1).swapaxes(0, 1)
    knots_u = np.arange(around + 7.0)
    knots_v = np.concatenate([np.zeros(3), np.linspace(0, 1, along - 2), np.ones(3)])
    return BSplinePatch(knots_u, knots_v, control)
