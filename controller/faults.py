"""What takes the cell out of Execute: faults, outside causes and gates that hold."""

from dataclasses import dataclass

from controller.gates import Verdict
from controller.own_pose import PoseMismatch
from estimation.errors import CellError, DeviceError, DeviceTimeout, IdentityMismatch, StoreError


class Interrupted(Exception):
    """The machine left Execute at a checkpoint; not an error, the job goes on from the store."""


class OutsideCause(CellError):
    """The cell is well, its surroundings are not (no part, robot in manual): Suspend."""


class Defect(CellError):
    """Something that truecell did not foresee: no guess, no further motion."""


class GateHeld(CellError):
    """A gate did not pass and more measurements cannot cure it: Hold."""

    def __init__(self, phase: str, verdict: Verdict) -> None:
        super().__init__(f"Phase {phase}: {verdict.message}", verdict.remedy or "See the report")
        self.phase, self.verdict = phase, verdict

    def __reduce__(self) -> tuple[type["GateHeld"], tuple[str, Verdict]]:
        return GateHeld, (self.phase, self.verdict)


@dataclass(frozen=True, slots=True)
class Fault:
    """A latched fault; it clears only with its cause gone and an explicit command."""

    code: str  # of the fault catalogue
    text: str
    remedy: str
    utc_s: float


def fault_code(error: BaseException) -> str:
    """The code of the catalogue (letters: L links, R robot, D devices, E estimator, S store, H host)."""
    match error:
        case GateHeld():
            return "E11" if "check" in error.phase else "G"
        case OutsideCause():
            return "P1"
        case IdentityMismatch():
            return "D5"
        case DeviceTimeout():
            return "L4"
        case PoseMismatch():
            return "R7"
        case DeviceError():
            return "D"
        case StoreError():
            return "S2"
        case CellError() if not isinstance(error, Defect):
            return "E"
        case _:
            return "H7"
