"""What a cell can ask of its devices: one small Protocol per capability, in SI units.

Values carry the time they belong to, on the driver's clock. There is no last-value fallback:
a driver answers with a value newer than the question, or raises.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from drivers.links.meter import LinkStatistics
from estimation.transform import FloatArray, Transform


class Quality(StrEnum):
    """OPC UA severity; only GOOD values enter an estimate."""

    GOOD = "good"
    UNCERTAIN = "uncertain"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Identity:
    """Who answers on a link, read back at every connect ("" where the device has no such thing)."""

    model: str
    serial_number: str
    firmware: str
    settings: tuple[tuple[str, str], ...] = ()  # scale, range: what a calibration depends on


@dataclass(frozen=True, slots=True)
class LinkHealth:
    """Counters of one link since it was opened."""

    frames: int
    bad_frames: int
    timeouts: int
    reconnects: int


class Device(Protocol):
    """What every driver can do."""

    def connect(self) -> Identity:
        """Open the link, read and compare the identity, configure. Also used to reconnect.

        Raises DeviceError, DeviceTimeout, IdentityMismatch.
        """

    def close(self) -> None:
        """Bring the device to rest and release the link; safe twice."""

    def health(self) -> LinkHealth:
        """Link counters."""


@dataclass(frozen=True, slots=True, eq=False)
class JointReadings:
    """Joint angles read at several instants of one standstill, or while moving."""

    time_s: FloatArray  # (n,) instant of each reading (of the SYNC that it answers)
    joints_rad: FloatArray  # (n, joints)


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Where the joints were when the probe first touched."""

    joints_rad: FloatArray  # (joints,)
    readings: float  # how many readings averaged would be as noisy: 1 to 2 where two were interpolated
    late_s: float  # the joints are those of at most so long after the contact, at the speed of the move


class StopWay(StrEnum):
    """How a request to stop reaches the arm."""

    AT_ONCE = "at once"  # nothing has to end first
    NEXT = "after the transaction in flight"
    BETWEEN_STEPS = "between two steps"  # the robot cannot be stopped over its link: moves go in steps


@dataclass(frozen=True, slots=True)
class RobotAbilities:
    """What an arm can do over its link, as far as a plan must know it."""

    stop: StopWay
    stop_delay_s: float  # longest time from the request to stop until the arm slows down
    contact_delay_s: float  # share of the robot in `Contact.late_s`
    joint_resolution_rad: float  # smallest step of a reading
    linear_moves: bool = False  # it is a `LinearRobot`
    reports_pose: bool = False  # it is a `PoseReporter`
    joint_paths: bool = False  # it is a `PathRobot`


class Robot(Device, Protocol):
    """A jointed arm."""

    @property
    def abilities(self) -> RobotAbilities:
        """What this arm can do."""

    def move_joints(self, target_rad: FloatArray, speed_fraction: float = 1.0) -> None:
        """Return when at rest within the in-position window of the target (joints,).

        Raises MotionStopped after `stop`, DeviceError (not at target, drive fault), DeviceTimeout.
        """

    def read_joints(self, count: int) -> JointReadings:
        """`count` fresh consecutive readings, all sampled after the call."""

    def move_until_contact(
        self, target_rad: FloatArray, speed_rad_s: float, probe: "TouchProbe"
    ) -> Contact | None:
        """Move towards the target until the probe trips; the joints at the first contact.

        None if the target was reached without contact. `speed_rad_s` is of the fastest joint.
        The arm is at rest on return. Raises as `move_joints`.
        """

    def is_at_rest(self) -> bool:
        """All drives report standstill, read afresh."""

    def stop(self) -> None:
        """Request the quickest controlled stop. Safe from any thread, at any time, and twice."""

    def release(self) -> None:
        """Forget an earlier `stop`, so that motion is possible again."""


class LinearRobot(Robot, Protocol):
    """An arm whose controller moves the flange on a straight line."""

    def move_linear(self, base_T_flange: Transform, speed_m_s: float) -> None:
        """Return when at rest at the pose. Raises as `move_joints`."""


