"""The table of the job: phases in order, each with its limit, gated points and budget."""

from typing import Annotated, Final, Literal

from pydantic import Field

from controller.cellfile.tables import Count, Name, Table
from controller.quantities import Duration, Length, Ratio

DAY_S: Final = 86400.0
# Statistical tests of a phase: noise of joints, cycles and points; residuals; a bump and what it leaves.
_TESTS: Final = {"noise": 3, "hand_eye": 1, "check": 2, "localize": 1, "inspect": 2}


class NoisePhase(Table):
    """Repeatability of joints and laser, at several poses."""

    kind: Literal["noise"]
    """What the phase does, and which keys it has."""
    name: Name
    """Name of the phase, unique in the job."""
    readings: Annotated[int, Field(ge=10, le=10_000)]
    """Joint readings at each pose."""
    poses: Count
    """Number of poses."""


class HandEyePhase(Table):
    """Where the laser sits on the flange, from the plate; with the kinematic parameters."""

    kind: Literal["hand_eye"]
    """What the phase does, and which keys it has."""
    name: Name
    """Name of the phase, unique in the job."""
    measurements: Annotated[int, Field(ge=9, le=10_000)]
    """Measurements planned together at first; then one after the other is added, until the limit is met."""
    most_measurements: Annotated[int, Field(ge=9, le=10_000)]
    """Budget: measurements after which the phase gives up."""
    limit_m: Length = Field(gt=0, le=0.1)
    """Largest expanded uncertainty U (3-D, 95 %) at the gated points."""
    gated_ranges_m: Annotated[tuple[Length, ...], Field(min_length=1)]
    """Laser distances at which the uncertainty is gated."""
    expires_s: Duration = Field(default=30 * DAY_S, gt=0)
    """Age from which the result no longer holds."""


class LocalizePhase(Table):
    """Where the part lies, from its faces."""

    kind: Literal["localize"]
    """What the phase does, and which keys it has."""
    name: Name
    """Name of the phase, unique in the job."""
    measurements: Annotated[int, Field(ge=6, le=10_000)]
    """Measurements planned together at first; then one after the other is added, until the limit is met."""
    most_measurements: Annotated[int, Field(ge=6, le=10_000)]
    """Budget: measurements after which the phase gives up."""
    faces: Annotated[tuple[str, ...], Field(min_length=3)]
    """Features that are measured."""
    limit_m: Length = Field(gt=0, le=0.1)
    """Largest expanded uncertainty U (3-D, 95 %) at the gated points."""
    gated_points: Literal["corners"] = "corners"
    """Points of the part at which the uncertainty is gated: the corners of its bounding box."""
    expires_s: Duration = Field(default=DAY_S, gt=0)
    """Age from which the result no longer holds."""


class CheckPhase(Table):
    """An independent check of an earlier phase; its measurements enter no fit."""

    kind: Literal["check"]
    """What the phase does, and which keys it has."""
    name: Name
    """Name of the phase, unique in the job."""
    of: str
    """Name of the phase that is checked."""
    points_per_sphere: int = Field(default=0, ge=0, le=100)
    """Points on each sphere of the bar and each tool orientation (check of a hand-eye)."""
    plate_poses: int = Field(default=0, ge=0, le=1000)
    """Plate poses of the hand-eye measured again (check of a hand-eye)."""
    points: int = Field(default=0, ge=0, le=1000)
    """Points on the part (check of a localization)."""


class InspectPhase(Table):
    """All characteristics of the part."""

    kind: Literal["inspect"]
    """What the phase does, and which keys it has."""
    name: Name
    """Name of the phase, unique in the job."""
    most_measurements: Annotated[int, Field(ge=1, le=10_000)] = 200
    """Budget for touches that are added where a characteristic is not decidable."""


Phase = Annotated[
    NoisePhase | HandEyePhase | LocalizePhase | CheckPhase | InspectPhase, Field(discriminator="kind")
]


class Job(Table):
    """What the cell does, in order, and by which rule it decides."""

    decision_rule: Literal["ISO 14253-1"] = "ISO 14253-1"
    """Conformity and non-conformity must both be proven; between them nothing is claimed."""
    conformance_probability: Ratio = Field(default=0.95, ge=0.5, lt=1)
    """Probability with which conformity must be proven."""
    false_alarms: Ratio = Field(default=0.01, ge=1e-6, le=0.1)
    """Probability with which the statistical tests of one job, all together, refuse an honest cell."""
    phases: Annotated[tuple[Phase, ...], Field(min_length=1)]
    """Phases in order."""

    @property
    def test_level(self) -> float:
        """Probability with which any one test may refuse an honest cell: its share after Bonferroni."""
        return self.false_alarms / sum(_TESTS[phase.kind] for phase in self.phases)
