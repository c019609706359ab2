"""What can be wrong with data, each kind with its own cause, a sentence and what to do."""

from dataclasses import dataclass
from enum import StrEnum

from estimation.errors import EstimationError


class Cause(StrEnum):
    """Kinds of data that support no estimate, or not the one that they were given for."""

    ONE_AXIS = "rotations about one axis only"
    SMALL_ROTATIONS = "rotations too small"
    HALF_TURNS = "rotations near 180 deg"
    COPLANAR_POSES = "poses in one plane"
    CONSTANT_ORIENTATION = "orientation never changes"
    ONE_FACE = "all points on one face"
    COLLINEAR = "points on a line"
    SYMMETRIC = "symmetric part"
    TOO_FEW = "too few measurements"
    DUPLICATED = "measurements repeated"
    OUTLIER = "outlier"
    CLUSTERED_OUTLIERS = "many measurements contradict the others"
    WRONG_UNITS = "wrong units"
    INVERTED = "transform given the wrong way round"
    LEFT_HANDED = "left-handed rotation"
    NOT_A_ROTATION = "rotation not orthonormal"
    NOT_FINITE = "not a finite number"
    WRONG_SHAPE = "wrong shape"
    STILL_JOINT = "a joint that stands still"
    SWAPPED_JOINTS = "joints swapped"
    WRONG_SURFACE = "wrong surface named"
    UNDETERMINED = "a direction is not determined"
    AMBIGUOUS = "two solutions fit"
    INCONSISTENT = "residuals not as declared"
    NOISE = "no usable standard deviation"
    NO_SOLUTION = "no solution found"


class Status(StrEnum):
    """What a result is worth."""

    OK = "ok"
    FLAGGED = "flagged"  # values are given, with findings that somebody must look at
    REFUSED = "refused"  # no value is given


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing wrong: its kind, what was seen with limit and unit, and what to do."""

    cause: Cause
    problem: str
    remedy: str
    refuses: bool = True

    def __str__(self) -> str:
        return f"{self.problem}. {self.remedy}."


class TaskRefused(EstimationError):
    """Raised when values are asked of a task that was refused."""
