"""What every phase is: a plan of steps, and a finding made of the samples taken."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from controller.cellfile import Cell, CheckPhase, HandEyePhase, LocalizePhase
from controller.gates import Verdict
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.belief import Belief
from estimation.kinematics import ArmModel

Spec = TypeVar("Spec")
Checked = TypeVar("Checked", HandEyePhase, LocalizePhase)


@dataclass(frozen=True, slots=True)
class PhaseRecord:
    """An earlier phase as the store remembers it."""

    name: str
    kind: str
    steps: tuple[Step, ...]
    samples: tuple[Sample, ...]
    estimate: dict[str, Any]


@dataclass(frozen=True, slots=True)
class PhaseContext(Generic[Spec]):
    """Everything that a phase may know. It never sees a device."""

    cell: Cell
    spec: Spec
    arm: ArmModel  # nominal; what was learnt about it is the belief's block "kinematics"
    belief: Belief  # as the phase before left it
    earlier: Mapping[str, PhaseRecord] = field(default_factory=dict)
    seed: int = 0  # of planning: same job, same plan


@dataclass(frozen=True, slots=True)
class Finding:
    """What a phase found: the belief that goes on, the verdict, and the numbers for people."""

    verdict: Verdict
    belief: Belief
    estimate: dict[str, Any]  # JSON; lengths in metres, angles in radians, as the key says


class PhaseKind(Protocol):
    """One kind of phase: pure functions of context and samples, so that a restart repeats them."""

    def plan(self, context: PhaseContext[Any]) -> Sequence[Step]:
        """The first steps."""

    def more(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Sequence[Step]:
        """Further steps that follow from the samples of all steps so far; empty when complete.

        Raises OutsideCause (no part), CellError.
        """

    def evaluate(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Finding:
        """Estimate and gate. Raises EstimationError when the data cannot support an estimate."""

    def extend(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample], finding: Finding
    ) -> Sequence[Step]:
        """Steps that may cure a finding that did not pass; empty when none can."""


class OnePlan:
    """A phase whose first plan is all it measures; kinds that go on override these."""

    def more(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample]
    ) -> Sequence[Step]:
        """Nothing follows from the samples."""
        return ()

    def extend(
        self, context: PhaseContext[Any], steps: Sequence[Step], samples: Sequence[Sample], finding: Finding
    ) -> Sequence[Step]:
        """More of the same would cure nothing."""
        return ()


def good(samples: Sequence[Sample], *kinds: str) -> list[Sample]:
    """The samples that may enter an estimate, of the given kinds (all kinds if none is given)."""
    return [sample for sample in samples if sample.good and (not kinds or sample.kind in kinds)]


def checked_phase(context: PhaseContext[CheckPhase], kind: type[Checked]) -> Checked:
    """The phase that a check is about; the cell file is known to name one of this kind."""
    return next(
        phase
        for phase in context.cell.job.phases
        if phase.name == context.spec.of and isinstance(phase, kind)
    )
