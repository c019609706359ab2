"""Joints at which the twin's laser meets the plate, the bar and the part; inverse kinematics by Newton."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.estimation.twin import (
    DEG,
    LASER,
    LIMITS_RAD,
    PART_M,
    PLATE_M,
    START_RAD,
    TABLE,
    FloatArray,
    bar_pose,
    face_features,
    forward,
    pose,
)


def joints_for(base_T_laser: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Joints (m, 6) whose nominal laser stands at each pose (m, 4, 4), by Newton, and where that worked."""
    goal = base_T_laser @ np.linalg.inv(pose(np.array([*LASER, 0, 0, 0])))
    q = np.tile(START_RAD, (len(goal), 1))
    q[:, 0] = np.arctan2(-goal[:, 1, 3], -goal[:, 0, 3])  # theta1 = 180 deg: at q = 0 the arm reaches to -x

    def error(joints: FloatArray) -> FloatArray:
        gap = np.linalg.inv(forward(TABLE, joints)) @ goal
        return np.concatenate([gap[:, :3, 3], Rotation.from_matrix(gap[:, :3, :3]).as_rotvec()], axis=1)

    for _ in range(20):
        now = error(q)
        steps = np.stack([error(q + 1e-6 * np.eye(6)[j]) - now for j in range(6)], axis=2) / 1e-6
        normal = np.swapaxes(steps, 1, 2) @ steps + 1e-9 * np.eye(6)
        move = -np.linalg.solve(normal, np.einsum("mij,mi->mj", steps, now)[..., None])[..., 0]
        q = q + np.clip(move, -0.5, 0.5)
    return q, (np.abs(error(q)).max(axis=1) < 1e-9) & (np.abs(q) < LIMITS_RAD).all(axis=1)


def aimed(point: FloatArray, normal: FloatArray, range_m: FloatArray, tilt: FloatArray, azimuth: FloatArray,
          spin: FloatArray) -> FloatArray:  # fmt: skip
    """base_T_laser (m, 4, 4): beam onto points (m, 3), off the inward normal by a tilt towards an azimuth."""
    inward = -normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    helper = np.where(np.abs(inward[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    side = np.cross(inward, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    frame = np.stack([np.cross(side, inward), side, inward], axis=2)
    frame[:, :, 0] = np.cross(frame[:, :, 1], inward)
    local = (Rotation.from_euler("ZYZ", np.column_stack([azimuth, tilt, spin]))).as_matrix()
    result = np.tile(np.eye(4), (len(point), 1, 1))
    result[:, :3, :3] = frame @ local
    result[:, :3, 3] = point - range_m[:, None] * result[:, :3, 2]
    return result


@lru_cache
def plate_poses(count: int, most_tilt_deg: float = 28.0, seed: int = 1) -> FloatArray:
    """Joints (count, 6) with the laser on the plate: tilt, azimuth, spin and range at random."""
    rng, found = np.random.default_rng(seed), np.zeros((0, 6))
    while len(found) < count:
        m = count * 3 // 2
        point = np.column_stack([rng.uniform(-0.13, 0.13, (m, 2)), np.zeros(m)]) + PLATE_M
        goals = aimed(
            point,
            np.tile([0.0, 0.0, 1.0], (m, 1)),
            rng.uniform(0.06, 0.11, m),
            most_tilt_deg * DEG * np.sqrt(rng.random(m)),
            rng.uniform(-np.pi, np.pi, m),
            rng.uniform(-np.pi, np.pi, m),
        )
        q, good = joints_for(goals)
        found = np.concatenate([found, q[good]])
    return found[:count]


@lru_cache
def sphere_poses(aside_m: float = 0.006) -> tuple[FloatArray, NDArray[np.intp]]:
    """Joints of 5 orientations x 4 points x 2 spheres (section 12), and which sphere each is on."""
    frames, second = [], []
    up, along = np.array([[0.0, 0.0, 1.0]]), np.array([0.1])
    for which in range(2):
        centre = (bar_pose() @ [0, 0, 0.2 * which, 1])[:3]
        for tilt, azimuth, spin in ((45, 0, 0), (45, 120, 0), (45, 240, 0), (0, 0, 0), (0, 0, 180)):
            angles = [np.array([value * DEG]) for value in (tilt, azimuth, spin)]
            frame = aimed(centre[None], up, along, *angles)[0]
            for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                moved = frame.copy()
                moved[:3, 3] += aside_m * (frame[:3, 0] * x + frame[:3, 1] * y)
                frames.append(moved)
                second.append(which)
    q, good = joints_for(np.array(frames))
    return q[good], np.array(second)[good]


@lru_cache
def part_poses(count: int, seed: int = 2) -> tuple[FloatArray, NDArray[np.intp]]:
    """Joints with the laser on faces of the part that it can reach, at random."""
    rng, features = np.random.default_rng(seed), face_features()
    joints, faces = np.zeros((0, 6)), np.zeros(0, dtype=np.intp)
    while len(joints) < count:
        m = 4 * count
        face = rng.integers(0, 5, m)
        normal = np.array([features[i].axis for i in face])
        point = np.array([features[i].point_m for i in face]) + PART_M
        point = point + rng.uniform(-1, 1, (m, 3)) * [0.04, 0.06, 0.04] * (1 - np.abs(normal))
        tilt, azimuth = 28 * DEG * np.sqrt(rng.random(m)), rng.uniform(-np.pi, np.pi, m)
        goals = aimed(point, normal, rng.uniform(0.06, 0.11, m), tilt, azimuth, rng.uniform(-np.pi, np.pi, m))
        q, good = joints_for(goals)
        joints, faces = np.concatenate([joints, q[good]]), np.concatenate([faces, face[good]])
    return joints[:count], faces[:count]
