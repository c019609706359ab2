"""Mitsubishi MELFA controllers over the R-protocol, by RS-232 or TCP.

Nothing in the protocol ties an answer to its command: after a timeout the line stays silent for longer than
an answer may take, drains, and asks for the state before anything else counts.
"""

import contextlib
import math
from dataclasses import dataclass
from typing import Final

from scipy.spatial.transform import Rotation

from drivers.capabilities import Contact, Identity, LinkHealth, RobotAbilities, StopWay
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.robots import melfa_codec as codec
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray, Transform

RESOLUTION_RAD: Final = math.radians(0.01)  # two decimals of a degree
CLIENT_NAME: Final = "TRUECELL"
JOINT_TARGET: Final = "JTARGET"
POSE_TARGET: Final = "PTARGET"
SERVO_TIMEOUT_S: Final = 8.0


@dataclass(frozen=True, slots=True)
class MelfaConfig:
    """Settings of one controller; what the manual leaves open is a setting."""

    max_speed_rad_s: float  # of the fastest joint at 100 %
    model: str = ""  # expected in the answer to OPEN; "" does not compare
    robot: int = 1
    slot: int = 1
    terminator: str = "CR"  # of codec.TERMINATORS
    program: str = ""  # an empty program that the slot needs before EXEC; "" loads none
    reply_timeout_s: float = 0.5
    quiet_s: float = 0.03  # ends an answer where there is no terminator
    running_pause_s: float = 0.1  # between an answer and the next command while a program runs
    tries: int = 2  # of questions; a command that moves is never repeated
    stop_delay_s: float = 0.15  # longest, from STOP until the arm slows down


class MelfaLine:
    """One session: a command, and the answer to it."""

    def __init__(self, link: ByteLink, config: MelfaConfig, clock: Clock) -> None:
        self._link, self._config, self._clock = link, config, clock
        self._terminator = codec.TERMINATORS[config.terminator]
        self._lines = codec.AnswerLines(self._terminator)
        self._out_of_step, self._next_s, self._opened = False, -math.inf, 0
        self.running = False  # as seen last: how soon the next command may come
        self.frames = self.timeouts = 0

    @property
    def bad_frames(self) -> int:
        """Lines that were no answers."""
        return self._lines.bad_frames

    @property
    def reconnects(self) -> int:
        """How often the session was opened again."""
        return max(0, self._opened - 1)

    def open(self) -> codec.ControllerInfo:
        """Open the link and the session."""
        self._link.reopen()
        self._opened += 1
        self._lines.clear()
        self._out_of_step = self.running = False
        return codec.parse_info(self.ask(f"OPEN={CLIENT_NAME}").text)

    def close(self) -> None:
        """End the session; safe twice."""
        self._link.close()

    def ask(self, command: str, *, repeat: bool = True) -> codec.Answer:
        """The answer to a command. Raises MelfaRefusal, DeviceTimeout, FrameError."""
        self._listen()
        if command == "STOP" and self._out_of_step:
            self._link.write(self._encoded(command))  # at once; that it was heard is proven below
        for _ in range(self._config.tries - 1 if repeat else 0):
            with contextlib.suppress(DeviceTimeout, FrameError):
                return self._attempt(command)
        return self._attempt(command)

    def _attempt(self, command: str) -> codec.Answer:
        try:
            self._resynchronise()
            return self._exchange(command)
        except (DeviceTimeout, FrameError):
            self._out_of_step = True
            raise

    def _exchange(self, command: str) -> codec.Answer:
        config, now_s = self._config, self._clock.now_s
        if self.running and not command.startswith("STOP"):
            self._clock.sleep(self._next_s - now_s())
        self._link.write(self._encoded(command))
        deadline_s = now_s() + config.reply_timeout_s
        while (answer := self._lines.next_line()) is None:
            remaining_s = deadline_s - now_s()
            data = self._link.read(max(remaining_s, 0.0))
            self._lines.feed(data)
            if not self._terminator and data:
                while now_s() < deadline_s and (more := self._link.read(config.quiet_s)):
                    self._lines.feed(more)
                answer = self._lines.flush()
                if answer is not None:
                    break
            if remaining_s <= 0.0 and (answer := self._lines.next_line()) is not None:
                break
            if remaining_s <= 0.0:  # also on a line that never falls silent
                self.timeouts += 1
                raise DeviceTimeout(
                    f"MELFA did not answer {command} within {config.reply_timeout_s:g} s",
                    "Check cable, power and the line settings",
                )
        if rest := self._lines.rest:
            self._lines.bad_frames += 1
            raise FrameError(
                f"MELFA sent {rest[:40]!r} after its answer to {command}",
                "Check that only this controller asks",
            )
        self.frames += 1
        self._next_s = now_s() + config.running_pause_s
        return codec.parse_answer(answer, command)

    def _encoded(self, command: str) -> bytes:
        config = self._config
        return codec.encode(
            command, robot=config.robot, slot=config.slot, terminator=self._terminator or b"\r"
        )

    def _listen(self) -> None:
        """What comes when nothing was asked would be taken for the next answer."""
        if self._link.read(0.0).strip(b"\r\n"):
            self._lines.bad_frames += 1
            self._out_of_step = True

    def _resynchronise(self) -> None:
        """After a timeout: silence for as long as an answer may take, then prove that answers fit again."""
        if not self._out_of_step:
            return
        deadline_s = self._clock.now_s() + 4.0 * self._config.reply_timeout_s
        while self._link.read(self._config.reply_timeout_s):
            if self._clock.now_s() > deadline_s:
                raise FrameError("MELFA sends without being asked", "Check that only this controller asks")
        self._lines.clear()
        codec.parse_state(self._exchange("STATE").text)
        self._out_of_step = False


