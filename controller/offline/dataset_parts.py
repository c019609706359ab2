"""What data sets of all tasks have in common: units, matrices, motion of the arm, priors, shared errors."""

from collections.abc import Iterator, Sequence
from math import pi, radians
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from controller.cellfile.arm import Joint, LinkAngle, arm_model, parameter_u
from controller.cellfile.lines import KeyPath
from controller.cellfile.tables import Table
from controller.offline.units import METRES
from controller.quantities import Angle, Length, Ratio
from estimation.tasks import motion
from estimation.tasks.checks import LARGEST_SKEW
from estimation.tasks.solve import Problem, Result, solve
from estimation.transform import FloatArray, Transform

Wrong = tuple[KeyPath, str, str]  # where in the file, what is wrong, what to do
_RADIANS: Final = {"deg": pi / 180.0, "rad": 1.0}


class Part(Table):
    """A table of a data set; its numbers are finite."""

    model_config = ConfigDict(allow_inf_nan=False)


def _rigid(rows: "Rows") -> "Rows":
    matrix = np.array(rows)
    rotation = matrix[:3, :3]
    skewed = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
        raise _refusal("the last row is not 0 0 0 1", "write the origin in the fourth column")
    if skewed > LARGEST_SKEW:
        raise _refusal(
            f"not a rotation: R^T R differs from the identity by {skewed:.2g}, limit {LARGEST_SKEW:g}",
            "write rotations with six decimals or more",
        )
    if np.linalg.det(rotation) < 0.0:
        raise _refusal("the rotation is left-handed", "check the signs of the axes: x cross y must be z")
    return rows


def _refusal(problem: str, remedy: str) -> PydanticCustomError:
    return PydanticCustomError("quantity", "{problem}", {"problem": problem, "remedy": remedy})


_Row = tuple[float, float, float, float]
Rows = tuple[_Row, _Row, _Row, _Row]
Matrix = Annotated[Rows, AfterValidator(_rigid)]
Point = tuple[float, float, float]
Index = Annotated[int, Field(ge=0)]
Std = Annotated[Length, Field(ge=0, le=0.1)]
Noise = Annotated[Length, Field(gt=0, le=0.1)]
MOST_PRIOR_STD: Final = 100.0  # mm or deg: as `Std`


class Units(Part):
    """Of all plain numbers in arrays; single quantities carry their own."""

    length: Literal["mm", "m", "inch"]
    """Of points, readings and the fourth column of matrices."""
    angle: Literal["deg", "rad"]
    """Of joints."""

    def lengths(self, numbers: object) -> FloatArray:
        """Metres."""
        return np.asarray(numbers, dtype=np.float64) * METRES[self.length]

    def angles(self, numbers: object) -> FloatArray:
        """Radians."""
        return np.asarray(numbers, dtype=np.float64) * _RADIANS[self.angle]

    def matrices(self, numbers: object) -> FloatArray:
        """(..., 4, 4) with metres in the fourth column."""
        matrices = np.array(numbers, dtype=np.float64)
        matrices[..., :3, 3] *= METRES[self.length]
        return matrices


class PoseStd(Part):
    """Standard deviation of a pose: along and about each of its axes."""

    position_m: Std
    """Along each axis."""
    rotation_rad: Angle = Field(ge=0, le=radians(20))
    """About each axis."""


class Poses(Part):
    """Poses of the flange as the controller of the arm, or a tracker, reports them."""

    kind: Literal["poses"]
    target: Literal["base"]
    """Frame that the matrices map to."""
    source: Literal["flange"]
    """Frame that the matrices map from."""
    matrices: Annotated[tuple[Matrix, ...], Field(min_length=1)]
    """Matrices base_T_flange, 4 x 4, one for each pose."""
    noise: PoseStd
    """Standard deviation of a pose, independent of the others."""

    def __len__(self) -> int:
        return len(self.matrices)

    def wrong(self) -> Iterator[Wrong]:
        """What single values do not show: nothing here."""
        return iter(())

    def motion(self, units: Units) -> motion.Motion:
        """In SI."""
        return motion.Poses(units.matrices(self.matrices), self.noise.position_m, self.noise.rotation_rad)


class Link(Joint):
    """A joint as in the cell file; limits matter only to plans."""

    limits_rad: tuple[LinkAngle, LinkAngle] = (-2.0 * pi, 2.0 * pi)
    """Lowest and highest joint angle."""


