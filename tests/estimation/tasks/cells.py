"""Random cells for each task: where sensor and object are, and what honest devices report of them.

The geometry here is of its own: matrices, rays and intersections, nothing of the estimator under test.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.surfaces import Feature, plane
from estimation.tasks.camera import CameraEyeToHand, CameraHandEye, Tracker
from estimation.tasks.laser import (
    PointLaserOnPlane,
    PointLaserOnPlanes,
    PointLaserOnSphere,
    ProfileLaserOnPlane,
    ProfileLaserOnSphere,
)
from estimation.tasks.motion import Poses
from estimation.tasks.probe import TouchOnPlanes, TouchOnSphere
from tests.estimation.twin import pose
from tests.estimation.twin_poses import aimed

FloatArray = NDArray[np.float64]
MM, DEG = 1e-3, np.pi / 180

POSE_STD = (0.02 * MM, 0.002 * DEG)
RANGE_STD_M = 0.03 * MM
PROFILE_STD_M = (0.02 * MM, 0.03 * MM)
TOUCH_STD_M = 0.01 * MM
CAMERA_STD_M = np.array([0.03, 0.03, 0.1]) * MM
TRACKER_STD_M, TRACKER_STD_RAD = 0.01 * MM, 2e-6
RADIUS_M, BALL_M = 15 * MM, 2 * MM
PLATE_M, BOARD_M = 0.13, 0.12


@dataclass(frozen=True)
class Cell:
    """A problem, and the truth about it: value of each block that the problem leaves flat."""

    problem: Any
    truth: dict[str, FloatArray]


def anywhere(rng: np.random.Generator, within_m: float = 0.5) -> FloatArray:
    """A pose (4, 4) of any rotation, its origin within a ball."""
    direction = rng.normal(size=3)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    matrix[:3, 3] = within_m * rng.random() ** (1 / 3) * direction / np.linalg.norm(direction)
    return matrix


def block_faces() -> tuple[Feature, ...]:
    """A block of 100 x 150 x 100 mm without symmetry: one corner is cut."""
    places = {
        "top": ((0.05, 0.075, 0.1), (0.0, 0.0, 1.0)),
        "front": ((0.05, 0.0, 0.05), (0.0, -1.0, 0.0)),
        "right": ((0.1, 0.075, 0.05), (1.0, 0.0, 0.0)),
        "cut": ((0.01, 0.14, 0.09), (-0.6, 0.48, 0.64)),
    }
    return tuple(plane(name, np.array(at), np.array(normal)) for name, (at, normal) in places.items())


def board() -> FloatArray:
    """Seven markers in no symmetric order, not in a plane."""
    xy = np.array([[-1, -1], [0.9, -0.8], [1, 0.7], [-0.6, 1], [0.1, 0.05], [-0.2, 0.6], [0.5, -0.3]])
    return np.column_stack([xy * BOARD_M / 2, np.array([0, 10, 0, 5, 20, 0, 15]) * MM])


def reported(rng: np.random.Generator, poses: FloatArray) -> FloatArray:
    """Poses as a controller says them."""
    return poses @ pose(rng.normal(size=(len(poses), 6)) * np.repeat(POSE_STD, 3))


def moved(
    rng: np.random.Generator, object_T_sensor: FloatArray, names: tuple[str, str]
) -> tuple[Poses, dict[str, FloatArray]]:
    """The motion of an arm that carries the sensor so, and where sensor and object truly are."""
    mount, holder = anywhere(rng), anywhere(rng)
    flange = holder @ object_T_sensor @ np.linalg.inv(mount)
    return Poses(reported(rng, flange), *POSE_STD), dict(zip(names, (mount, holder), strict=True))


def plate_views(rng: np.random.Generator, count: int, tilt_deg: float = 35.0) -> FloatArray:
    """plane_T_laser (count, 4, 4), aimed at the plane z = 0."""
    spot = np.column_stack([rng.uniform(-PLATE_M, PLATE_M, (count, 2)), np.zeros(count)])
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    return aimed(spot, up, rng.uniform(0.06, 0.11, count), *turns(rng, count, tilt_deg))


def turns(rng: np.random.Generator, count: int, tilt_deg: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tilt, azimuth and spin."""
    tilt = tilt_deg * DEG * np.sqrt(rng.random(count))
    return tilt, rng.uniform(-np.pi, np.pi, count), rng.uniform(-np.pi, np.pi, count)


