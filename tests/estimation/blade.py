"""A small turbine blade without symmetry, as triangles: open at its root and tip."""

import numpy as np

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
