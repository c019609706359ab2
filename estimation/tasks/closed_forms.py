"""Hand-eye and robot-world calibration in closed form, by the names under which they are known.

A X = X B has moves of the flange in A and of the sensor in B; A X = Y B has poses in both. All are (n, 4, 4),
metres. None of these weighs its data or says how good it is: they are starts, and they let others compare.
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.tasks.starts import nearest_rotation
from estimation.transform import FloatArray, skew

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


def every_pair(count: int) -> Pairs:
    """First and second index of all pairs of `count` poses."""
    first, second = np.triu_indices(count, 1)
    return first, second


def consecutive(count: int) -> Pairs:
    """First and second index of each pose and the next."""
    return np.arange(count - 1), np.arange(1, count)


def moves(poses: FloatArray, pairs: Pairs) -> FloatArray:
    """first_T_second (n, 4, 4) of poses world_T_body (k, 4, 4)."""
    return inverse(poses[pairs[0]]) @ poses[pairs[1]]


def inverse(poses: FloatArray) -> FloatArray:
    """Inverses of poses (..., 4, 4)."""
    back = np.zeros(poses.shape)
    back[..., :3, :3] = poses[..., :3, :3].swapaxes(-1, -2)
    back[..., :3, 3] = -np.einsum("...ji,...j->...i", poses[..., :3, :3], poses[..., :3, 3])
    back[..., 3, 3] = 1.0
    return back


def tsai_lenz(a: FloatArray, b: FloatArray) -> FloatArray:
    """X (4, 4) of A X = X B: rotation from modified Rodrigues vectors, then translation.

    Source: R. Tsai, R. Lenz, A new technique for fully autonomous and efficient 3D robotics hand/eye
    calibration, IEEE Trans. Robotics and Automation 5 (1989), eq. (12), (14), (15).
    """
    p_a, p_b = 2.0 * _quaternions(a)[:, 1:], 2.0 * _quaternions(b)[:, 1:]
    half = _least_squares(skew(p_a + p_b), p_b - p_a)
    p = 2.0 * half / np.sqrt(1.0 + half @ half)
    rotation = (1.0 - p @ p / 2.0) * np.eye(3)
    rotation += 0.5 * (np.outer(p, p) + np.sqrt(np.maximum(4.0 - p @ p, 0.0)) * skew(p))
    return _with_translation(a, b, nearest_rotation(rotation))


def park_martin(a: FloatArray, b: FloatArray) -> FloatArray:
    """X (4, 4) of A X = X B: the rotation that takes rotation vectors of B to those of A.

    Source: F. Park, B. Martin, Robot sensor calibration: solving AX = XB on the Euclidean group, IEEE
    Trans. Robotics and Automation 10 (1994); by singular values, so that two moves are enough.
    """
    turned = Rotation.from_matrix(a[:, :3, :3]).as_rotvec().T @ Rotation.from_matrix(b[:, :3, :3]).as_rotvec()
    return _with_translation(a, b, nearest_rotation(turned))


def daniilidis(a: FloatArray, b: FloatArray) -> FloatArray:
    """X (4, 4) of A X = X B: rotation and translation together, as a dual quaternion.

    Source: K. Daniilidis, Hand-eye calibration using dual quaternions, Int. J. Robotics Research 18 (1999),
    eq. (31) to (35).
    """
    vectors = np.array([0.0, 1.0, 1.0, 1.0])  # scalar parts of A and B are equal, and cancel
    real = _left(_quaternions(a) * vectors) - _right(_quaternions(b) * vectors)
    dual = _left(_dual(a) * vectors) - _right(_dual(b) * vectors)
    nothing = np.zeros_like(real)
    rows = np.block([[real[:, 1:], nothing[:, 1:]], [dual[:, 1:], real[:, 1:]]])
    basis = np.linalg.svd(rows.reshape(-1, 8), full_matrices=False)[2][-2:]
    turn, shift = basis[:, :4], basis[:, 4:]
    # Of the plane that is left, the two directions in which dual and real part are square to each other ...
    size, axes = np.linalg.eigh(turn @ shift.T + shift @ turn.T)
    root = np.sqrt(np.abs(size))
    candidates = np.array([axes @ [root[1], root[0]], axes @ [root[1], -root[0]]])
    # ... one of which has no real part.
    length = np.linalg.norm(candidates @ turn, axis=1)
    best = int(np.argmax(length / np.maximum(np.linalg.norm(candidates, axis=1), 1e-300)))
    weights = candidates[best] / max(length[best], 1e-300)
    q, q_dual = weights @ turn, weights @ shift
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_quat(q, scalar_first=True).as_matrix()
    mount[:3, 3] = 2.0 * (_right(q * [1.0, -1.0, -1.0, -1.0]) @ q_dual)[1:]
    return mount


def dornaika_horaud(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X and Y (4, 4) of A X = Y B: both rotations as quaternions at once, then both translations.

    Source: F. Dornaika, R. Horaud, Simultaneous robot-world and hand-eye calibration, IEEE Trans. Robotics
    and Automation 14 (1998), section III. Signs of quaternions are those of turns from the first pose.
    """
    from_first = (np.zeros(len(a), dtype=np.intp), np.arange(len(a)))
    q_a = _quaternions(moves(a, from_first)) @ _left(_quaternions(a[:1]))[0].T
    q_b = _quaternions(moves(b, from_first)) @ _left(_quaternions(b[:1]))[0].T
    u, _, v = np.linalg.svd(np.einsum("nij,nik->jk", _left(q_a), _right(q_b)))
    rotation_x = Rotation.from_quat(u[:, 0], scalar_first=True).as_matrix()
    return _with_translations(a, b, rotation_x, Rotation.from_quat(v[0], scalar_first=True).as_matrix())


