"""Starts for the axes of a positioner: with their directions given, where they are is a linear problem."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.tasks.starts import best, directions, least_squares, rotations
from estimation.transform import FloatArray

_DIRECTIONS: Final = 64  # of each axis; none is farther than 20 deg from one of them
_MOST_ROWS: Final = 120
_TURNS: Final = 8  # Gauss-Newton steps of all rotations of a grid
_FEWEST_ON_FACES, _FEWEST_ON_SPHERE = 6, 4


def axes_from_points(
    angles_rad: FloatArray, base_p: FloatArray, marker: NDArray[np.intp]
) -> tuple[list[list[FloatArray]], list[FloatArray]]:
    """Starts from points of one or more markers on the table.

    Parameters
    ----------
    angles_rad : (m, a) of each point, of the a = 1 or 2 axes that turned, the one that stands first.
    base_p, marker : (m, 3) in the base, and the marker of each, from 0.

    Returns
    -------
    Frames (4, 4) of the axes, z along them, and markers (n, 3) where all angles are zero, of each start.

    Notes
    -----
    A point is (I - R1) c1 + R1 (I - R2) c2 + R1 R2 m: linear in points c of the axes and in the marker.
    """
    rows = np.unique(np.linspace(0, len(base_p) - 1, _MOST_ROWS).astype(np.intp))
    seen, index = base_p[rows].reshape(-1), np.unique(marker[rows], return_inverse=True)[1]
    frames, count = directions(_DIRECTIONS), angles_rad.shape[1]
    turns = [_about(frames[:, :, 2], angles_rad[rows, axis]) for axis in range(count)]  # (g, m, 3, 3)
    costs, solutions = [], []
    for parts, lead in _moved(turns):
        own = np.zeros((*lead.shape[:3], index.max() + 1, 3))
        own[:, np.arange(len(rows)), :, index] = lead.swapaxes(0, 1)
        design = np.concatenate([*parts, own.reshape(*lead.shape[:3], -1)], axis=3)
        design = design.reshape(len(lead), len(seen), -1)
        solution = least_squares(design, np.broadcast_to(seen, design.shape[:2]))
        costs.append(np.linalg.norm(np.einsum("gmu,gu->gm", design, solution) - seen, axis=1))
        solutions.append(solution[:, : 3 * count].reshape(-1, count, 3))
    directed = np.indices((_DIRECTIONS,) * count).reshape(count, -1)  # of each solution, in the same order
    places = best(np.concatenate(costs), *frames[directed])
    points = np.concatenate(solutions)[places]
    axes = [
        [_line(frames[one], point) for one, point in zip(directed[:, place], own, strict=True)]
        for place, own in zip(places, points, strict=True)
    ]
    return axes, [_markers(each, angles_rad, base_p, marker) for each in axes]


def _moved(turns: list[FloatArray]) -> Iterator[tuple[list[FloatArray], FloatArray]]:
    """Factors of the points of the axes and of the marker (g, m, 3, 3)."""
    if len(turns) == 1:
        yield [np.eye(3) - turns[0]], turns[0]
        return
    for first in turns[0]:
        lead = first @ turns[1]
        yield [np.broadcast_to(np.eye(3) - first, lead.shape), first - lead], lead


def pose_on_table(axes: list[FloatArray], angles_rad: FloatArray) -> FloatArray:
    """base_T_table (m, 4, 4) at angles (m, a), of axes given by their frames (4, 4)."""
    pose = np.broadcast_to(np.eye(4), (len(angles_rad), 4, 4))
    for axis, frame in enumerate(axes):
        turn = np.zeros((len(angles_rad), 4, 4))
        turn[:, :3, :3] = _about(frame[None, :3, 2], angles_rad[:, axis])[0]
        turn[:, :3, 3] = frame[:3, 3] - turn[:, :3, :3] @ frame[:3, 3]
        turn[:, 3, 3] = 1.0
        pose = pose @ turn
    return np.asarray(pose)


def spheres(base_p: FloatArray, index: NDArray[np.intp], count: int) -> tuple[NDArray[np.intp], FloatArray]:
    """Where a sphere was, from the points of each pose alone.

    base_p (m, 3) at the poses index (m,) of `count`. Returns the poses (k,) that have points enough, and the
    centres there (k, 3).
    """
    taken = np.bincount(index, minlength=count)
    middle = np.zeros((count, 3))
    np.add.at(middle, index, base_p)
    middle /= np.maximum(taken, 1)[:, None]
    centred = base_p - middle[index]
    design = np.column_stack([2.0 * centred, np.ones(len(base_p))])
    normal, right = np.zeros((count, 4, 4)), np.zeros((count, 4))
    np.add.at(normal, index, design[:, :, None] * design[:, None, :])
    np.add.at(right, index, design * np.sum(centred**2, axis=1)[:, None])
    enough = np.flatnonzero(taken >= _FEWEST_ON_SPHERE)
    solution = np.einsum("kij,kj->ki", np.linalg.pinv(normal[enough], hermitian=True), right[enough])
    return enough, middle[enough] + solution[:, :3]


def objects(
    base_p: FloatArray, index: NDArray[np.intp], count: int, normal: FloatArray, offset_m: FloatArray
) -> tuple[NDArray[np.intp], FloatArray]:
    """Where an object with plane faces was, from the points of each pose alone: as `spheres`, with poses.

    normal . p = offset (m, 3), (m,) in the object is the plane of each point.
    """
    taken = np.bincount(index, minlength=count)
    enough = [
        pose
        for pose in np.flatnonzero(taken >= _FEWEST_ON_FACES)
        if np.linalg.matrix_rank(normal[index == pose], tol=0.1) == 3
    ]
    found = [
        _placed(base_p[index == pose], normal[index == pose], offset_m[index == pose]) for pose in enough
    ]
    return np.array(enough, dtype=np.intp), np.array(found).reshape(-1, 4, 4)


def _placed(base_p: FloatArray, normal: FloatArray, offset_m: FloatArray) -> FloatArray:
    """Object pose (4, 4) with the smallest distances, of Gauss-Newton from a grid of rotations."""
    turn = rotations()
    origin = np.broadcast_to(base_p.mean(axis=0), (len(turn), 3))
    for step in range(_TURNS + 1):
        seen = (base_p - origin[:, None]) @ turn
        residual = np.einsum("gmi,mi->gm", seen, normal) - offset_m
        if step == _TURNS:
            break
        across = np.cross(normal, seen)
        by_origin = np.broadcast_to(-normal, seen.shape)  # in axes of the object
        change = least_squares(np.concatenate([by_origin, across], axis=2), -residual)
        origin = origin + np.einsum("gij,gj->gi", turn, change[:, :3])
        turn = turn @ Rotation.from_rotvec(change[:, 3:]).as_matrix()
    best_one = int(np.argmin(np.sum(residual**2, axis=1)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn[best_one], origin[best_one]
    return pose


def _about(axes: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Rotations (g, m, 3, 3) about unit axes (g, 3) by angles (m,)."""
    turn = axes[:, None, :] * angle_rad[None, :, None]
    return Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(len(axes), len(angle_rad), 3, 3)


def _line(rotation: FloatArray, point: FloatArray) -> FloatArray:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, point
    return frame


def _markers(
    axes: list[FloatArray], angles_rad: FloatArray, base_p: FloatArray, marker: NDArray[np.intp]
) -> FloatArray:
    """(n, 3) means of where each was seen, with the table turned back."""
    pose = pose_on_table(axes, angles_rad)
    table_p = np.einsum("mji,mj->mi", pose[:, :3, :3], base_p - pose[:, :3, 3])
    taken = np.maximum(np.bincount(marker), 1)
    return np.column_stack([np.bincount(marker, table_p[:, i]) / taken for i in range(3)])
