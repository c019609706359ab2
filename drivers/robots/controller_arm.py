"""The Robot capability of an arm behind a controller of its own, whatever protocol it speaks.

A driver for such an arm is a `RobotController`: the exchanges that its protocol has. What must be right for
all of them is here: targets inside the limits, waiting until motion has really ended, stopping, and touching.
"""

import contextlib
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from drivers.capabilities import (
    Contact,
    Identity,
    JointReadings,
    LinkHealth,
    RobotAbilities,
    StopWay,
    TouchProbe,
)
from drivers.clock import Clock
from drivers.robots.motion_profile import synchronize
from estimation.errors import DeviceError, DeviceTimeout, MotionStopped
from estimation.transform import FloatArray

TOUCH_WATCH_S: Final = 0.5  # between two looks at the controller while a probe is polled
REST_TIMEOUT_S: Final = 5.0
ELSEWHERE_S: Final = 0.5  # an arm that stands elsewhere for so long does so, whatever the noise of a reading
NOISE_STEPS: Final = 1.5  # two readings of one place differ by noise and by one step of the reading


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

    def halt(self) -> None:
        """Ask for the quickest controlled stop. Never called of a controller that cannot."""

    def recover(self) -> None:
        """After a halt: make motion possible again."""

    def contact_at(self, touched_s: float, late_s: float) -> Contact | None:
        """The joints at a past instant, if readings are stamped well enough to know them."""


@dataclass(slots=True, eq=False)
class _Move:
    """A move under way."""

    target: FloatArray
    started_s: float
    expected_s: float  # when it should have ended
    seen: bool = False  # the controller has said that it moves
    elsewhere_s: float = math.inf  # since when it stands beside its target