def shah(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X and Y (4, 4) of A X = Y B by Kronecker products, which have no signs to choose.

    Source: M. Shah, Solving the robot-world/hand-eye calibration problem using the Kronecker product,
    ASME J. Mechanisms Robotics 5 (2013), eq. (18) to (24).
    """
    product = np.einsum("nij,nkl->ikjl", b[:, :3, :3], a[:, :3, :3]).reshape(9, 9)
    u, _, v = np.linalg.svd(product)
    x, y = v[0].reshape(3, 3).T, u[:, 0].reshape(3, 3).T
    sign = 1.0 if np.linalg.det(x) > 0.0 else -1.0
    return _with_translations(a, b, nearest_rotation(sign * x), nearest_rotation(sign * y))


AX_XB: Final[Mapping[str, Callable[[FloatArray, FloatArray], FloatArray]]] = {
    "park-martin": park_martin,
    "tsai-lenz": tsai_lenz,
    "daniilidis": daniilidis,
}
AX_YB: Final[Mapping[str, Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]]] = {
    "shah": shah,
    "dornaika-horaud": dornaika_horaud,
}


def _with_translation(a: FloatArray, b: FloatArray, rotation: FloatArray) -> FloatArray:
    """R_A t_X + t_A = R_X t_B + t_X."""
    return _pose(rotation, _least_squares(a[:, :3, :3] - np.eye(3), b[:, :3, 3] @ rotation.T - a[:, :3, 3]))


def _with_translations(
    a: FloatArray, b: FloatArray, rotation_x: FloatArray, rotation_y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """R_A t_X + t_A = R_Y t_B + t_Y."""
    design = np.concatenate([a[:, :3, :3], np.broadcast_to(-np.eye(3), (len(a), 3, 3))], axis=2)
    origins = _least_squares(design, b[:, :3, 3] @ rotation_y.T - a[:, :3, 3])
    return _pose(rotation_x, origins[:3]), _pose(rotation_y, origins[3:])


def _least_squares(design: FloatArray, target: FloatArray) -> FloatArray:
    """(u,) from equations (n, 3, u), (n, 3)."""
    return np.asarray(np.linalg.lstsq(design.reshape(-1, design.shape[2]), target.reshape(-1))[0])


def _pose(rotation: FloatArray, origin: FloatArray) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, origin
    return pose


def _quaternions(poses: FloatArray) -> FloatArray:
    """(n, 4), scalar first and not negative."""
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    return np.asarray(rotation.as_quat(canonical=True, scalar_first=True))


def _dual(poses: FloatArray) -> FloatArray:
    """Dual parts (n, 4): half the translation times the quaternion."""
    origin = np.column_stack([np.zeros(len(poses)), poses[:, :3, 3]])
    return np.asarray(0.5 * np.einsum("nij,nj->ni", _left(origin), _quaternions(poses)))


def _left(q: FloatArray) -> FloatArray:
    """Matrices (..., 4, 4) with _left(q) p = q p."""
    return _product(q, 1.0)


def _right(q: FloatArray) -> FloatArray:
    """Matrices (..., 4, 4) with _right(q) p = p q."""
    return _product(q, -1.0)


def _product(q: FloatArray, side: float) -> FloatArray:
    matrix = np.empty((*q.shape[:-1], 4, 4))
    matrix[..., 0, 0] = q[..., 0]
    matrix[..., 0, 1:], matrix[..., 1:, 0] = -q[..., 1:], q[..., 1:]
    matrix[..., 1:, 1:] = q[..., :1, None] * np.eye(3) + side * skew(q[..., 1:])
    return matrix
