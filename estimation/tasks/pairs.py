"""Hand-eye from pairs of poses, A X = Y B, and from pairs of moves, A X = X B, with covariance.

A comes from the arm, B from the sensor, X is the mount and Y the object. A sensor that sees the pose of an
object at each stop gives poses: to make moves of them would count each several times.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.belief import Belief, Value
from estimation.covariance import adjoint
from estimation.model import values_of
from estimation.tasks import checks, closed_forms, starts
from estimation.tasks.closed_forms import inverse
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.mistakes import other_units
from estimation.tasks.motion import Motion
from estimation.tasks.pair_chain import POSE_ERRORS, Moves, PairChain
from estimation.transform import FloatArray, Transform

_MOST_FOR_A_START: Final = 40  # poses, of which all pairs are taken
_TRIED: Final = 3  # rotations of a grid that the closed forms are checked by


@dataclass(frozen=True, eq=False, kw_only=True)
class PairTask:
    """What poses and moves have in common.

    Attributes
    ----------
    motion : `Poses` or `Joints` of the arm.
    std_m, std_rad : of what the sensor reports, along and about each of its final axes; or `covariance`
        (6, 6) or (k, 6, 6), form A, instead.
    consider : names of shared errors that are carried and not updated.
    """

    motion: Motion
    std_m: float = 0.0
    std_rad: float = 0.0
    covariance: FloatArray | None = None
    consider: tuple[str, ...] = ()

    task: ClassVar[str] = ""
    reported: ClassVar[str] = ""  # attribute that holds what the sensor reports
    blocks: ClassVar[tuple[tuple[str, str], ...]] = ()  # name and near frame of each unknown pose
    beside: ClassVar[bool] = False

    @property
    def arm(self) -> Motion:
        """Where A comes from."""
        return self.motion

    @property
    def given(self) -> Any:
        """(k, 4, 4) as the sensor reports it."""
        return getattr(self, self.reported)

    def closing(self) -> tuple[FloatArray, FloatArray]:
        """B (k, 4, 4) and its noise (k, 6, 6), form A."""
        return self.given, self.noise()

    def candidates(self, a: FloatArray, b: FloatArray) -> list[Mapping[str, Value]]:
        """Starts from A and B (k, 4, 4), by all closed forms that apply."""
        raise NotImplementedError

    def check_motion(self, a: FloatArray) -> list[Finding]:
        """What is wrong with the A (k, 4, 4)."""
        raise NotImplementedError

    def noise(self) -> FloatArray:
        """(k, 6, 6) of what the sensor reports, form A."""
        own = np.diag(np.repeat([self.std_m**2, self.std_rad**2], 3))
        covariance = own if self.covariance is None else self.covariance
        return np.broadcast_to(covariance, (len(self.given), 6, 6))

    def check(self) -> Sequence[Finding]:
        """Everything wrong at sight; an empty list for sound data."""
        return checks.first_of(
            lambda: list(self.arm.check()),
            lambda: checks.numbers({self.reported: (self.given, (len(self.arm), 4, 4))}),
            self._check_noise,
            lambda: checks.transforms({self.reported: self.given}),
            lambda: checks.lengths({self.reported: self.given[:, :3, 3]}),
            self._check_geometry,
        )

    def _check_noise(self) -> list[Finding]:
        least = min(self.std_m, self.std_rad)
        if self.covariance is not None:
            if np.shape(self.covariance) not in ((6, 6), (len(self.given), 6, 6)):
                shape = {"covariance": (self.covariance, (len(self.given), 6, 6))}
                return checks.numbers(shape)
            if not np.isfinite(self.covariance).all():
                return [Finding(Cause.NOISE, "The covariance of the sensor is not finite", "Check it")]
            least = float(np.linalg.eigvalsh(self.covariance).min())
        if least > 0.0 and np.isfinite([self.std_m, self.std_rad]).all():
            return []
        return [
            Finding(
                Cause.NOISE,
                f"The noise of the sensor is {least:.3g} in some direction, it must be finite and above zero",
                "Give std_m and std_rad of what the sensor reports, or its covariance",
            )
        ]

    def _check_geometry(self) -> list[Finding]:
        belief = self.belief()
        unknowns = int(belief.flat.sum())
        keys = np.column_stack([self.arm.keys, self.given.reshape(len(self.given), 16)])
        found = checks.repeated(keys, unknowns, 6) + checks.count(6 * len(self.given), unknowns)
        return found + self.check_motion(self.arm.at(values_of(belief)).pose)

    def belief(self) -> Belief:
        belief = Belief()
        for name, frame in self.blocks:
            belief = belief.with_block(name, Transform(frame, name, np.eye(4)), std=np.inf)
        return self.arm.with_priors(belief)

    def rough(self) -> Belief:
        return self.belief().without([POSE_ERRORS])

    def model(self) -> PairChain:
        names = [name for name, _ in self.blocks]
        return PairChain(self.arm, *self.closing(), names[0], names[-1], beside=self.beside)

    def starts(self) -> Sequence[Mapping[str, Value]]:
        a = self.arm.at(values_of(self.rough())).pose
        if len(a) <= _MOST_FOR_A_START:
            rows = np.arange(len(a))
        else:
            rows = np.linspace(0, len(a) - 1, _MOST_FOR_A_START).astype(np.intp)
        return self.candidates((inverse(a) if self.beside else a)[rows], self.closing()[0][rows])

    def poses(self, *matrices: FloatArray) -> dict[str, Value]:
        """Values of the unknown poses."""
        return {
            name: Transform(frame, name, matrix)
            for (name, frame), matrix in zip(self.blocks, matrices, strict=True)
        }

    def settled(self, values: Mapping[str, Value]) -> Mapping[str, Value]:
        """Nothing is free to spin."""
        return values

    def explanations(self) -> Sequence[tuple[Finding, "PairTask"]]:
        """Mistakes with motion, direction and units."""
        found = [(finding, replace(self, motion=motion)) for finding, motion in self.motion.mistakes()]
        inverted: dict[str, Any] = {self.reported: inverse(self.given)}
        finding = Finding(
            Cause.INVERTED,
            f"The measurements fit when each of {self.reported} is inverted",
            f"Give {self.reported}: coordinates in the second frame become coordinates in the first",
        )
        found.append((finding, replace(self, **inverted)))
        for finding, factor in other_units(f"The measurements fit when {self.reported} is"):
            scaled = np.array(self.given, dtype=np.float64)
            scaled[:, :3, 3] /= factor
            again: dict[str, Any] = {self.reported: scaled}
            found.append((finding, replace(self, **again)))
        return found

    def diagnose(self, values: Mapping[str, Value], rejected: NDArray[np.bool_] | None) -> list[Finding]:
        """Nothing more than the checks at sight say."""
        return []


@dataclass(frozen=True, eq=False, kw_only=True)
class PosePairs(PairTask):
    """A sensor on the arm sees the pose of an object that stands still: sensor_T_object (k, 4, 4)."""

    sensor_T_object: FloatArray

    task: ClassVar[str] = "pose-pairs"
    reported: ClassVar[str] = "sensor_T_object"
    blocks: ClassVar[tuple[tuple[str, str], ...]] = (("sensor", "flange"), ("object", "base"))
    sensor: ClassVar[str] = "sensor"
    object: ClassVar[str] = "object"

    def check_motion(self, a: FloatArray) -> list[Finding]:
        return checks.orientations(a) + checks.positions(a)

    def explanations(self) -> Sequence[tuple[Finding, PairTask]]:
        """And poses inverted: of arm or sensor, because (A^-1, B^-1) fit with mount and object exchanged."""
        either = Finding(
            Cause.INVERTED,
            "The measurements fit when base_T_flange or sensor_T_object are inverted, one of the two",
            "Give both so that coordinates in the second frame become coordinates in the first",
        )
        return [
            (either if finding.cause is Cause.INVERTED else finding, other)
            for finding, other in super().explanations()
        ]

    def candidates(self, a: FloatArray, b: FloatArray) -> list[Mapping[str, Value]]:
        back = inverse(b)  # the closed forms have A X = Y B, with B the other way round
        found = [solved(a, back) for solved in closed_forms.AX_YB.values()]
        pairs = closed_forms.every_pair(len(a))
        moved = closed_forms.moves(a, pairs), closed_forms.moves(back, pairs)
        mounts = [solved(*moved) for solved in closed_forms.AX_XB.values()]
        # The axis of a half turn has no sign, and rotations alone may leave several mounts; origins decide.
        origins = b[:, :3, 3]
        tried, _, cost = starts.on_points(a, origins, np.zeros_like(origins), starts.rotations())
        mounts += [tried[i] for i in starts.best(cost, tried[:, :3, :3], count=_TRIED)]
        for mount in mounts:
            held = (a @ mount @ b).mean(axis=0)
            held[:3, :3] = starts.nearest_rotation(held[:3, :3])
            found.append((mount, held))
        return [self.poses(*both) for both in found]


@dataclass(frozen=True, eq=False, kw_only=True)
class PosePairsBeside(PosePairs):
    """A sensor beside the arm sees the pose of an object that the arm carries."""

    task: ClassVar[str] = "pose-pairs-beside"
    blocks: ClassVar[tuple[tuple[str, str], ...]] = (("sensor", "base"), ("object", "flange"))
    beside: ClassVar[bool] = True


@dataclass(frozen=True, eq=False, kw_only=True)
class MovePairs(PairTask):
    """A sensor on the arm reports how it moved from one pose of the arm to another, as odometry does.

    Attributes
    ----------
    first, second : (m,) indices of the poses of the motion, of each move (`closed_forms.consecutive`).
    first_T_second : (m, 4, 4) moves of the sensor, each with independent noise.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    first_T_second: FloatArray

    task: ClassVar[str] = "move-pairs"
    reported: ClassVar[str] = "first_T_second"
    blocks: ClassVar[tuple[tuple[str, str], ...]] = (("sensor", "flange"),)

    @property
    def arm(self) -> Motion:
        return Moves(self.motion, self.first, self.second)

    def closing(self) -> tuple[FloatArray, FloatArray]:
        """The inverse of each move, with the noise of that."""
        turned = adjoint(np.asarray(self.given, dtype=np.float64))
        return inverse(self.given), turned @ self.noise() @ turned.swapaxes(-1, -2)

    def check_motion(self, a: FloatArray) -> list[Finding]:
        return checks.turns(Rotation.from_matrix(a[:, :3, :3]).as_rotvec())

    def candidates(self, a: FloatArray, b: FloatArray) -> list[Mapping[str, Value]]:
        return [self.poses(solved(a, inverse(b))) for solved in closed_forms.AX_XB.values()]
