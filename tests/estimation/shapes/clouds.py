"""Points on known surfaces, anywhere in space, with noise along every axis."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3) and the truth they came from: a centre, an axis, and radii or a half angle."""

    points_m: FloatArray
    centre_m: FloatArray
    axis: FloatArray
    sizes: tuple[float, ...]


def cloud(
    kind: str,
    seed: int,
    count: int = 60,
    arc_deg: float = 360.0,
    sigma_m: float = 1e-5,
    offset_m: float = 0.3,
) -> Cloud:
    """Points on a surface of the given kind, over `arc_deg` of its circumference."""
    rng = np.random.default_rng(seed)
    turn = np.radians(rng.uniform(0.0, arc_deg, count))
    along = rng.uniform(0.0, 1.0, count)
    sizes: tuple[float, ...] = ()
    if kind == "plane":
        local = np.column_stack([0.1 * along, 0.02 * turn, 0.0 * turn])
    elif kind == "sphere":
        z = 0.9 * along
        local = 0.03 * np.column_stack(
            [np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
        )
        sizes = (0.03,)
    elif kind == "cylinder":
        local = np.column_stack([0.03 * np.cos(turn), 0.03 * np.sin(turn), 0.1 * along - 0.05])
        sizes = (0.03,)
    elif kind == "cone":
        radius = (0.05 + 0.05 * along) * np.tan(0.4)
        local = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), 0.05 + 0.05 * along])
        sizes = (0.4,)
    else:
        tube = 2.0 * np.pi * along
        radius = 0.05 + 0.012 * np.cos(tube)
        local = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), 0.012 * np.sin(tube)])
        sizes = (0.05, 0.012)
    rotation = Rotation.random(random_state=seed).as_matrix()
    centre = rng.uniform(-offset_m, offset_m, 3)
    points = local @ rotation.T + centre + sigma_m * rng.normal(size=(count, 3))
    return Cloud(points, centre, rotation[:, 2], sizes)
