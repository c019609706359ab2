"""Where arm, sensor and object stand in a random cell, and from where the sensor looks.

Usual is any mount, any object, and views as people take them; a `Setting` makes them worse on purpose.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.surfaces import Feature, plane
from estimation.tasks.motion import Joints, Motion, Poses
from tests.estimation.twin import LASER, PLATE_M, arm, pose
from tests.estimation.twin_poses import aimed, joints_for

FloatArray = NDArray[np.float64]
MM, DEG = 1e-3, np.pi / 180

POSE_STD = (0.02 * MM, 0.002 * DEG)
JOINT_STD_RAD = 0.0015 * DEG
RADIUS_M = 15 * MM
PLATE_HALF_M = 0.13
_CORNER = np.array([-0.35, 0.35, -0.87])  # a beam that meets all faces of the block
_NEAREST_M = 0.06
_MOST_OF_ARM = 25  # poses; more would be asked for, because an arm does not reach all

# (rng, orientation of the first view (3, 3), count) -> orientations (count, 3, 3) of all views
Turn = Callable[[np.random.Generator, FloatArray, int], FloatArray]


@dataclass(frozen=True)
class Setting:
    """What is special about a cell.

    Attributes
    ----------
    turn : orientations of the sensor as seen from the object.
    faces : of the block that are measured.
    line : the measured spots or markers lie on a line, within 0.1 mm.
    flat : the flange stays in a plane.
    arm : an arm of six joints reports them, instead of poses.
    """

    turn: Turn | None = None
    faces: tuple[int, ...] = (0, 1, 2, 3)
    line: bool = False
    flat: bool = False
    arm: bool = False


USUAL: Final = Setting()


def block_faces() -> tuple[Feature, ...]:
    """A block of 100 x 150 x 100 mm without symmetry: one corner is cut."""
    places = {
        "top": ((0.05, 0.075, 0.1), (0.0, 0.0, 1.0)),
        "front": ((0.05, 0.0, 0.05), (0.0, -1.0, 0.0)),
        "right": ((0.1, 0.075, 0.05), (1.0, 0.0, 0.0)),
        "cut": ((0.01, 0.14, 0.09), (-0.6, 0.48, 0.64)),
        "left": ((0.0, 0.075, 0.05), (-1.0, 0.0, 0.0)),
    }
    return tuple(plane(name, np.array(at), np.array(normal)) for name, (at, normal) in places.items())


def anywhere(rng: np.random.Generator, within_m: float = 0.5) -> FloatArray:
    """A pose (4, 4) of any rotation, its origin within a ball."""
    direction = rng.normal(size=3)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    matrix[:3, 3] = within_m * rng.random() ** (1 / 3) * direction / np.linalg.norm(direction)
    return matrix


def reported(rng: np.random.Generator, poses: FloatArray) -> FloatArray:
    """Poses as a controller says them."""
    return poses @ pose(rng.normal(size=(len(poses), 6)) * np.repeat(POSE_STD, 3))


def placed(
    rng: np.random.Generator, setting: Setting, object_T_sensor: FloatArray, names: tuple[str, str]
) -> tuple[Motion, dict[str, FloatArray], FloatArray, NDArray[np.intp]]:
    """An arm that carries the sensor so.

    Returns the motion, where sensor and object truly are, the views (k, 4, 4) that are left, and which of
    those that were asked for they are (k,): an arm does not reach all, and a flange in a plane moves them.
    """
    views, kept = object_T_sensor, np.arange(len(object_T_sensor))
    if setting.arm:
        mount, holder = pose(np.array([*LASER, 0.0, 0.0, 0.0])), np.eye(4)
        holder[:3, :3] = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
        holder[:3, 3] = PLATE_M
        joints, reached = joints_for(holder @ views)
        kept = np.flatnonzero(reached)[:_MOST_OF_ARM]
        motion: Motion = Joints(
            arm(), joints[kept] + rng.normal(size=(len(kept), 6)) * JOINT_STD_RAD, std_rad=JOINT_STD_RAD
        )
        return motion, dict(zip(names, (mount, holder), strict=True)), views[kept], kept
    mount, holder = anywhere(rng, 0.05 if setting.flat else 0.5), anywhere(rng)
    if setting.flat:
        views = _in_plane(views, np.linalg.inv(mount)[:3, 3])
    motion = Poses(reported(rng, holder @ views @ np.linalg.inv(mount)), *POSE_STD)
    return motion, dict(zip(names, (mount, holder), strict=True)), views, kept


def _in_plane(views: FloatArray, flange_p: FloatArray) -> FloatArray:
    """Views (k, 4, 4), drawn back along their beams until a point of the sensor's frame is in one plane."""
    normal = -views[:, :3, 2].mean(axis=0)
    normal /= np.linalg.norm(normal)
    height = (views[:, :3, :3] @ flange_p + views[:, :3, 3]) @ normal
    back = (height.max() - height) / -(views[:, :3, 2] @ normal)
    views = views.copy()
    views[:, :3, 3] -= back[:, None] * views[:, :3, 2]
    return views