class ControllerArm:
    """`stop` may be called from any thread; everything else from one thread at a time."""

    def __init__(self, controller: RobotController, config: ControllerArmConfig, clock: Clock) -> None:
        self._controller, self._config, self._clock = controller, config, clock
        self._lower, self._upper = np.array(config.lower_rad), np.array(config.upper_rad)
        resolution_rad = controller.abilities.joint_resolution_rad
        self._apart_rad = NOISE_STEPS * resolution_rad + 6.0 * config.reading_noise_rad
        self._exchange = threading.RLock()  # one question at a time
        self._stop_requested = self._stop_pending = self._halted = False
        self._connected = self._enabled = False

    # --- Device --------------------------------------------------------------------------------------

    def connect(self) -> Identity:
        """Open the links, compare the identity, and unless a stop is requested enable the motors.

        Raises DeviceError, DeviceTimeout, IdentityMismatch.
        """
        with self._exchange:
            self._connected = self._enabled = False
            identity = self._controller.connect()
            if not self._stop_requested:
                self._enable()
            self._connected, self._halted = True, False
        return identity

    def _enable(self) -> None:
        self._controller.enable()
        self._enabled = True

    def close(self) -> None:
        """Bring the arm to rest and release the links; safe twice."""
        with self._exchange:
            if self._connected:
                with contextlib.suppress(DeviceError):
                    if self._controller.is_moving():
                        self._halt()
                        self._wait_for_rest()
                self._connected = False
            self._controller.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        return self._controller.health()

    # --- Robot ---------------------------------------------------------------------------------------

    @property
    def abilities(self) -> RobotAbilities:
        """What this arm can do."""
        return self._controller.abilities

    def move_joints(self, target_rad: FloatArray, speed_fraction: float = 1.0) -> None:
        """Move in joint space; returns at rest within the in-position window.

        Raises MotionStopped, DeviceError (outside limits, not at target, controller in error), DeviceTimeout.
        """
        if not 0.0 < speed_fraction <= 1.0:
            raise DeviceError(f"Speed fraction {speed_fraction:g}", "Give a fraction in (0, 1]")
        target, speed_rad_s = self._checked(target_rad), self._config.speed_limit_rad_s * speed_fraction
        with self._at_rest_on_error():
            for step in self._steps(target, self._config.step_rad):
                self._wait_until_arrived(self._start(step, speed_rad_s))

    def move_until_contact(
        self, target_rad: FloatArray, speed_rad_s: float, probe: TouchProbe
    ) -> Contact | None:
        """Move towards the target until the probe trips; the joints at the contact.

        They are those at the instant of contact where the controller stamps its readings, otherwise those at
        rest after the stop, or after the step in which the contact was; `late_s` says what that may mean.
        """
        target = self._checked(target_rad)
        speed_rad_s = min(speed_rad_s, self._config.speed_limit_rad_s)
        with self._at_rest_on_error():
            if self.abilities.stop is StopWay.BETWEEN_STEPS:
                return self._step_until_contact(target, speed_rad_s, probe)
            touched_s = self._watch(self._start(target, speed_rad_s), probe)
            if touched_s is None:
                return None
            with self._asking():
                self._halt()
            halted_s = self._clock.now_s()
            late_s = probe.poll_uncertainty_s + (halted_s - touched_s) + self.abilities.contact_delay_s
            contact = self._controller.contact_at(touched_s, probe.poll_uncertainty_s)
            self._wait_for_rest()
            return contact or Contact(self.read_joints(1).joints_rad[0], 1.0, late_s)

    def read_joints(self, count: int) -> JointReadings:
        """`count` fresh consecutive readings."""
        times_s, joints = np.zeros(count), list[FloatArray]()
        for i in range(count):
            with self._asking():
                times_s[i], reading = self._controller.read_joints()
            joints.append(reading)
        return JointReadings(times_s, np.array(joints))

    def is_at_rest(self) -> bool:
        """The controller says so, and two fresh readings agree."""
        with self._asking():
            if self._controller.is_moving():
                return False
        return self._stands(*self.read_joints(2).joints_rad)

    def stop(self) -> None:
        """Ask for the quickest stop; safe from any thread, at any time, and twice.

        A robot with one channel is asked after the transaction in flight, one without a stop ends its step.
        """
        self._stop_requested = True
        if not self._connected:
            return
        way = self.abilities.stop
        if way is StopWay.AT_ONCE:
            with contextlib.suppress(DeviceError):
                self._halt()
        elif way is StopWay.NEXT:
            self._stop_pending = True
            with contextlib.suppress(DeviceError), self._asking():
                pass

    def release(self) -> None:
        """Forget an earlier `stop`."""
        self._stop_requested = self._stop_pending = False

    # --- exchanges -----------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _asking(self) -> Iterator[None]:
        """Exclusive use of the link; a stop that waits for it goes first."""
        if not self._connected:
            raise DeviceError("The robot is not connected", "Connect it first")
        with self._exchange:
            if self._stop_pending:
                self._stop_pending = False
                self._halt()
            yield

    def _halt(self) -> None:
        if self.abilities.stop is not StopWay.BETWEEN_STEPS:
            self._halted = True
            self._controller.halt()

    # --- moving --------------------------------------------------------------------------------------

    def _start(self, target: FloatArray, speed_rad_s: float) -> _Move:
        """Hand over a move."""
        with self._asking():
            if self._stop_requested:
                raise self._stopped()
            if not self._enabled:
                self._enable()
            if self._halted:
                self._controller.recover()
                self._halted = False
            if self._controller.is_moving():
                raise DeviceError(
                    "The robot moves although it was not told to",
                    "Check that nobody else commands it, then reset",
                )
            _, here = self._controller.read_joints()
            if self._stop_requested:
                raise self._stopped()
            started_s = self._clock.now_s()
            self._controller.start_move(target, speed_rad_s)
        limits = np.ones_like(target)
        move = synchronize(
            target - here, limits * speed_rad_s, limits * self._config.acceleration_limit_rad_s2
        )
        return _Move(target, started_s, self._clock.now_s() + move.duration_s)

    def _wait_until_arrived(self, move: _Move) -> None:
        while not self._has_arrived(move):
            self._clock.sleep(self._config.poll_period_s)

    def _has_arrived(self, move: _Move) -> bool:
        """One look: the arm has moved and stands at the target. Raises if it cannot get there any more.

        A controller that says "not moving" right after it took a move may not have begun yet.
        """
        if self._stop_requested:
            raise self._stopped()
        with self._asking():
            moving = self._controller.is_moving()
        now, config = self._clock.now_s(), self._config
        move.seen = move.seen or moving
        if not moving:
            first, second = self.read_joints(2).joints_rad
            if self._stands(first, second):
                if self._is_at(move.target, second):
                    return move.seen or now >= move.started_s + config.start_gap_s
                move.elsewhere_s = min(move.elsewhere_s, now)
                ended = move.seen or now >= move.started_s + config.move_margin_s
                if ended and now >= move.elsewhere_s + ELSEWHERE_S:
                    raise self._not_at_target(second, move.target)
        if now > move.expected_s + config.move_margin_s:
            raise DeviceTimeout(
                f"The robot still moves {config.move_margin_s:g} s after its move should have ended",
                "Check the speed override at the robot, then reset",
            )
        return False

    def _watch(self, move: _Move, probe: TouchProbe) -> float | None:
        """Poll the probe until it has touched (when), or the arm stands at the target (None)."""
        look_s = self._clock.now_s() + TOUCH_WATCH_S
        while (touched_s := probe.touched_at_s()) is None:
            if self._stop_requested:
                raise self._stopped()
            if (now := self._clock.now_s()) >= min(look_s, move.expected_s):
                if self._has_arrived(move):
                    return probe.touched_at_s()
                pause_s = TOUCH_WATCH_S if now < move.expected_s else self._config.poll_period_s
                look_s, move.expected_s = now + pause_s, max(move.expected_s, now + pause_s)
        return touched_s

    def _step_until_contact(
        self, target: FloatArray, speed_rad_s: float, probe: TouchProbe
    ) -> Contact | None:
        """In steps of `contact_delay_s` at this speed, each to rest; the contact lies in the last one."""
        step_s = self.abilities.contact_delay_s
        for step in self._steps(target, speed_rad_s * step_s):
            self._wait_until_arrived(self._start(step, speed_rad_s))
            if probe.touched_at_s() is not None:
                return Contact(self.read_joints(1).joints_rad[0], 1.0, step_s)
        return None

    def _steps(self, target: FloatArray, longest_rad: float) -> Iterator[FloatArray]:
        """Points on the way to the target, so far apart at most; the last is the target."""
        if longest_rad > 0.0:
            here = self.read_joints(1).joints_rad[0]
            count = int(np.ceil(np.max(np.abs(target - here)) / longest_rad))
            for i in range(1, count):
                yield here + (target - here) * (i / count)
        yield target

    def _wait_for_rest(self) -> None:
        deadline_s = self._clock.now_s() + REST_TIMEOUT_S
        while not self.is_at_rest():
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeout(
                    f"The arm is not at rest {REST_TIMEOUT_S:g} s after it was stopped",
                    "Use the emergency stop and check the brakes",
                )
            self._clock.sleep(self._config.poll_period_s)

    @contextlib.contextmanager
    def _at_rest_on_error(self) -> Iterator[None]:
        """Whatever ends a move early, the arm is at rest before the error is raised."""
        try:
            yield
        except BaseException:
            if self._connected:
                with contextlib.suppress(DeviceError):  # the first error names the cause
                    with self._asking():
                        self._halt()  # also after a stop: it may have overtaken the start of the move
                    self._wait_for_rest()
            raise

    # --- judging -------------------------------------------------------------------------------------

    def _checked(self, target_rad: FloatArray) -> FloatArray:
        target = np.asarray(target_rad, dtype=np.float64)
        if target.shape != self._lower.shape or not np.isfinite(target).all():
            raise DeviceError(
                f"Joint target of shape {target.shape} with values {target}",
                f"Give {len(self._lower)} finite angles",
            )
        outside = np.flatnonzero((target < self._lower) | (target > self._upper))
        if outside.size:
            i = int(outside[0])
            low, value, high = np.degrees((self._lower[i], target[i], self._upper[i]))
            raise DeviceError(
                f"Target of joint {i + 1} is {value:.3f} deg, limits {low:.3f} to {high:.3f} deg",
                "Choose a pose inside the joint limits",
            )
        return target

    def _stands(self, first: FloatArray, second: FloatArray) -> bool:
        return bool((np.abs(second - first) <= self._apart_rad).all())

    def _is_at(self, target: FloatArray, joints: FloatArray) -> bool:
        return bool((np.abs(joints - target) <= self._config.in_position_rad).all())

    def _not_at_target(self, joints: FloatArray, target: FloatArray) -> DeviceError:
        worst = int(np.argmax(np.abs(joints - target)))
        is_at, wanted, window = np.degrees((joints[worst], target[worst], self._config.in_position_rad))
        return DeviceError(
            f"Joint {worst + 1} is at {is_at:.3f} deg instead of {wanted:.3f} deg, window {window:.3f} deg",
            "Check for an obstacle, the payload and the speed, then reset",
        )

    @staticmethod
    def _stopped() -> MotionStopped:
        return MotionStopped(
            "The arm was stopped on request before its target", "Release the stop when motion is safe again"
        )
