"""Design problems for tests: a box located by points on its faces, with and without shared errors."""

import numpy as np

from estimation.design import DesignProblem
from estimation.transform import FloatArray, skew

SIZE_M = np.array([0.1, 0.15, 0.1])
NORMALS = np.array([[0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]], dtype=np.float64)
ANCHORS = ((2, SIZE_M[2]), (1, 0.0), (1, SIZE_M[1]), (0, 0.0), (0, SIZE_M[0]))


def box_points(random: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (m, 3) on five faces of a box, outward normals (m, 3) and the face (m,)."""
    face = random.integers(0, len(NORMALS), count)
    points = random.uniform(0.0, 1.0, (count, 3)) * SIZE_M
    for index, (axis, value) in enumerate(ANCHORS):
        points[face == index, axis] = value
    return points, NORMALS[face], face


def pose_rows(points: FloatArray, normals: FloatArray) -> FloatArray:
    """n^T [I | -[p]x] (m, 6)."""
    return np.concatenate([normals, np.cross(points, normals)], axis=1)


def corner_targets(states: int) -> FloatArray:
    """Derivatives (8, 3, n) of the corners by the pose, which comes first in the state."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * SIZE_M
    targets = np.zeros((8, 3, states))
    targets[:, :, :3], targets[:, :, 3:6] = np.eye(3), -skew(corners)
    return targets


def box_problem(seed: int, candidates: int = 400, shared: int = 0, judged: bool = True) -> DesignProblem:
    """The pose of the box, with `shared` unknowns that act on every row."""
    random = np.random.default_rng(seed)
    points, normals, _ = box_points(random, candidates)
    rows = np.hstack([pose_rows(points, normals), 0.3 * random.normal(size=(candidates, shared))])
    prior = np.diag([5e-3] * 3 + [0.017] * 3 + [2e-5] * shared) ** 2
    variance = 3e-5**2 * random.uniform(1.0, 2.0, candidates)
    return DesignProblem(prior, rows, variance, corner_targets(6 + shared) if judged else None)


def exact_covariance(problem: DesignProblem, chosen: FloatArray) -> FloatArray:
    """By the plain formula."""
    rows, variance = problem.rows[chosen], problem.variance[chosen]
    return np.asarray(np.linalg.inv(np.linalg.inv(problem.covariance) + rows.T @ (rows / variance[:, None])))