def face_views(rng: np.random.Generator, count: int) -> tuple[FloatArray, NDArray[np.intp]]:
    """part_T_laser aimed at faces of the block, and at which; each face at least twice."""
    faces = block_faces()
    face = rng.permutation(np.arange(count) % len(faces))
    normal = np.array([faces[i].axis for i in face])
    spread = rng.uniform(-0.04, 0.04, (count, 3))
    spread -= np.einsum("mi,mi->m", spread, normal)[:, None] * normal
    spot = np.array([faces[i].point_m for i in face]) + spread
    return aimed(spot, normal, rng.uniform(0.06, 0.11, count), *turns(rng, count, 35.0)), face


def sphere_views(rng: np.random.Generator, count: int, aside_m: float = 6 * MM) -> FloatArray:
    """sphere_T_laser (count, 4, 4), aimed past its centre by up to `aside_m`."""
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    range_m = rng.uniform(0.06, 0.11, count) + RADIUS_M
    views = aimed(np.zeros((count, 3)), up, range_m, *turns(rng, count, 60.0))
    aside = aside_m * np.sqrt(rng.random(count)) * np.exp(1j * rng.uniform(-np.pi, np.pi, count))
    views[:, :3, 3] += aside.real[:, None] * views[:, :3, 0] + aside.imag[:, None] * views[:, :3, 1]
    return views


def to_plane(origin: FloatArray, beam: FloatArray, point: FloatArray, normal: FloatArray) -> FloatArray:
    """Distances (...,) along beams to a plane."""
    height = np.einsum("...i,...i->...", point - origin, normal)
    return np.asarray(height / np.einsum("...i,...i->...", beam, normal))


def to_sphere(origin: FloatArray, beam: FloatArray) -> FloatArray:
    """Distances (...,) along beams to the sphere about the origin; NaN where they miss it."""
    along = -np.einsum("...i,...i->...", origin, beam)
    miss = np.einsum("...i,...i->...", origin, origin) - along**2
    with np.errstate(invalid="ignore"):
        return np.asarray(along - np.sqrt(RADIUS_M**2 - miss))


def point_laser_plane(rng: np.random.Generator, count: int = 30) -> Cell:
    views = plate_views(rng, count)
    reading = to_plane(views[:, :3, 3], views[:, :3, 2], np.zeros(3), np.array([0.0, 0.0, 1.0]))
    motion, truth = moved(rng, views, ("laser", "plane"))
    reading = reading + rng.normal(size=count) * RANGE_STD_M
    return Cell(PointLaserOnPlane(motion=motion, reading_m=reading, std_m=RANGE_STD_M), truth)


def point_laser_sphere(rng: np.random.Generator, count: int = 30, known: bool = True) -> Cell:
    views = sphere_views(rng, count)
    reading = to_sphere(views[:, :3, 3], views[:, :3, 2]) + rng.normal(size=count) * RANGE_STD_M
    motion, truth = moved(rng, views, ("laser", "sphere"))
    radius = RADIUS_M if known else None
    problem = PointLaserOnSphere(motion=motion, reading_m=reading, std_m=RANGE_STD_M, radius_m=radius)
    return Cell(problem, truth if known else {**truth, "sphere.radius": np.array([RADIUS_M])})


def point_laser_planes(rng: np.random.Generator, count: int = 32) -> Cell:
    views, face = face_views(rng, count)
    faces = block_faces()
    point, normal = np.array([f.point_m for f in faces])[face], np.array([f.axis for f in faces])[face]
    reading = to_plane(views[:, :3, 3], views[:, :3, 2], point, normal)
    motion, truth = moved(rng, views, ("laser", "part"))
    problem = PointLaserOnPlanes(
        motion=motion,
        reading_m=reading + rng.normal(size=count) * RANGE_STD_M,
        std_m=RANGE_STD_M,
        faces=faces,
        face_index=face,
    )
    return Cell(problem, truth)


