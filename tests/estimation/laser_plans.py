"""Poses from which a laser on the flange reads a plane, and readings with noise."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray


@dataclass(frozen=True)
class LaserPlan:
    """Flange poses, readings of replicas (k, n), weights and the truth."""

    rotations: FloatArray
    positions_m: FloatArray
    ranges_m: FloatArray
    weights: FloatArray
    origin_m: FloatArray
    beam: FloatArray
    normal: FloatArray
    offset_m: float


def laser_plan(replicas: int, count: int = 28, sigma_m: float = 3e-5, seed: int = 4) -> LaserPlan:
    """Tilts up to 30 deg in all directions, spins all around, a plate of 0.4 m."""
    rng = np.random.default_rng(seed)
    origin = np.array([0.08, 0.0, 0.06])
    beam = np.array([0.05, -0.03, 1.0]) / np.linalg.norm([0.05, -0.03, 1.0])
    normal = np.array([0.02, 0.03, 1.0]) / np.linalg.norm([0.02, 0.03, 1.0])
    offset = 0.1
    spins, tilts = rng.uniform(-3.0, 3.0, count), rng.uniform(-0.5, 0.5, (count, 2))
    rotations = Rotation.from_euler(
        "zyx", np.column_stack([spins, tilts[:, 0], tilts[:, 1] + np.pi])
    ).as_matrix()
    ranges = rng.uniform(0.06, 0.11, count)
    on_plate = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), np.zeros(count)])
    on_plate += (offset - on_plate @ normal)[:, None] * normal
    positions = on_plate - np.einsum("nij,nj->ni", rotations, origin + ranges[:, None] * beam)
    slope = np.einsum("nij,j,i->n", rotations, beam, normal)
    noisy = ranges + sigma_m * rng.normal(size=(replicas, count))
    return LaserPlan(rotations, positions, noisy, (sigma_m * slope) ** -2, origin, beam, normal, offset)