def turns(rng: np.random.Generator, count: int, tilt_deg: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tilt, azimuth and spin."""
    tilt = tilt_deg * DEG * np.sqrt(rng.random(count))
    return tilt, rng.uniform(-np.pi, np.pi, count), rng.uniform(-np.pi, np.pi, count)


def plate_views(rng: np.random.Generator, setting: Setting, count: int, tilt_deg: float = 35.0) -> FloatArray:
    """plane_T_laser (count, 4, 4), aimed at the plane z = 0."""
    spot = np.column_stack([rng.uniform(-PLATE_HALF_M, PLATE_HALF_M, (count, 2)), np.zeros(count)])
    if setting.line:
        along = np.array([np.cos(turn := rng.uniform(0.0, np.pi)), np.sin(turn), 0.0])
        spot = np.outer(spot @ along, along)
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    range_m = rng.uniform(_NEAREST_M, 0.11, count)
    views = aimed(spot, up, range_m, *turns(rng, count, 28.0 if setting.arm else tilt_deg))
    return turned(rng, setting, views, range_m)


def face_views(rng: np.random.Generator, setting: Setting, count: int) -> tuple[FloatArray, NDArray[np.intp]]:
    """part_T_laser aimed at faces of the block, and at which; each face about equally often."""
    faces = block_faces()
    face = np.array(setting.faces)[rng.permutation(np.arange(count) % len(setting.faces))]
    normal = np.array([faces[i].axis for i in face])
    spread = rng.uniform(-0.04, 0.04, (count, 3))
    spread -= np.einsum("mi,mi->m", spread, normal)[:, None] * normal
    spot = np.array([faces[i].point_m for i in face]) + spread
    range_m, tilts = rng.uniform(_NEAREST_M, 0.11, count), turns(rng, count, 35.0)
    if setting.turn is None and not setting.flat and not setting.arm:
        return aimed(spot, normal, range_m, *tilts), face
    tilt, azimuth, spin = tilts
    views = aimed(spot, np.tile(-_CORNER, (count, 1)), range_m, 0.4 * tilt, azimuth, spin)
    return turned(rng, setting, views, range_m), face


def sphere_views(
    rng: np.random.Generator, setting: Setting, count: int, aside_m: float = 6 * MM
) -> FloatArray:
    """sphere_T_laser (count, 4, 4), aimed past its centre by up to `aside_m`."""
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    range_m = rng.uniform(_NEAREST_M, 0.11, count) + RADIUS_M
    views = aimed(np.zeros((count, 3)), up, range_m, *turns(rng, count, 35.0 if setting.arm else 60.0))
    views = turned(rng, setting, views, range_m)
    aside = aside_m * np.sqrt(rng.random(count)) * np.exp(1j * rng.uniform(-np.pi, np.pi, count))
    views[:, :3, 3] += aside.real[:, None] * views[:, :3, 0] + aside.imag[:, None] * views[:, :3, 1]
    return views


def board_views(
    rng: np.random.Generator,
    setting: Setting,
    count: int,
    tilt_deg: float = 40.0,
    spin_deg: float | None = None,
) -> FloatArray:
    """object_T_camera (count, 4, 4), looking at a board; its image spins by +-`spin_deg`."""
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    centre = np.column_stack([rng.uniform(-0.05, 0.05, (count, 2)), np.zeros(count)])
    range_m = rng.uniform(0.1, 0.2, count) if setting.arm else rng.uniform(0.3, 0.5, count)
    tilt, azimuth, spin = turns(rng, count, 28.0 if setting.arm else tilt_deg)
    if spin_deg is not None:
        spin = spin * spin_deg / 180.0 - azimuth
    return turned(rng, setting, aimed(centre, up, range_m, tilt, azimuth, spin), range_m)


def turned(rng: np.random.Generator, setting: Setting, views: FloatArray, range_m: FloatArray) -> FloatArray:
    """Views (k, 4, 4) with the orientations of the setting; they look at the same spots."""
    if setting.turn is None:
        return views
    spot = views[:, :3, 3] + range_m[:, None] * views[:, :3, 2]
    views = views.copy()
    views[:, :3, :3] = setting.turn(rng, views[0, :3, :3], len(views))
    views[:, :3, 3] = spot - range_m[:, None] * views[:, :3, 2]
    return views
