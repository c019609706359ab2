"""Points on three sides of a cube, measured again and again with noise."""

from dataclasses import dataclass

import numpy as np

from estimation.transform import FloatArray, Transform


@dataclass(frozen=True)
class CubePlan:
    """Replicas (k, n, 3) of points on planes normal . p = offset of a cube, its true pose, their weights."""

    base_p: FloatArray
    normals: FloatArray
    offsets_m: FloatArray
    weights: FloatArray
    base_T_cube: Transform


def cube_plan(replicas: int, count: int = 26, sigma_m: float = 3e-5, seed: int = 5) -> CubePlan:
    """Points anywhere on three sides of 100 mm that meet in a corner, as many on each as can be."""
    rng = np.random.default_rng(seed)
    face = np.arange(count) % 3
    normals, cube_p = np.eye(3)[face], rng.uniform(0.0, 0.1, (count, 3))
    cube_p[np.arange(count), face] = 0.1
    pose = Transform.from_xyz_rpy("base", "cube", np.array([0.3, -0.05, 0.25]), np.array([0.1, -0.2, 0.3]))
    noisy = pose.points(cube_p) + sigma_m * rng.normal(size=(replicas, count, 3))
    return CubePlan(noisy, normals, np.full(count, 0.1), np.full(count, sigma_m**-2.0), pose)
