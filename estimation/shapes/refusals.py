"""Why points do not give a surface: each kind of cause by name, and in words."""

from dataclasses import dataclass
from enum import StrEnum

from estimation.errors import EstimationError


class Cause(StrEnum):
    """What is wrong with points, or at least suspicious."""

    WRONG_SHAPE = "wrong_shape"
    NOT_FINITE = "not_finite"
    TOO_FEW_POINTS = "too_few_points"
    DUPLICATED_POINTS = "duplicated_points"
    POINTS_ON_A_LINE = "points_on_a_line"
    POINTS_ON_A_CIRCLE = "points_on_a_circle"
    NEARLY_FLAT = "nearly_flat"
    SIMPLER_SURFACE = "simpler_surface"
    UNDETERMINED = "undetermined"
    AMBIGUOUS = "ambiguous"
    NO_REDUNDANCY = "no_redundancy"
    OUTLIERS = "outliers"
    WRONG_SURFACE = "wrong_surface"
    FORM_ERROR = "form_error"
    UNIT_SUSPECTED = "unit_suspected"
    SCATTER_NOT_AS_STATED = "scatter_not_as_stated"
    NO_CONVERGENCE = "no_convergence"
    BAD_SIGMA = "bad_sigma"


class FitRefused(EstimationError):
    """These points give no usable surface; `cause` says which kind of problem it is."""

    def __init__(self, cause: Cause, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)
        self.cause = cause

    def __reduce__(self) -> tuple[type, tuple[Cause, str, str]]:
        return FitRefused, (self.cause, self.problem, self.remedy)


@dataclass(frozen=True, slots=True)
class Flag:
    """Something that the user should look at; what is flagged as spoilt is no result to use."""

    cause: Cause
    text: str
    spoils: bool = False
