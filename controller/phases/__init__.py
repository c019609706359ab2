"""The kinds of phase, by what the cell file says."""

from controller.cellfile.job import Phase
from controller.phases.bar_check import BarCheckPhase
from controller.phases.base import PhaseKind
from controller.phases.hand_eye import HandEyePhase
from controller.phases.inspect import InspectPhase
from controller.phases.localize import LocalizePhase
from controller.phases.noise import NoisePhase
from controller.phases.part_check import PartCheckPhase


def kind_of(spec: Phase, phases: tuple[Phase, ...]) -> PhaseKind:
    """How this phase works; a check works as what it checks demands."""
    match spec.kind:
        case "noise":
            return NoisePhase()
        case "hand_eye":
            return HandEyePhase()
        case "localize":
            return LocalizePhase()
        case "inspect":
            return InspectPhase()
        case "check":
            checked = next(phase for phase in phases if phase.name == spec.of)
            return BarCheckPhase() if checked.kind == "hand_eye" else PartCheckPhase()
