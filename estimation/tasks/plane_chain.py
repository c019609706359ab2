"""A sensor that sees planes, compiled: the rows of `SensorChain` where only its two poses are unknown."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from estimation.chart import not_finite, undetermined
from estimation.compiling import Tier
from estimation.model import Descent, DescentLimits, Ended, Passes, Point, Rows
from estimation.posterior import After
from estimation.transform import FloatArray

try:
    from estimation.tasks import plane_kernels as kernels
except ImportError:  # numba is optional: numpy gives the same numbers
    kernels = None  # type: ignore[assignment]

TIER: Final = None if kernels is None else Tier(kernels.reweighted)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneChain:
    """Rows and descent over mount and object in the chart r0 = root z, whose first rows are of the mount.

    Attributes
    ----------
    root : (n, n) of the chart.
    mount, holder : (4, 4) where they start, with the places of their active freedoms in a perturbation (6,).
    poses, sensor_p : (m, 4, 4) base_T_flange of each reading, and (m, 3) its point in the sensor.
    pose_covariance, reading_covariance : (m, 6, 6), (m, 3, 3).
    normals, offsets : (m, 3), (m,) of the plane that each reading lies on, in the object.
    blocks, noise : names of the two poses, and labels of the two noises.
    """

    root: FloatArray
    mount: tuple[FloatArray, NDArray[np.intp]]
    holder: tuple[FloatArray, NDArray[np.intp]]
    poses: FloatArray
    sensor_p: FloatArray
    normals: FloatArray
    offsets: FloatArray
    pose_covariance: FloatArray
    reading_covariance: FloatArray
    blocks: tuple[str, str]
    noise: tuple[str, str]

    @property
    def after(self) -> After:
        """As `CompiledModel.after`."""
        return cast(After, kernels.after)

    def at(self, z: FloatArray) -> Point:
        """Rows at z (n,), with their Jacobian (m, n) by z."""
        return self._point(z, kernels.evaluated(z, self._setup))

    def descent(
        self, z: FloatArray, weight: FloatArray, prior: FloatArray, tolerance: float, limits: DescentLimits
    ) -> Descent:
        """As `CompiledModel.descent`."""
        return self._ended(kernels.descent, z, weight, prior, tolerance, tuple(limits))

    def reweighted(
        self, z: FloatArray, used: NDArray[np.bool_], prior: FloatArray, passes: Passes, limits: DescentLimits
    ) -> Descent:
        """As `CompiledModel.reweighted`."""
        return self._ended(kernels.reweighted, z, used, prior, tuple(passes), tuple(limits))

    def _ended(self, kernel: Callable[..., Any], *given: object) -> Descent:
        try:
            ended, z, found, costs, lengths, gradient, last_step = kernel(*given, self._setup)
        except np.linalg.LinAlgError as error:
            raise undetermined() from error
        if ended == Ended.INFINITE:
            raise not_finite()
        every = tuple(tuple(costs[i, :length].tolist()) for i, length in enumerate(lengths.tolist()))
        return Descent(Ended(ended), self._point(z, found), every, gradient, last_step)

    def _point(self, z: FloatArray, found: tuple[FloatArray, ...]) -> Point:
        residual, by_mount, by_object, from_poses, from_readings, jacobian = found
        derivatives = {self.blocks[0]: by_mount, self.blocks[1]: by_object}
        noise = {self.noise[0]: from_poses, self.noise[1]: from_readings}
        return z, Rows(residual, derivatives, noise), jacobian

    @property
    def _setup(self) -> tuple[FloatArray | NDArray[np.intp], ...]:
        """As the kernels take it."""
        return (
            self.root,
            *self.mount,
            *self.holder,
            self.poses,
            self.sensor_p,
            self.normals,
            self.offsets,
            self.pose_covariance,
            self.reading_covariance,
        )
