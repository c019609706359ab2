"""Stripes of a profile sensor, thinned to one mean point a voxel as they come."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.errors import EstimationError
from estimation.transform import FloatArray

try:
    from estimation.localization import voxel_kernels as kernels
except ImportError:  # numba is optional: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

COMPILED: Final = kernels is not None
_HALF: Final = 1 << 20  # voxels on each side of the base, along each axis
_FIRST_CELLS: Final = 1 << 16


class Voxels:
    """Means of all points that fell into each cube of a grid in the base.

    The memory grows with the measured surface, not with the number of points on it.
    """

    def __init__(self, size_m: float) -> None:
        if not 1e-6 <= size_m < 1.0:
            raise EstimationError(f"Voxels of {size_m:g} m", "Choose between 1 um and 1 m")
        self._size_m = size_m
        self._used = 0
        self._keys = np.full(_FIRST_CELLS, -1, dtype=np.int64)
        self._sums = np.zeros((_FIRST_CELLS, 4))

    def add(self, profile_yz: NDArray[np.floating], base_T_sensor: FloatArray) -> None:
        """Adds stripes.

        profile_yz : (k, n, 2) y and z in the frame of the sensor, metres; NaN where there is no reading.
        base_T_sensor : (k, 4, 4) where the sensor was at each.

        Raises EstimationError for arrays that do not fit, or stripes further away than the grid reaches.
        """
        yz = np.ascontiguousarray(profile_yz, dtype=np.float32)
        poses = np.ascontiguousarray(base_T_sensor, dtype=np.float64)
        if yz.ndim != 3 or yz.shape[2] != 2 or poses.shape != (len(yz), 4, 4):
            raise EstimationError(
                f"Stripes {yz.shape} with poses {poses.shape}", "Give (k, n, 2) and (k, 4, 4)"
            )
        widest = (
            max(float(np.fmax.reduce(yz, axis=None)), -float(np.fmin.reduce(yz, axis=None)))
            if yz.size
            else 0.0
        )
        reach = float(np.abs(poses[:, :3, 3]).max(initial=0.0)) + 2.0 * float(
            np.nan_to_num(widest, posinf=np.inf)
        )
        if not np.isfinite(poses).all() or not reach < (_HALF - 1) * self._size_m:
            raise EstimationError(
                f"Stripes up to {reach:.3g} m from the base, limit {_HALF * self._size_m:.3g} m",
                "Give metres, or larger voxels",
            )
        if not COMPILED:
            self._add_by_numpy(yz, poses)
            return
        done = 0
        while done < len(yz):
            done, self._used = kernels.add_stripes(
                yz, poses, 1.0 / self._size_m, _HALF, self._keys, self._sums, done, self._used
            )
            if done < len(yz):
                self._grow()

    @property
    def points(self) -> tuple[FloatArray, NDArray[np.intp]]:
        """Mean points (m, 3) in the base, metres, and of how many points each (m,); in fixed order."""
        taken = np.flatnonzero(self._keys != -1)
        taken = taken[np.argsort(self._keys[taken])]
        counts = self._sums[taken, 3]
        return self._sums[taken, :3] / counts[:, None], counts.astype(np.intp)

    def _grow(self) -> None:
        keys = np.full(2 * len(self._keys), -1, dtype=np.int64)
        sums = np.zeros((len(keys), 4))
        kernels.rehash(self._keys, self._sums, keys, sums)
        self._keys, self._sums = keys, sums

    def _add_by_numpy(self, yz: NDArray[np.float32], poses: FloatArray) -> None:
        for stripe, pose in zip(yz, poses, strict=True):
            sound = stripe[np.isfinite(stripe).all(axis=1)].astype(np.float64)
            base_p = sound @ pose[:3, 1:3].T + pose[:3, 3]
            cell = (base_p / self._size_m + _HALF).astype(np.int64)
            keys = cell[:, 0] << 42 | cell[:, 1] << 21 | cell[:, 2]
            every, where = np.unique(np.concatenate([self._keys, keys]), return_inverse=True)
            sums = np.zeros((len(every), 4))
            sums[where[: len(self._keys)]] = self._sums * (self._keys != -1)[:, None]
            np.add.at(sums, where[len(self._keys) :], np.column_stack([base_p, np.ones(len(base_p))]))
            self._keys, self._sums = every[every != -1], sums[every != -1]
