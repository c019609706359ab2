"""The errors that truecell raises on purpose: what was seen, then what to do."""


class CellError(Exception):
    """Root of all errors raised on purpose; any other type is a defect of ours.

    `problem` says what was seen with value, limit and unit; `remedy` says what to do.
    Neither ends with a full stop.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)  # both, so that it survives pickling
        self.problem, self.remedy = problem, remedy

    def __str__(self) -> str:
        remedy = self.remedy[:1].upper() + self.remedy[1:]
        return f"{self.problem}. {remedy}{'' if remedy.endswith('?') else '.'}"


class DeviceError(CellError):
    """A device, its cable or its settings."""


class DeviceTimeout(DeviceError):
    """No complete answer in time."""


class FrameError(DeviceError):
    """Bytes that are not a valid frame."""


class IdentityMismatch(DeviceError):
    """Another device, range or scale than the cell file declares."""


class StillMoving(DeviceTimeout):
    """An arm that was told to stop is not at rest."""


class MotionStopped(DeviceError):
    """The arm came to rest before its target because a stop was requested."""


class EstimationError(CellError):
    """The data cannot support the estimate."""


class DegenerateGeometry(EstimationError):
    """Points or poses that leave a freedom open."""


class ContradictingData(EstimationError):
    """More measurements contradict the others than may be left out."""


class FrameMismatch(EstimationError):
    """Transforms composed where frames do not meet."""


class Unreachable(CellError):
    """No joint angles reach the pose within the limits."""


class CellFileError(CellError):
    """The cell file, or a file that it names, is wrong."""


class IllegalTransition(CellError):
    """A command that the present state does not accept."""


class StoreError(CellError):
    """The record cannot be written or read."""
