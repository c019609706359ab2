"""Random cells for each task: where sensor and object are, and what honest devices report of them.

The geometry here is of its own: matrices, rays and intersections, nothing of the estimator under test.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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
from tests.estimation.tasks.layout import (
    MM,
    POSE_STD,
    RADIUS_M,
    USUAL,
    FloatArray,
    Setting,
    anywhere,
    block_faces,
    board_views,
    face_views,
    placed,
    plate_views,
    reported,
    sphere_views,
    turns,
)

RANGE_STD_M = 0.03 * MM
PROFILE_STD_M = (0.02 * MM, 0.03 * MM)
TOUCH_STD_M = 0.01 * MM
CAMERA_STD_M = np.array([0.03, 0.03, 0.1]) * MM
TRACKER_STD_M, TRACKER_STD_RAD = 0.01 * MM, 2e-6
BALL_M = 2 * MM
BOARD_M = 0.12


@dataclass(frozen=True)
class Cell:
    """A problem, and the truth about it: value of each block that the problem leaves flat."""

    problem: Any
    truth: dict[str, FloatArray]


def board(setting: Setting) -> FloatArray:
    """Seven markers in no symmetric order, not in a plane; or on a line."""
    if setting.line:
        return np.outer(np.linspace(-1.0, 1.0, 7), [0.06, 0.03, 0.0])
    xy = np.array([[-1, -1], [0.9, -0.8], [1, 0.7], [-0.6, 1], [0.1, 0.05], [-0.2, 0.6], [0.5, -0.3]])
    return np.column_stack([xy * BOARD_M / 2, np.array([0, 10, 0, 5, 20, 0, 15]) * MM])


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


def point_laser_plane(rng: np.random.Generator, count: int = 30, setting: Setting = USUAL) -> Cell:
    views = plate_views(rng, setting, count)
    motion, truth, views, _ = placed(rng, setting, views, ("laser", "plane"))
    reading = to_plane(views[:, :3, 3], views[:, :3, 2], np.zeros(3), np.array([0.0, 0.0, 1.0]))
    reading = reading + rng.normal(size=len(views)) * RANGE_STD_M
    return Cell(PointLaserOnPlane(motion=motion, reading_m=reading, std_m=RANGE_STD_M), truth)


def point_laser_sphere(
    rng: np.random.Generator, count: int = 30, known: bool = True, setting: Setting = USUAL
) -> Cell:
    views = sphere_views(rng, setting, count)
    motion, truth, views, _ = placed(rng, setting, views, ("laser", "sphere"))
    reading = to_sphere(views[:, :3, 3], views[:, :3, 2]) + rng.normal(size=len(views)) * RANGE_STD_M
    radius = RADIUS_M if known else None
    problem = PointLaserOnSphere(motion=motion, reading_m=reading, std_m=RANGE_STD_M, radius_m=radius)
    return Cell(problem, truth if known else {**truth, "sphere.radius": np.array([RADIUS_M])})


def point_laser_planes(rng: np.random.Generator, count: int = 32, setting: Setting = USUAL) -> Cell:
    views, face = face_views(rng, setting, count)
    motion, truth, views, kept = placed(rng, setting, views, ("laser", "part"))
    faces, face = block_faces(), face[kept]
    point, normal = np.array([f.point_m for f in faces])[face], np.array([f.axis for f in faces])[face]
    reading = to_plane(views[:, :3, 3], views[:, :3, 2], point, normal)
    problem = PointLaserOnPlanes(
        motion=motion,
        reading_m=reading + rng.normal(size=len(views)) * RANGE_STD_M,
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


def profile_laser_plane(rng: np.random.Generator, count: int = 14, setting: Setting = USUAL) -> Cell:
    views = plate_views(rng, setting, count)
    motion, truth, views, _ = placed(rng, setting, views, ("profile", "plane"))
    points, index = profiles(rng, views, np.linspace(-15 * MM, 15 * MM, 11), sphere=False)
    problem = ProfileLaserOnPlane(motion=motion, profile_m=points, pose_index=index, std_m=PROFILE_STD_M)
    return Cell(problem, truth)


def profile_laser_sphere(
    rng: np.random.Generator, count: int = 14, known: bool = True, setting: Setting = USUAL
) -> Cell:
    views = sphere_views(rng, setting, count)
    motion, truth, views, _ = placed(rng, setting, views, ("profile", "sphere"))
    points, index = profiles(rng, views, np.linspace(-10 * MM, 10 * MM, 11), sphere=True)
    problem = ProfileLaserOnSphere(
        motion=motion,
        profile_m=points,
        pose_index=index,
        std_m=PROFILE_STD_M,
        radius_m=RADIUS_M if known else None,
    )
    return Cell(problem, truth if known else {**truth, "sphere.radius": np.array([RADIUS_M])})


def touch_sphere(rng: np.random.Generator, count: int = 24, setting: Setting = USUAL) -> Cell:
    views = np.tile(np.eye(4), (count, 1, 1))
    side = Rotation.from_euler("ZY", np.column_stack(turns(rng, count, 80.0)[1::-1])).as_matrix()[:, :, 2]
    tilt, azimuth, spin = turns(rng, count, 40.0)
    views[:, :3, :3] = Rotation.from_euler("ZYZ", np.column_stack([azimuth, tilt, spin])).as_matrix()
    if setting.turn is not None:
        views[:, :3, :3] = setting.turn(rng, views[0, :3, :3], count)
    scatter = rng.normal(size=count) * TOUCH_STD_M
    views[:, :3, 3] = side * (RADIUS_M + BALL_M + scatter)[:, None]
    motion, truth, _, _ = placed(rng, setting, views, ("probe", "sphere"))
    problem = TouchOnSphere(motion=motion, std_m=TOUCH_STD_M, ball_radius_m=BALL_M, radius_m=RADIUS_M)
    return Cell(problem, truth)


def touch_planes(rng: np.random.Generator, count: int = 28, setting: Setting = USUAL) -> Cell:
    views, face = face_views(rng, setting, count)
    faces = block_faces()
    normal = np.array([f.axis for f in faces])[face]
    height = np.einsum("mi,mi->m", views[:, :3, 3] - np.array([f.point_m for f in faces])[face], normal)
    down = BALL_M + rng.normal(size=count) * TOUCH_STD_M - height
    views[:, :3, 3] += down[:, None] * normal
    motion, truth, _, kept = placed(rng, setting, views, ("probe", "part"))
    problem = TouchOnPlanes(
        motion=motion, std_m=TOUCH_STD_M, ball_radius_m=BALL_M, faces=faces, face_index=face[kept]
    )
    return Cell(problem, truth)


def seen(
    rng: np.random.Generator, views: FloatArray, markers: FloatArray
) -> tuple[FloatArray, NDArray[np.intp], NDArray[np.intp]]:
    """Points in the camera, the view and the marker of each; the camera misses one in five."""
    camera_T_object = np.linalg.inv(views)
    points = np.einsum("kij,nj->kni", camera_T_object[:, :3, :3], markers) + camera_T_object[:, None, :3, 3]
    kept = rng.random(points.shape[:2]) < 0.8
    index, marker = np.nonzero(kept)
    return points[kept] + rng.normal(size=(len(index), 3)) * CAMERA_STD_M, index, marker


def camera_hand_eye(
    rng: np.random.Generator, count: int = 12, known: bool = True, setting: Setting = USUAL
) -> Cell:
    views, markers = board_views(rng, setting, count), board(setting)
    if setting.flat or setting.arm:
        motion, truth, views, _ = placed(rng, setting, views, ("camera", "object"))
        points, index, marker = seen(rng, views, markers)
    else:
        points, index, marker = seen(rng, views, markers)
        motion, truth, _, _ = placed(rng, setting, views, ("camera", "object"))
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


def camera_eye_to_hand(rng: np.random.Generator, count: int = 12, setting: Setting = USUAL) -> Cell:
    views, markers = board_views(rng, setting, count), board(setting)
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


def tracker(rng: np.random.Generator, count: int = 16, setting: Setting = USUAL) -> Cell:
    """Two reflectors on the flange, a tracker some metres away."""
    flange = np.array([anywhere(rng) for _ in range(count)])
    if setting.turn is not None:
        flange[:, :3, :3] = setting.turn(rng, flange[0, :3, :3], count)
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


class Make(Protocol):
    """Draws a cell of one task."""

    def __call__(self, rng: np.random.Generator, *, count: int = ..., setting: Setting = USUAL) -> Cell: ...


CELLS: dict[str, Make] = {
    "point-laser-plane": point_laser_plane,
    "point-laser-sphere": point_laser_sphere,
    "point-laser-sphere, radius unknown": partial(point_laser_sphere, known=False),
    "point-laser-planes": point_laser_planes,
    "profile-laser-plane": profile_laser_plane,
    "profile-laser-sphere": profile_laser_sphere,
    "profile-laser-sphere, radius unknown": partial(profile_laser_sphere, known=False),
    "touch-sphere": touch_sphere,
    "touch-planes": touch_planes,
    "camera-hand-eye": camera_hand_eye,
    "camera-hand-eye, markers unknown": partial(camera_hand_eye, known=False),
    "camera-eye-to-hand": camera_eye_to_hand,
    "tracker": tracker,
}