class Joints(Part):
    """Joint angles, and the arm that turns them into poses of its flange."""

    kind: Literal["joints"]
    arm: Annotated[tuple[Link, ...], Field(min_length=1)]
    """Links from base to flange: Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
    angles: Annotated[tuple[tuple[float, ...], ...], Field(min_length=1)]
    """Joint angles, one row for each pose."""
    noise_rad: Angle = Field(ge=0, le=radians(3))
    """Standard deviation of each angle, independent of the others."""

    def __len__(self) -> int:
        return len(self.angles)

    def wrong(self) -> Iterator[Wrong]:
        """Rows that do not suit the arm."""
        for row, angles in enumerate(self.angles):
            if len(angles) != len(self.arm):
                yield (
                    ("motion", "angles", row),
                    f"{len(angles)} angles",
                    f"the arm has {len(self.arm)} joints",
                )

    def motion(self, units: Units) -> motion.Motion:
        """In SI; the uncertain parameters of the arm are estimated along, with their priors."""
        arm = arm_model(self.arm)
        u = parameter_u(self.arm) if arm.free else None
        return motion.Joints(arm, units.angles(self.angles), self.noise_rad, kinematics_std=u)


class Dataset(Part):
    """What every data set begins with."""

    truecell_dataset: Literal[1]
    """Version of this form."""
    task: str
    """Name of the task."""
    about: str = ""
    """For people."""

    def wrong(self) -> Iterator[Wrong]:
        """What single values do not show, each with its place."""
        return iter(())

    def solved(self) -> Result:
        """What the data say; bad data come back refused or flagged."""
        raise NotImplementedError


class MotionDataset(Dataset):
    """What was measured at many poses of an arm."""

    units: Units
    motion: Annotated[Poses | Joints, Field(discriminator="kind")]

    def wrong(self) -> Iterator[Wrong]:
        yield from super().wrong()
        yield from self.motion.wrong()

    def problem(self) -> Problem:
        """The problem for `estimation.tasks.solve.solve`, in SI."""
        raise NotImplementedError

    def solved(self) -> Result:
        return solve(self.problem())


class Prior(Part):
    """What is known of the mount before."""

    target: str
    """Frame that the matrix maps to."""
    source: str
    """Frame that the matrix maps from: the sensor."""
    matrix: Matrix
    """The mount, 4 x 4."""
    std: PoseStd | None = None
    """How well it is known; zeros hold it where it is."""
    covariance: tuple[tuple[float, ...], ...] | None = None
    """Instead of std, of its freedoms as `--json` of its calibration gives it: mm and deg squared."""

    def wrong(self, freedoms: Sequence[str]) -> Iterator[Wrong]:
        """One of std and covariance, and of the freedoms that the sensor has."""
        if (self.std is None) == (self.covariance is None):
            yield ("prior",), "needs one of std and covariance", "say how well the mount is known"
        if self.covariance is not None:
            rows, count = [len(row) for row in self.covariance], len(freedoms)
            if rows != [count] * count:
                wanted = f"write {count} x {count} numbers, of {', '.join(freedoms)}"
                yield ("prior", "covariance"), f"{len(rows)} rows of {max(rows, default=0)} numbers", wanted
                return
            std = np.sqrt(np.maximum(np.diag(np.array(self.covariance)), 0.0))
            if (worst := int(np.argmax(std))) >= 0 and std[worst] > MOST_PRIOR_STD:
                seen = f"{freedoms[worst]} has a standard deviation of {std[worst]:.4g}"
                yield ("prior", "covariance"), seen, f"write mm and deg squared, {MOST_PRIOR_STD:g} at most"

    def known(self, units: Units, freedoms: Sequence[str]) -> dict[str, Any]:
        """Of the mount, as arguments of a problem, in SI."""
        mount = Transform(self.target, self.source, units.matrices(self.matrix))
        if self.std is not None:
            std = [
                self.std.rotation_rad if name.startswith("r") else self.std.position_m for name in freedoms
            ]
            return {"mount": mount, "mount_std": np.array(std)}
        scale = [np.radians(1.0) if name.startswith("r") else 1e-3 for name in freedoms]
        return {"mount": mount, "mount_covariance": np.array(self.covariance) * np.outer(scale, scale)}


class SharedErrors(Part):
    """Errors of the sensor that are the same in all readings."""

    scale: Ratio = Field(default=0.0, ge=0, le=0.1)
    """Standard deviation of the scale."""
    offset_m: Std = 0.0
    """Standard deviation of the offset along the beam."""
    consider: tuple[str, ...] = ()
    """Names of those that are carried but not estimated, such as laser.scale."""


def unequal(path: KeyPath, have: int, want: int, what: str) -> Iterator[Wrong]:
    """A list that must be as long as another one."""
    if have != want:
        yield path, f"{have} values", f"write {want}, one for each {what}"


def beyond(path: KeyPath, places: tuple[int, ...], count: int, what: str) -> Iterator[Wrong]:
    """Places from 0 that do not exist."""
    for row, place in enumerate(places):
        if place >= count:
            yield (*path, row), "out of bounds", f"there are {count} {what}, counted from 0"
            return
