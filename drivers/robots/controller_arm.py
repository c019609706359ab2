"""The Robot capability of an arm behind a controller of its own, whatever protocol it speaks.

What must be right for all of them is here: targets inside the limits, waiting until motion has really ended,
stopping, and touching. See `robot_controller` for what their protocols have in common.
"""

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

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
from drivers.robots.joint_limits import within_limits
from drivers.robots.motion_profile import synchronize
from drivers.robots.rest import only_still_moving
from drivers.robots.robot_controller import ControllerArmConfig, RobotController
from estimation.errors import DeviceError, DeviceTimeout, MotionStopped, StillMoving
from estimation.transform import FloatArray, Transform

TOUCH_WATCH_S: Final = 0.5  # between two looks at the controller while a probe is polled
UNDER_WAY_S: Final = 0.1  # between two looks at an arm that may be moving
REST_TIMEOUT_S: Final = 5.0
IN_POSITION_M: Final = 5e-4  # of the flange after a linear move, as a coarse controller reports it
ELSEWHERE_S: Final = 0.5  # an arm that stands elsewhere for so long does so, whatever the noise of a reading
NOISE_STEPS: Final = 1.5  # two readings of one place differ by noise and by one step of the reading


@dataclass(slots=True, eq=False)
class _Move:
    """A move under way."""

    is_there: Callable[[FloatArray], bool]  # of joints at rest
    elsewhere: Callable[[FloatArray], DeviceError]  # what to say of joints at rest beside the target
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
        """Open the links, compare the identity, bring the arm to rest, and unless stopped enable the motors.

        Raises DeviceError, DeviceTimeout, IdentityMismatch, StillMoving.
        """
        with self._exchange:
            self._connected = self._enabled = False
            identity = self._controller.connect()
            self._connected, self._halted = True, False
            if self._is_under_way():
                self._halt()
                self._wait_for_rest()
            if not self._stop_requested:
                self._enable()
        return identity

    def _is_under_way(self) -> bool:
        """With a move of before, whose stop may have been lost; a robot without a stop ends it by itself.

        By its joints: a controller tells only of moves that it knows, and of none with its motors off.
        """
        if self.abilities.stop is StopWay.BETWEEN_STEPS:
            return False
        first = self.read_joints(1).joints_rad[0]
        self._clock.sleep(UNDER_WAY_S)
        return not self._stands(first, self.read_joints(1).joints_rad[0])

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
        target = within_limits(target_rad, self._lower, self._upper)
        speed_rad_s = self._config.speed_limit_rad_s * speed_fraction
        with self._at_rest_on_error():
            for step in self._steps(target, self._config.step_rad):
                self._wait_until_arrived(self._start(step, speed_rad_s))

    def move_linear(self, base_T_flange: Transform, speed_m_s: float) -> None:
        """Move the flange on a straight line; returns at rest at the pose.

        `speed_m_s` is of the flange. Raises as `move_joints`, and what the controller says of a pose that it
        cannot reach.
        """
        if not speed_m_s > 0.0:
            raise DeviceError(f"Speed {speed_m_s:g} m/s", "Give a speed above 0")
        with self._at_rest_on_error():
            for pose in self._poses_on_line(base_T_flange, speed_m_s):
                self._wait_until_arrived(self._start_line(pose, speed_m_s))

    def read_pose(self) -> Transform:
        """base_T_flange as the controller computes it, by its own geometry."""
        with self._asking():
            return self._controller.read_pose()

    def move_until_contact(
        self, target_rad: FloatArray, speed_rad_s: float, probe: TouchProbe
    ) -> Contact | None:
        """Move towards the target until the probe trips; the joints at the contact.

        They are those at the instant of contact where the controller stamps its readings, otherwise those at
        rest after the stop, or after the step in which the contact was; `late_s` says what that may mean.
        """
        target = within_limits(target_rad, self._lower, self._upper)
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
            here = self._ready()
            started_s = self._clock.now_s()
            self._controller.start_move(target, speed_rad_s)
        limits = np.ones_like(target)
        move = synchronize(
            target - here, limits * speed_rad_s, limits * self._config.acceleration_limit_rad_s2
        )
        return _Move(
            lambda joints: self._is_at(target, joints),
            lambda joints: self._not_at_target(joints, target),
            started_s,
            self._clock.now_s() + move.duration_s,
        )

    def _start_line(self, pose: Transform, speed_m_s: float) -> _Move:
        with self._asking():
            self._ready()
            away_m = float(np.linalg.norm(pose.origin_m - self._controller.read_pose().origin_m))
            started_s = self._clock.now_s()
            self._controller.start_linear(pose, speed_m_s)

        def beside_m() -> float:
            return float(np.linalg.norm(self.read_pose().origin_m - pose.origin_m))

        return _Move(
            lambda joints: beside_m() <= IN_POSITION_M,
            lambda joints: DeviceError(
                f"The flange is {beside_m() * 1e3:.2f} mm beside its target, "
                f"window {IN_POSITION_M * 1e3:g} mm",
                "Check for an obstacle, a singular posture and the payload, then reset",
            ),
            started_s,
            self._clock.now_s() + away_m / speed_m_s,
        )

    def _ready(self) -> FloatArray:
        """Make motion possible, unless a stop was requested; where the joints are."""
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
        return here

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
                if move.is_there(second):
                    return move.seen or now >= move.started_s + config.start_gap_s
                move.elsewhere_s = min(move.elsewhere_s, now)
                ended = move.seen or now >= move.started_s + config.move_margin_s
                if ended and now >= move.elsewhere_s + ELSEWHERE_S:
                    raise move.elsewhere(second)
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

    def _poses_on_line(self, base_T_flange: Transform, speed_m_s: float) -> Iterator[Transform]:
        """Where the robot cannot be stopped: so far apart as it may go on after a request to stop."""
        abilities = self.abilities
        if abilities.stop is StopWay.BETWEEN_STEPS:
            here = self.read_pose()
            away_m = float(np.linalg.norm(base_T_flange.origin_m - here.origin_m))
            count = int(np.ceil(away_m / (speed_m_s * abilities.stop_delay_s)))
            turn = Rotation.from_matrix(here.rotation.T @ base_T_flange.rotation).as_rotvec()
            for share in np.arange(1, count) / max(count, 1):
                matrix = np.eye(4)
                matrix[:3, :3] = here.rotation @ Rotation.from_rotvec(share * turn).as_matrix()
                matrix[:3, 3] = here.origin_m + share * (base_T_flange.origin_m - here.origin_m)
                yield Transform("base", "flange", matrix)
        yield base_T_flange

    def _wait_for_rest(self) -> None:
        deadline_s = self._clock.now_s() + REST_TIMEOUT_S
        while not self.is_at_rest():
            if self._clock.now_s() > deadline_s:
                raise StillMoving(
                    f"The arm is not at rest {REST_TIMEOUT_S:g} s after it was stopped",
                    "Use the emergency stop and check the brakes",
                )
            self._clock.sleep(self._config.poll_period_s)

    @contextlib.contextmanager
    def _at_rest_on_error(self) -> Iterator[None]:
        """Whatever ends a move early, the arm is at rest before the error is raised.

        Raises StillMoving when it is not.
        """
        try:
            yield
        except BaseException as error:
            if self._connected:
                with contextlib.suppress(DeviceError), self._asking():
                    self._halt()  # also after a stop: it may have overtaken the start of the move
                with only_still_moving(error):
                    self._wait_for_rest()
            raise

    # --- judging -------------------------------------------------------------------------------------

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
