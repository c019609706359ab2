"""One step of a plan: where the arm goes and what it measures there. Plans are data."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

Kind = Literal["laser", "touch", "noise", "reference"]
Joints = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Step:
    """A measurement at one standstill, or one touch.

    Every step is reached from the posture in which the step before it ends: its `joints_rad`, or the
    last of its `retreat`. The first step of a plan starts from any carrying posture (tool above
    everything), and the last one retreats to such a posture, so plans follow each other freely. Steps that
    are added one by one do not retreat; what follows them takes the way back over their `access`.
    `access` leads from a carrying posture to the step, whatever was done before; see `route`.
    """

    id: str  # unique in the job
    kind: Kind
    object: str  # "plate", "bar", "sphere", "part"
    feature: str  # of that object
    joints_rad: Joints  # laser: where it measures; touch: where the approach starts
    via: tuple[Joints, ...] = ()  # postures to pass before, in order
    retreat: tuple[Joints, ...] = ()  # postures to pass after, in order
    access: tuple[Joints, ...] = ()  # from a carrying posture, which is the first, to where `via` ends
    contact_rad: Joints = ()  # touch: where the approach ends if nothing is met
    expected_m: float = 0.0  # laser: predicted reading; touch: predicted way of the ball to contact
    object_p_m: tuple[float, ...] = ()  # predicted point (laser) or ball centre (touch), frame of the object
    readings: int = 0  # joint readings; 0 means as the cell file says
    note: str = ""

    @property
    def end_rad(self) -> Joints:
        """Where the arm stands after the step."""
        return self.retreat[-1] if self.retreat else self.joints_rad

    def to_dict(self) -> dict[str, Any]:
        """For JSON; floats survive exactly."""
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> "Step":
        """Inverse of `to_dict`, also after JSON made tuples lists."""
        return Step(**{name: _tuples(value) for name, value in data.items()})


def route(done: Step | None, following: Step) -> tuple[Joints, ...]:
    """Postures to pass from the end of one step to another that does not follow it in its plan.

    Over the carrying postures of both; from a carrying posture when `done` is None.
    """
    back = () if done is None or done.retreat[-1:] == done.access[:1] else tuple(reversed(done.access))
    return (*back, *following.access)


def named(steps: Sequence[Step], prefix: str, first: int = 0) -> tuple[Step, ...]:
    """The steps with ids "prefix 001", counted from `first` (from 0)."""
    return tuple(replace(step, id=f"{prefix} {first + i + 1:03d}") for i, step in enumerate(steps))


def as_joints(values: Iterable[float]) -> Joints:
    """Joints as a tuple of plain floats."""
    return tuple(float(value) for value in values)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list | tuple) else value
