"""Universal Robots: state by RTDE, motion by URScript, power and identity by the dashboard server.

Every program writes its number into two registers, when it begins and when it ends, so that RTDE tells which
program the controller is at: a program that it did not take is never mistaken for one that has ended.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.capabilities import Contact, Identity, LinkHealth, RobotAbilities, StopWay
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.robots import ur_codec as codec
from drivers.robots.ur_rtde import Received, RtdeConnection
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray, Transform

POWER_TIMEOUT_S: Final = 30.0
LINE_ACCELERATION_M_S2: Final = 1.2
LONGEST_LINE: Final = 1024  # of the dashboard


@dataclass(frozen=True, slots=True)
class UrConfig:
    """Settings of one controller."""

    acceleration_rad_s2: float  # of the leading joint, also when it stops
    joint_step_rad: float = 1e-6  # smallest step of a reading
    model: str = ""  # as the dashboard says it; "" does not compare
    serial_number: str = ""  # likewise
    rate_hz: float = 125.0  # of data packages
    register: int = 24  # output integer register; this one and the next count programs
    reply_timeout_s: float = 0.3
    start_timeout_s: float = 1.0  # from sending a program until it begins
    stop_delay_s: float = 0.1  # longest, from the request until the arm slows down


@dataclass(frozen=True, slots=True)
class UrLinks:
    """The three connections to one controller."""

    rtde: ByteLink
    script: ByteLink
    dashboard: ByteLink


class Dashboard:
    """Commands and answers, one line each."""

    def __init__(self, link: ByteLink, clock: Clock, reply_timeout_s: float) -> None:
        self._link, self._clock, self._reply_timeout_s = link, clock, reply_timeout_s
        self._buffer = b""

    def open(self) -> None:
        """Connect; nothing of an earlier connection is left."""
        self._link.reopen()
        self._buffer = b""

    def close(self) -> None:
        """Leave; safe twice."""
        self._link.close()

    def ask(self, command: str) -> str:
        """The answer to a command. Raises DeviceError, DeviceTimeout, FrameError."""
        self._refuse_strays()
        self._link.write(command.encode("ascii") + b"\n")
        deadline_s = self._clock.now_s() + self._reply_timeout_s
        while True:
            line, end, rest = self._buffer.partition(b"\n")
            if end:
                self._buffer = rest
                text = line.decode("utf-8", errors="replace").strip()
                if text and not text.startswith(codec.GREETING):
                    return text
                continue
            remaining_s = deadline_s - self._clock.now_s()
            data = self._link.read(max(remaining_s, 0.0))
            self._buffer = (self._buffer + data)[-LONGEST_LINE:]
            if remaining_s <= 0.0 and b"\n" not in self._buffer:  # also on a line that never falls silent
                raise DeviceTimeout(  # what comes later is a stray
                    f"The dashboard did not answer {command!r} within {self._reply_timeout_s:g} s",
                    "Check network cable and power of the controller",
                )

    def _refuse_strays(self) -> None:
        """A line that answers nothing would be taken for the answer to the next command."""
        lines = (self._buffer + self._link.read(0.0)).split(b"\n")
        greeting = codec.GREETING.encode()
        if strays := [line for line in lines if line.strip() and not line.startswith(greeting)]:
            self._buffer = b""
            raise FrameError(
                f"The dashboard sent {strays[0][:40]!r} without being asked",
                "Reset; check the network if it recurs",
            )


class UrController:
    """A `RobotController`. A stop is a program of its own, which takes the place of the one that moves."""

    def __init__(self, links: UrLinks, config: UrConfig, clock: Clock) -> None:
        self._config, self._clock, self._script = config, clock, links.script
        recipe = codec.Recipe(config.register)
        self._rtde = RtdeConnection(
            links.rtde, recipe, clock, rate_hz=config.rate_hz, reply_timeout_s=config.reply_timeout_s
        )
        self._dashboard = Dashboard(links.dashboard, clock, config.reply_timeout_s)
        self._sending = threading.Lock()  # programs are numbered in the order in which they are sent
        self._number, self._sent_s = 0, 0.0
        self._watching = False  # a move is under way, and its packages are kept

    @property
    def abilities(self) -> RobotAbilities:
        """A contact is interpolated between packages, whose time is known to one package period."""
        return RobotAbilities(
            StopWay.AT_ONCE,
            stop_delay_s=self._config.stop_delay_s,
            contact_delay_s=1.0 / self._config.rate_hz,
            joint_resolution_rad=self._config.joint_step_rad,
            linear_moves=True,
            reports_pose=True,
        )

    def connect(self) -> Identity:
        """Identity and state. Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch."""
        self._dashboard.open()
        identity = self._identify()
        self._rtde.open()
        return identity

    def enable(self) -> None:
        """Power, brakes; a program that does nothing proves that programs are taken.

        Raises DeviceError, DeviceTimeout, FrameError.
        """
        self._release_brakes()
        self._watching = False
        self._number = self._rtde.fresh().package.begun
        self._run([codec.TCP_IS_FLANGE])
        while self.is_moving():
            pass

    def close(self) -> None:
        """Release the connections; safe twice. The motors stay on and hold the arm."""
        for link in (self._rtde, self._script, self._dashboard):
            link.close()

    def health(self) -> LinkHealth:
        """Counters of the RTDE connection."""
        rtde = self._rtde
        return LinkHealth(rtde.frames, rtde.bad_frames, rtde.timeouts, max(0, rtde.opened - 1))

    def read_joints(self) -> tuple[float, FloatArray]:
        """A package sampled after the call."""
        received = self._fresh()
        return received.time_s, received.package.joints_rad

    def read_pose(self) -> Transform:
        """base_T_flange as the controller computes it; its tool is the flange since `enable`."""
        pose = self._fresh().package.base_T_tcp
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
        matrix[:3, 3] = pose[:3]
        return Transform("base", "flange", matrix)

    def is_moving(self) -> bool:
        """Whether the last program has not ended. Raises DeviceError if it cannot, or was not taken."""
        package = self._fresh().package
        if package.obstacle:
            self._watching = False
            raise DeviceError(f"The robot cannot move: {package.obstacle}", "Remove the cause, then reset")
        if package.begun == self._number:
            self._watching = self._watching and package.ended != self._number and package.program_runs
            return package.ended != self._number and package.program_runs
        if self._clock.now_s() > self._sent_s + self._config.start_timeout_s:
            raise DeviceTimeout(
                f"The controller did not begin a program within {self._config.start_timeout_s:g} s",
                "Switch it to remote control and check the register for truecell, then reset",
            )
        return True

    def start_move(self, target_rad: FloatArray, speed_rad_s: float) -> None:
        """A program of one joint move."""
        move = codec.move_joints(target_rad, speed_rad_s, self._config.acceleration_rad_s2)
        self._rtde.stream()
        self._watching = True
        self._run([move])

    def start_linear(self, base_T_flange: Transform, speed_m_s: float) -> None:
        """Likewise on a straight line."""
        rotation = Rotation.from_matrix(base_T_flange.rotation).as_rotvec()
        pose = np.concatenate([base_T_flange.origin_m, rotation])
        self._rtde.stream()
        self._watching = True
        self._run([codec.move_linear(pose, speed_m_s, LINE_ACCELERATION_M_S2)])

    def halt(self) -> None:
        """Safe from any thread: over the connection by which the move was sent."""
        with self._sending:
            self._send([codec.stop_joints(self._config.acceleration_rad_s2)])

    def recover(self) -> None:
        """Nothing: the stop was a program that has ended."""

    def contact_at(self, touched_s: float, late_s: float) -> Contact | None:
        """The joints between two packages, one period after the contact was noticed at the latest.

        A package may have been sampled up to one period before its time on our clock.
        None if the move had ended before.
        """
        if not self._watching:
            return None
        period_s = 1.0 / self._config.rate_hz
        instant_s = touched_s + period_s
        self._rtde.until(instant_s)
        before, after = self._around(instant_s)
        span_s = after.time_s - before.time_s
        part = (instant_s - before.time_s) / span_s if span_s > 0.0 else 1.0
        part = min(max(part, 0.0), 1.0)
        joints = (1.0 - part) * before.package.joints_rad + part * after.package.joints_rad
        return Contact(joints, 1.0 / ((1.0 - part) ** 2 + part**2), late_s + period_s)

    # --- programs --------------------------------------------------------------------------------------

    def _run(self, statements: Sequence[str]) -> None:
        """On a new connection, because nobody reads what the controller says on it."""
        with self._sending:
            self._script.reopen()
            self._send(statements)

    def _send(self, statements: Sequence[str]) -> None:
        self._number += 1
        self._sent_s = self._clock.now_s()
        begun = codec.set_register(self._config.register, self._number)
        ended = codec.set_register(self._config.register + 1, self._number)
        self._script.write(codec.program("truecell", [begun, *statements, ended]))

    def _fresh(self) -> Received:
        return self._rtde.fresh(keep_streaming=self._watching)

    def _around(self, instant_s: float) -> tuple[Received, Received]:
        received = list(self._rtde.received)
        after = next(i for i, one in enumerate(received) if one.time_s >= instant_s)
        return received[max(after - 1, 0)], received[after]

    # --- connecting ------------------------------------------------------------------------------------

    def _identify(self) -> Identity:
        config, ask = self._config, self._dashboard.ask
        model, serial, software = ask("get robot model"), ask("get serial number"), ask("PolyscopeVersion")
        for what, found, expected in (
            ("model", model, config.model),
            ("serial number", serial, config.serial_number),
        ):
            if expected and found != expected:
                raise IdentityMismatch(
                    f"The controller answers {what} {found!r}, the cell file says {expected!r}",
                    "Check host and port, or correct the cell file and calibrate again",
                )
        return Identity(model, serial, software)

    def _release_brakes(self) -> None:
        ask, clock = self._dashboard.ask, self._clock
        safety = codec.value_of(ask("safetystatus"), "Safetystatus")
        if safety == "PROTECTIVE_STOP":
            ask("close safety popup")
            answer = ask("unlock protective stop")
            if not answer.startswith("Protective stop releasing"):
                raise DeviceError(f"The protective stop stays: {answer}", "Inspect the robot, then reset")
        elif safety not in ("NORMAL", "REDUCED"):
            words = safety.lower().replace("_", " ")
            raise DeviceError(f"The robot is in {words}", "Release it at the robot, then reset")
        deadline_s = clock.now_s() + POWER_TIMEOUT_S
        while (mode := codec.value_of(ask("robotmode"), "Robotmode")) != codec.MODES[codec.MODE_RUNNING]:
            if clock.now_s() > deadline_s:
                raise DeviceTimeout(
                    f"The robot is in mode {mode} after {POWER_TIMEOUT_S:g} s, expected RUNNING",
                    "Check the pendant for a message, then reset",
                )
            if mode == "POWER_OFF":
                ask("power on")
            elif mode == "IDLE":
                ask("brake release")
            clock.sleep(0.2)
