"""What the protocols of arms behind a controller of their own have in common.

A driver for such an arm is a `RobotController`: the exchanges that its protocol has; `ControllerArm` does
the rest.
"""

from dataclasses import dataclass
from typing import Protocol

from drivers.capabilities import Contact, Identity, LinkHealth, RobotAbilities
from estimation.transform import FloatArray, Transform


@dataclass(frozen=True, slots=True)
class ControllerArmConfig:
    """Settings of one arm; per-joint tuples from the base outwards."""

    lower_rad: tuple[float, ...]
    upper_rad: tuple[float, ...]
    speed_limit_rad_s: float  # of the fastest joint
    acceleration_limit_rad_s2: float  # to compute how long a move takes
    in_position_rad: float
    reading_noise_rad: float = 0.0  # standard deviation of one reading
    poll_period_s: float = 0.02  # between two looks at a moving arm
    start_gap_s: float = 0.1  # a controller may say "not moving" for so long after it took a move
    move_margin_s: float = 3.0  # allowed on top of the computed duration of a move
    step_rad: float = 0.0  # longest move between two chances to stop; 0 where the arm can be stopped


class RobotController(Protocol):
    """One robot controller as its protocol shows it. Methods are called from one thread at a time.

    Only `halt` of a controller that stops `AT_ONCE` is called from any thread. All raise DeviceError,
    DeviceTimeout, FrameError.
    """

    @property
    def abilities(self) -> RobotAbilities:
        """What the protocol allows."""

    def connect(self) -> Identity:
        """Open the links and compare the identity; nothing of the robot is changed."""

    def enable(self) -> None:
        """Take control and enable the motors; no motion."""

    def close(self) -> None:
        """Give back control and release the links; safe twice."""

    def health(self) -> LinkHealth:
        """Link counters."""

    def read_joints(self) -> tuple[float, FloatArray]:
        """One fresh reading: its time on the driver's clock, and the joints (n,), rad."""

    def is_moving(self) -> bool:
        """Whether the arm moves, read afresh. Raises DeviceError if the controller is in error."""

    def start_move(self, target_rad: FloatArray, speed_rad_s: float) -> None:
        """Hand over a joint move whose fastest joint has this speed; it may end before this returns."""

    def start_linear(self, base_T_flange: Transform, speed_m_s: float) -> None:
        """Likewise on a straight line of the flange."""

    def read_pose(self) -> Transform:
        """base_T_flange as the controller computes it."""

    def halt(self) -> None:
        """Ask for the quickest controlled stop. Never called of a controller that cannot."""

    def recover(self) -> None:
        """After a halt: make motion possible again."""

    def contact_at(self, touched_s: float, late_s: float) -> Contact | None:
        """The joints at a past instant, if readings are stamped well enough to know them."""