class MelfaController:
    """A `RobotController`. With `stop_link`, a session of its own, STOP waits for nothing."""

    def __init__(
        self, link: ByteLink, config: MelfaConfig, clock: Clock, stop_link: ByteLink | None = None
    ) -> None:
        self._config, self._clock = config, clock
        self._line = MelfaLine(link, config, clock)
        self._stop_line = None if stop_link is None else MelfaLine(stop_link, config, clock)
        self._holds_right = False

    @property
    def abilities(self) -> RobotAbilities:
        """Positions have no time stamp: a contact is read at rest, late by the stop delay at most."""
        config = self._config
        return RobotAbilities(
            StopWay.NEXT if self._stop_line is None else StopWay.AT_ONCE,
            stop_delay_s=config.stop_delay_s,
            contact_delay_s=config.stop_delay_s,
            joint_resolution_rad=RESOLUTION_RAD,
            linear_moves=True,
            reports_pose=True,
        )

    def connect(self) -> Identity:
        """Sessions and identity. Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch."""
        config = self._config
        info = self._line.open()
        if config.model and config.model not in info.robot:
            raise IdentityMismatch(
                f"The controller says it drives {info.robot!r}, the cell file {config.model!r}",
                "Check host and port, or correct the cell file",
            )
        if self._stop_line is not None:
            self._stop_line.open()
        return Identity(info.robot, info.serial_number, info.version, (("controller", info.controller),))

    def enable(self) -> None:
        """Operation right, errors reset, servo on. Raises DeviceError, DeviceTimeout, FrameError."""
        config, line = self._config, self._line
        line.ask("CNTLON")
        self._holds_right = True
        if self._state().error:
            line.ask("RSTALRM")
        self.recover()
        if config.program:
            line.ask(f"PRGLOAD={config.program}")
        line.ask("SRVON")
        deadline_s = self._clock.now_s() + SERVO_TIMEOUT_S
        while not self._state().run & codec.SERVO_ON:
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeout(
                    f"The servo is not on {SERVO_TIMEOUT_S:g} s after SRVON", "Check the safety circuit"
                )
            self._clock.sleep(0.1)
        line.ask("OVRD=100")

    def close(self) -> None:
        """Give the right back and end the sessions; safe twice."""
        if self._holds_right:
            self._holds_right = False
            with contextlib.suppress(DeviceError):
                for command in ("SRVOFF", "CNTLOFF", "CLOSE"):
                    self._line.ask(command)
        self._line.close()
        if self._stop_line is not None:
            self._stop_line.close()

    def health(self) -> LinkHealth:
        """Counters of both sessions."""
        lines = [line for line in (self._line, self._stop_line) if line is not None]
        return LinkHealth(
            sum(line.frames for line in lines),
            sum(line.bad_frames for line in lines),
            sum(line.timeouts for line in lines),
            self._line.reconnects,
        )

    def read_joints(self) -> tuple[float, FloatArray]:
        """JPOSF; stamped in the middle between command and answer."""
        asked_s = self._clock.now_s()
        joints = codec.parse_joints(self._line.ask("JPOSF").text)
        return (asked_s + self._clock.now_s()) / 2.0, joints

    def read_pose(self) -> Transform:
        """PPOSF: base_T_flange if no tool is set; A, B, C turn about the fixed x, y and z axes."""
        position_m, angles_rad = codec.parse_pose(self._line.ask("PPOSF").text)
        return Transform.from_xyz_rpy("base", "flange", position_m, angles_rad)

    def is_moving(self) -> bool:
        """DSTATE. Raises DeviceError if the controller is in error or emergency stop, or the servo is off."""
        state = self._state()
        if state.stop & codec.EMERGENCY_STOP:
            raise DeviceError("The robot is in emergency stop", "Release it at the robot, then reset")
        if state.error:
            raise DeviceError(
                f"The robot is in {codec.error_words(state.error)}", "Remove the cause, then reset"
            )
        if not state.run & codec.SERVO_ON:
            raise DeviceError("The servo of the robot is off", "Check the safety circuit, then reset")
        return state.is_running

    def start_move(self, target_rad: FloatArray, speed_rad_s: float) -> None:
        """MOV; the controller answers when it has accepted the instruction, not when it has ended."""
        percent = math.floor(1e4 * speed_rad_s / self._config.max_speed_rad_s) / 100.0
        if percent <= 0.0:
            raise DeviceError(
                f"Speed {math.degrees(speed_rad_s):.4f} deg/s is below 0.01 % of the robot's", "Move faster"
            )
        self._execute(f"JOVRD {min(percent, 100.0):.2f}")
        self._execute(codec.joint_target(JOINT_TARGET, target_rad))
        self._execute(f"MOV {JOINT_TARGET}")
        self._line.running = True

    def start_linear(self, base_T_flange: Transform, speed_m_s: float) -> None:
        """MVS, likewise."""
        angles = Rotation.from_matrix(base_T_flange.rotation).as_euler("xyz")  # fixed axes
        self._execute(f"SPD {1e3 * speed_m_s:.2f}")
        self._execute(codec.pose_target(POSE_TARGET, base_T_flange.origin_m, angles))
        self._execute(f"MVS {POSE_TARGET}")
        self._line.running = True

    def halt(self) -> None:
        """STOP needs no operation right, and any session may send it."""
        (self._stop_line or self._line).ask("STOP")

    def recover(self) -> None:
        """Reset the program that STOP has interrupted."""
        self._line.ask("RSTPRG")

    def contact_at(self, touched_s: float, late_s: float) -> Contact | None:
        """None: positions carry no time stamp."""
        return None

    def _execute(self, instruction: str) -> None:
        self._line.ask(f"EXEC{instruction}", repeat=False)

    def _state(self) -> codec.RunState:
        state = codec.parse_dstate(self._line.ask("DSTATE").text)
        self._line.running = state.is_running
        return state