def profiles(
    rng: np.random.Generator, views: FloatArray, across_m: FloatArray, sphere: bool
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Profiles (m, 2) of parallel beams along z, side by side in y; and the view of each point."""
    y = np.broadcast_to(across_m, (len(views), len(across_m)))
    origin = views[:, None, :3, 3] + y[..., None] * views[:, None, :3, 1]
    beam = np.broadcast_to(views[:, None, :3, 2], origin.shape)
    z = to_sphere(origin, beam) if sphere else to_plane(origin, beam, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    hit = np.isfinite(z)
    points = np.column_stack([y[hit], z[hit]])
    index = np.repeat(np.arange(len(views)), hit.sum(axis=1))
    return points + rng.normal(size=points.shape) * PROFILE_STD_M, index


def profile_laser_plane(rng: np.random.Generator, count: int = 14) -> Cell:
    views = plate_views(rng, count)
    points, index = profiles(rng, views, np.linspace(-15 * MM, 15 * MM, 11), sphere=False)
    motion, truth = moved(rng, views, ("profile", "plane"))
    problem = ProfileLaserOnPlane(motion=motion, profile_m=points, pose_index=index, std_m=PROFILE_STD_M)
    return Cell(problem, truth)


def profile_laser_sphere(rng: np.random.Generator, count: int = 14, known: bool = True) -> Cell:
    views = sphere_views(rng, count)
    points, index = profiles(rng, views, np.linspace(-10 * MM, 10 * MM, 11), sphere=True)
    motion, truth = moved(rng, views, ("profile", "sphere"))
    problem = ProfileLaserOnSphere(
        motion=motion,
        profile_m=points,
        pose_index=index,
        std_m=PROFILE_STD_M,
        radius_m=RADIUS_M if known else None,
    )
    return Cell(problem, truth if known else {**truth, "sphere.radius": np.array([RADIUS_M])})


def touch_sphere(rng: np.random.Generator, count: int = 24) -> Cell:
    views = np.tile(np.eye(4), (count, 1, 1))
    side = Rotation.from_euler("ZY", np.column_stack(turns(rng, count, 80.0)[1::-1])).as_matrix()[:, :, 2]
    views[:, :3, :3] = Rotation.from_euler("ZYZ", np.column_stack(_zyz(rng, count))).as_matrix()
    scatter = rng.normal(size=count) * TOUCH_STD_M
    views[:, :3, 3] = side * (RADIUS_M + BALL_M + scatter)[:, None]
    motion, truth = moved(rng, views, ("probe", "sphere"))
    problem = TouchOnSphere(motion=motion, std_m=TOUCH_STD_M, ball_radius_m=BALL_M, radius_m=RADIUS_M)
    return Cell(problem, truth)


def _zyz(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    tilt, azimuth, spin = turns(rng, count, 40.0)
    return azimuth, tilt, spin


def touch_planes(rng: np.random.Generator, count: int = 28) -> Cell:
    views, face = face_views(rng, count)
    faces = block_faces()
    normal = np.array([f.axis for f in faces])[face]
    height = np.einsum("mi,mi->m", views[:, :3, 3] - np.array([f.point_m for f in faces])[face], normal)
    down = BALL_M + rng.normal(size=count) * TOUCH_STD_M - height
    views[:, :3, 3] += down[:, None] * normal
    motion, truth = moved(rng, views, ("probe", "part"))
    problem = TouchOnPlanes(
        motion=motion, std_m=TOUCH_STD_M, ball_radius_m=BALL_M, faces=faces, face_index=face
    )
    return Cell(problem, truth)


def board_views(rng: np.random.Generator, count: int) -> FloatArray:
    """object_T_camera (count, 4, 4), looking at the board."""
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    centre = np.column_stack([rng.uniform(-0.05, 0.05, (count, 2)), np.zeros(count)])
    return aimed(centre, up, rng.uniform(0.3, 0.5, count), *turns(rng, count, 40.0))


def seen(
    rng: np.random.Generator, views: FloatArray, markers: FloatArray
) -> tuple[FloatArray, NDArray[np.intp], NDArray[np.intp]]:
    """Points in the camera, the view and the marker of each; the camera misses one in five."""
    camera_T_object = np.linalg.inv(views)
    points = np.einsum("kij,nj->kni", camera_T_object[:, :3, :3], markers) + camera_T_object[:, None, :3, 3]
    kept = rng.random(points.shape[:2]) < 0.8
    index, marker = np.nonzero(kept)
    return points[kept] + rng.normal(size=(len(index), 3)) * CAMERA_STD_M, index, marker


def camera_hand_eye(rng: np.random.Generator, count: int = 12, known: bool = True) -> Cell:
    views, markers = board_views(rng, count), board()
    points, index, marker = seen(rng, views, markers)
    motion, truth = moved(rng, views, ("camera", "object"))
    problem = CameraHandEye(
        motion=motion,
        points_m=points,
        covariance=np.diag(CAMERA_STD_M**2),
        pose_index=index,
        marker_index=marker,
        markers_m=markers if known else None,
    )
    if known:
        return Cell(problem, truth)
    holder = truth.pop("object")
    return Cell(problem, {**truth, "markers": (markers @ holder[:3, :3].T + holder[:3, 3]).reshape(-1)})


def camera_eye_to_hand(rng: np.random.Generator, count: int = 12) -> Cell:
    views, markers = board_views(rng, count), board()
    points, index, marker = seen(rng, views, markers)
    base_T_camera, flange_T_object = anywhere(rng), anywhere(rng)
    flange = base_T_camera @ np.linalg.inv(views) @ np.linalg.inv(flange_T_object)
    problem = CameraEyeToHand(
        motion=Poses(reported(rng, flange), *POSE_STD),
        points_m=points,
        covariance=np.diag(CAMERA_STD_M**2),
        pose_index=index,
        marker_index=marker,
        markers_m=markers,
    )
    return Cell(problem, {"camera": base_T_camera, "object": flange_T_object})


def tracker(rng: np.random.Generator, count: int = 16) -> Cell:
    """Two reflectors on the flange, a tracker some metres away."""
    flange = np.array([anywhere(rng) for _ in range(count)])
    base_T_tracker, sits = anywhere(rng, 2.5), rng.uniform(-0.08, 0.08, (2, 3))
    points = np.einsum("kij,nj->kni", flange[:, :3, :3], sits) + flange[:, None, :3, 3]
    points = ((points - base_T_tracker[:3, 3]) @ base_T_tracker[:3, :3]).reshape(-1, 3)
    beam = np.cross(rng.normal(size=points.shape) * TRACKER_STD_RAD, points)
    problem = Tracker(
        motion=Poses(reported(rng, flange), *POSE_STD),
        points_m=points + beam + rng.normal(size=points.shape) * TRACKER_STD_M,
        pose_index=np.repeat(np.arange(count), 2),
        marker_index=np.tile([0, 1], count),
        std_m=TRACKER_STD_M,
        angle_std_rad=TRACKER_STD_RAD,
    )
    return Cell(problem, {"tracker": base_T_tracker, "reflectors": sits.reshape(-1)})


Make = Callable[[np.random.Generator], Cell]

CELLS: dict[str, Make] = {
    "point-laser-plane": point_laser_plane,
    "point-laser-sphere": point_laser_sphere,
    "point-laser-sphere, radius unknown": lambda rng: point_laser_sphere(rng, known=False),
    "point-laser-planes": point_laser_planes,
    "profile-laser-plane": profile_laser_plane,
    "profile-laser-sphere": profile_laser_sphere,
    "profile-laser-sphere, radius unknown": lambda rng: profile_laser_sphere(rng, known=False),
    "touch-sphere": touch_sphere,
    "touch-planes": touch_planes,
    "camera-hand-eye": camera_hand_eye,
    "camera-hand-eye, markers unknown": lambda rng: camera_hand_eye(rng, known=False),
    "camera-eye-to-hand": camera_eye_to_hand,
    "tracker": tracker,
}
