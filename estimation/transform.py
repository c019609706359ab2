"""Rigid transforms that know their frames: `a_T_b` maps coordinates in b to coordinates in a."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.errors import FrameMismatch

FloatArray = NDArray[np.float64]


def skew(vectors: FloatArray) -> FloatArray:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): skew(a) @ b = a x b."""
    vectors = np.asarray(vectors, dtype=np.float64)
    matrices = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrices[..., 2, 1], matrices[..., 1, 2] = x, -x
    matrices[..., 0, 2], matrices[..., 2, 0] = y, -y
    matrices[..., 1, 0], matrices[..., 0, 1] = z, -z
    return matrices


def exp_pose(xi: FloatArray) -> FloatArray:
    """Matrix (4, 4) of the small motion dH(xi) = (Exp([phi]x), t), xi = [t (m); phi (rad)]."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(xi[3:]).as_matrix()
    matrix[:3, 3] = xi[:3]
    return matrix


def log_pose(matrix: FloatArray) -> FloatArray:
    """The xi (6,) with exp_pose(xi) = matrix; metres, radians."""
    rotation = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    return np.concatenate([matrix[:3, 3], rotation])


@dataclass(frozen=True, slots=True, eq=False)  # == on arrays is ambiguous
class Transform:
    """Maps coordinates in `source` to coordinates in `target`; matrix (4, 4), metres."""

    target: str
    source: str
    matrix: FloatArray

    def __matmul__(self, other: "Transform") -> "Transform":
        """Compose; raises FrameMismatch unless the inner frames are equal."""
        if self.source != other.target:
            raise FrameMismatch(
                f"{self.target}_T_{self.source} @ {other.target}_T_{other.source}",
                f"The right side must be {self.source}_T_...; is one of them inverted?",
            )
        return Transform(self.target, other.source, self.matrix @ other.matrix)

    def inverse(self) -> "Transform":
        """source_T_target."""
        rotation, origin = self.matrix[:3, :3], self.matrix[:3, 3]
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.T
        matrix[:3, 3] = -rotation.T @ origin
        return Transform(self.source, self.target, matrix)

    def points(self, source_p: FloatArray) -> FloatArray:
        """Points (..., 3) in `target`, from points (..., 3) in `source`; metres."""
        return source_p @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def vectors(self, source_v: FloatArray) -> FloatArray:
        """Directions (..., 3) in `target`, from directions (..., 3) in `source`."""
        return source_v @ self.matrix[:3, :3].T

    def perturbed(self, xi: FloatArray) -> "Transform":
        """This transform times dH(xi): a right (body) perturbation, form A of the thesis (76)."""
        return Transform(self.target, self.source, self.matrix @ exp_pose(xi))

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrix (3, 3)."""
        return self.matrix[:3, :3]

    @property
    def origin_m(self) -> FloatArray:
        """Origin of `source` in `target` (3,), metres."""
        return self.matrix[:3, 3]

    @staticmethod
    def from_xyz_rpy(target: str, source: str, xyz_m: FloatArray, rpy_rad: FloatArray) -> "Transform":
        """From an origin and fixed-axis roll, pitch, yaw about x, y, z (REP-103)."""
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("xyz", rpy_rad).as_matrix()
        matrix[:3, 3] = xyz_m
        return Transform(target, source, matrix)