class PathRobot(Robot, Protocol):
    """An arm that follows any path in joint space."""

    def follow_path(self, path_rad: FloatArray) -> None:
        """Pass through joint positions (n, joints), evenly spaced in time; at rest at the last on return.

        Raises as `move_joints`.
        """


class PoseReporter(Robot, Protocol):
    """An arm whose controller computes where its flange is, by its own geometry."""

    def read_pose(self) -> Transform:
        """base_T_flange, freshly read. Raises DeviceError, DeviceTimeout, FrameError."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeReadings:
    """Distances along the beam from consecutive measuring cycles of one window."""

    time_s: FloatArray  # (n,) receive time
    distance_m: FloatArray  # (n,) valid readings only
    rejected: int  # cycles that gave an error value (no target, out of range)
    rejected_kinds: tuple[str, ...] = ()  # in words, distinct


class RangeSensor(Device, Protocol):
    """A one-dimensional distance sensor; the beam is the +z axis of its frame."""

    def begin_window(self) -> None:
        """Forget everything received so far."""

    def end_window(self, minimum: int) -> RangeReadings:
        """All cycles measured since `begin_window`, waiting until there are `minimum` (valid or not).

        Raises DeviceTimeout, FrameError.
        """


@dataclass(frozen=True, slots=True, eq=False)
class ForceReadings:
    """Forces and torques at the sensor's origin, from consecutive measuring cycles of one window."""

    time_s: FloatArray  # (n,) receive time
    force_n: FloatArray  # (n, 3)
    torque_nm: FloatArray  # (n, 3)


class ForceSensor(Device, Protocol):
    """A sensor of force and torque in three axes each, in its own frame."""

    def begin_window(self) -> None:
        """Forget everything received so far."""

    def end_window(self, minimum: int) -> ForceReadings:
        """All cycles measured since `begin_window`, waiting until there are `minimum`.

        Raises DeviceTimeout, FrameError.
        """


class TouchProbe(Device, Protocol):
    """A touch-trigger probe: a switch that counts contacts."""

    def arm(self) -> None:
        """Remember the present count. Raises DeviceError if the probe is tripped already."""

    def touched_at_s(self) -> float | None:
        """One poll: the latest instant at which contact can have begun, or None if not touched.

        The driver's clock; the instant lies at most `poll_uncertainty_s` after the contact.
        """

    @property
    def poll_uncertainty_s(self) -> float:
        """Longest time between contact and its detection when polled as fast as the link allows."""

    def is_open(self) -> bool:
        """The stylus touches nothing now, read afresh."""


class Search(Protocol):
    """Finds a device whose port has no fixed name."""

    def connect(self, device: Device) -> Identity:
        """Connect the device wherever it is. Raises DeviceError."""


@dataclass(frozen=True, slots=True)
class Devices:
    """The devices of one cell by role; `searches` are of those roles that must be looked for.

    `statistics` tells what each of their links has seen, by its name.
    """

    robot: Robot
    laser: RangeSensor
    probe: TouchProbe
    searches: Mapping[str, Search] = field(default_factory=dict)
    statistics: Callable[[], Mapping[str, LinkStatistics]] = dict

    def connect(self, device: Device) -> Identity:
        """Connect one of the devices, where it is or wherever it is found. Raises DeviceError."""
        for role, search in self.searches.items():
            if getattr(self, role) is device:
                return search.connect(device)
        return device.connect()

    def all(self) -> Sequence[Device]:
        """In the order in which they are connected."""
        return (self.robot, self.laser, self.probe)

    def by_role(self) -> Mapping[str, Device]:
        """In the same order, by name."""
        return {"robot": self.robot, "laser": self.laser, "probe": self.probe}

    def counters(self) -> dict[str, dict[str, Any]]:
        """`devices`: what each driver has counted; `links`: what each link has seen."""
        return {
            "devices": {role: asdict(device.health()) for role, device in self.by_role().items()},
            "links": {name: asdict(seen) for name, seen in self.statistics().items()},
        }
