"""Mitsubishi MELFA controller behind the R-protocol, after manual BFP-A4288: RS-232 or TCP sessions.

The controller only answers. An answer says by the case of its third letter whether there is an error.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray
from simulators.answers import Answers
from simulators.interfaces import ByteDevice
from simulators.robots.controlled_arm import ControlledArm
from simulators.world.world_file import ArmSpec

RIGHT_NEEDED: Final = ("SRVON", "SRVOFF", "OVRD=", "EXEC", "OUT=", "PRGLOAD", "JOG")
EMERGENCY_STOP: Final = 50
SERVO_IS_OFF: Final = 2000
BEYOND_LIMITS: Final = 2602
UNKNOWN_VARIABLE: Final = 4220
IN_ERROR, STOP_IS_ON, IS_RUNNING, NO_RIGHT = 5600, 5610, 5640, 6020
SYNTAX: Final = 4000
PAUSE_S: Final = 0.1  # between an answer and the next command while something runs
_ASSIGNMENT: Final = re.compile(r"([JP]\w*)=\((-?[\d.]+(?:,-?[\d.]+)*)\)")


class MelfaError(Exception):
    """The command is refused with this number; never leaves the simulator."""

    def __init__(self, number: int) -> None:
        super().__init__(f"{number:04d}")
        self.number = number


@dataclass(frozen=True, slots=True)
class MelfaSettings:
    """What this controller is."""

    robot: str = "RV-4FL-D"
    controller: str = "CR750-D"
    version: str = "Ver.S7e"
    serial_number: str = "AC0512034"
    terminator: bytes = b"\r"
    baud: int = 0  # of a serial line, which takes 12 bit times a byte (8E2); 0 is TCP
    answer_s: float = 0.008
    start_s: float = 0.03  # from the acceptance of a move to its beginning
    servo_s: float = 0.8
    max_speed_rad_s: float = math.radians(90.0)  # of every joint at 100 %


class MelfaRobot(ControlledArm):
    """The controller and its arm. Sessions come and go; one of them may hold the operation right."""

    def __init__(
        self,
        spec: ArmSpec,
        rng: np.random.Generator,
        noise_factors: FloatArray | None = None,
        motion_speed: float = 1.0,
        settings: MelfaSettings | None = None,
    ) -> None:
        super().__init__(spec, rng, noise_factors, motion_speed)
        self.settings = settings or MelfaSettings()
        self.holder: MelfaSession | None = None  # of the operation right
        self.error = 0
        self._variables: dict[str, FloatArray] = {}
        self._override, self._joint_percent, self._line_mm_s = 100, 100.0, 100.0
        self._servo_on_s = math.inf  # since when; inf is off
        self._starts_s = -math.inf  # of the present move
        self._stop_on = self._stopped = False
        self._permitted = True

    # -- what happens to it ----------------------------------------------------------------------

    def permit(self, permitted: bool, time_s: float) -> None:
        """Emergency stop pressed or released."""
        self._permitted = permitted
        if not permitted:
            self.fault(0, EMERGENCY_STOP, time_s)
            self._servo_on_s = math.inf

    def fault(self, joint: int, code: int, time_s: float) -> None:
        """The controller raises an error and stops the arm."""
        self.error = code
        self._stop(time_s)

    def restart(self, time_s: float) -> None:
        """Power comes back: servo off, no right, nothing remembered."""
        self._stop(time_s)
        self.holder, self.error, self._servo_on_s = None, 0, math.inf
        self._variables.clear()
        self._override, self._joint_percent = 100, 100.0

    # -- answers ---------------------------------------------------------------------------------

    def answer(self, line: str, session: "MelfaSession", time_s: float) -> tuple[str, float]:
        """What is said to a command line, and when it can be said."""
        parts = line.split(";", 2)
        numbered = len(parts) == 3 and all(part.isdigit() or not part for part in parts[:2])
        command = parts[2] if numbered else line
        ready_s = time_s
        try:
            text = self._execute(command, session, time_s)
            if command.startswith("EXEC2="):
                ready_s = max(time_s, self.end_s())
            head = "Qok" if self.error else "QoK"
        except MelfaError as refused:
            text = f"{refused.number:04d}"
            head = "Qer" if self.error else "QeR"
        return head + text, ready_s

    def _execute(self, command: str, session: "MelfaSession", time_s: float) -> str:
        if command.startswith(RIGHT_NEEDED) and self.holder is not session:
            raise MelfaError(NO_RIGHT)
        match = re.fullmatch(r"(OPEN=|OVRD=|PRGLOAD=|EXEC2=|OUT=|EXEC|ERRORMES|IN|OUT)(.+)", command)
        name, argument = match.groups() if match else (command, "")
        match name:
            case "OPEN=":
                return self._information()
            case "CLOSE":
                self.leave(session)
            case "CNTLON":
                if self.holder not in (None, session):
                    raise MelfaError(NO_RIGHT)
                self.holder = session
            case "CNTLOFF":
                self.leave(session)
            case "SRVON":
                if not self._permitted or self.error:
                    raise MelfaError(self.error or EMERGENCY_STOP)
                self._servo_on_s = min(self._servo_on_s, time_s + self.settings.servo_s)
            case "SRVOFF":
                self._stop(time_s)
                self._servo_on_s = math.inf
            case "RSTALRM":
                self.error = 0 if self._permitted else EMERGENCY_STOP
            case "OVRD=":
                if not argument.isdigit() or not 1 <= int(argument) <= 100:
                    raise MelfaError(SYNTAX)
                self._override = int(argument)
                return argument
            case "OVRD":
                return str(self._override)
            case "STOP":
                self._stop(time_s)
            case "STOPON" | "STOPOFF":
                self._stop_on = name == "STOPON"
                if self._stop_on:
                    self._stop(time_s)
            case "SLOTINIT" | "RSTPRG":
                self._stopped = False
            case "PRGLOAD=" | "OUT=":
                pass
            case "EXEC" | "EXEC2=":
                self._instruction(argument, time_s)
            case "JPOSF" | "GJPOSF":
                return self._joints(self.measured(time_s))
            case "PPOSF" | "GPPOSF":
                return self._pose(self.pose_of(self.measured(time_s)))
            case "STATE":
                state = f"{self._run(time_s):02X}{self._stop_bits():02X}{self.error}"
                return f"TRUECELL.MB5;1;{self._override};1;{state};1;1;;;;;;;;;REP;START;1;0"
            case "DSTATE":
                return f"{self._run(time_s):02X}{self._stop_bits():02X}{self.error};1;1"
            case "ERROR":
                return f"{self.error};2" if self.error else ""
            case "ERRORMES":
                return f"Error {argument}"
            case "IN" | "OUT":
                return "0000"
            case _:
                raise MelfaError(SYNTAX)
        return ""

    def leave(self, session: "MelfaSession | None") -> None:
        """A session gives the right back."""
        if session is not None and self.holder is session:
            self.holder = None

    def connections(self) -> dict[str, Callable[[], ByteDevice]]:
        """What a client finds on each link; the session that was there before has ended."""
        sessions = dict[str, MelfaSession]()

        def connect(name: str) -> MelfaSession:
            self.leave(sessions.get(name))
            sessions[name] = MelfaSession(self)
            return sessions[name]

        return {name: partial(connect, name) for name in ("", "stop")}

    def _information(self) -> str:
        s = self.settings
        return (
            f"3F;3F;7,0;3,5,A,1E,32,46,64;MB5;PRM;{s.robot};{s.controller};MELFA;17-10-06;{s.version};ENG;"
            f"{s.serial_number};COPYRIGHT(C);1;3;8;"
        )

    # -- state -----------------------------------------------------------------------------------

    def servo_on(self, time_s: float) -> bool:
        return time_s >= self._servo_on_s

    def running(self, time_s: float) -> bool:
        """Bit 6: only from the beginning of the motion on."""
        return self._starts_s <= time_s < self.end_s()

    def _run(self, time_s: float) -> int:
        held = self.holder is not None
        return 0x01 | self.servo_on(time_s) << 5 | self.running(time_s) << 6 | held << 7

    def _stop_bits(self) -> int:
        return int(not self._permitted) | self._stopped << 1 | self._stop_on << 3 | 0x10

    def _joints(self, joints_rad: FloatArray) -> str:
        axes = ";".join(f"J{i};{q:.2f}" for i, q in enumerate(np.degrees(joints_rad), start=1))
        return f"{axes};;****,****;{self._override};0.00;00000000"

    def _pose(self, pose: FloatArray) -> str:
        angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
        values = zip("XYZABC", [*(pose[:3, 3] * 1e3), *angles], strict=True)
        axes = ";".join(f"{name};{value:.2f}" for name, value in values)
        return f"{axes};L1;0.00;;6,0;{self._override};0.00;00000000"

    # -- instructions ----------------------------------------------------------------------------

    def _instruction(self, text: str, time_s: float) -> None:
        if assigned := _ASSIGNMENT.fullmatch(text):
            values = np.array([float(value) for value in assigned[2].split(",")])
            if len(values) != 6:
                raise MelfaError(SYNTAX)
            self._variables[assigned[1]] = values
            return
        name, _, argument = text.partition(" ")
        if name in ("MOV", "MVS"):
            self._start(name, argument, time_s)
            return
        try:
            value = float(argument)
        except ValueError:
            raise MelfaError(SYNTAX) from None
        if name == "JOVRD" and 0 < value <= 100:
            self._joint_percent = value
        elif name == "SPD" and value > 0:
            self._line_mm_s = value
        else:
            raise MelfaError(SYNTAX)

    def _start(self, name: str, variable: str, time_s: float) -> None:
        if self.error:
            raise MelfaError(IN_ERROR)
        if self._stop_on or self._stopped:
            raise MelfaError(STOP_IS_ON)
        if not self.servo_on(time_s):
            raise MelfaError(SERVO_IS_OFF)
        if self.moving(time_s):
            raise MelfaError(IS_RUNNING)
        if variable not in self._variables:
            raise MelfaError(UNKNOWN_VARIABLE)
        values, begin_s = self._variables[variable], time_s + self.settings.start_s
        if variable.startswith("J") and name == "MOV":
            target = np.radians(values)
            if not self.within_limits(target):
                self.error = BEYOND_LIMITS
                raise MelfaError(BEYOND_LIMITS)
            percent = self._joint_percent * self._override / 100
            self.move(begin_s, target, self.settings.max_speed_rad_s * percent / 100)
        elif variable.startswith("P") and name == "MVS":
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_euler("xyz", values[3:], degrees=True).as_matrix()
            pose[:3, 3] = values[:3] * 1e-3
            if not self.move_linear(begin_s, pose, self._line_mm_s * 1e-3 * self._override / 100):
                self.error = BEYOND_LIMITS
                raise MelfaError(BEYOND_LIMITS)
        else:
            raise MelfaError(SYNTAX)
        self._starts_s = begin_s

    def _stop(self, time_s: float) -> None:
        if self.moving(time_s):
            self._stopped = True
            self.halt(time_s)


class MelfaSession(Answers):
    """One session: bytes in, answers out, in their own time."""

    def __init__(self, robot: MelfaRobot) -> None:
        super().__init__()
        self._robot = robot
        self._input = b""
        self._answered_s = -math.inf

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client, however they are cut; without a terminator one read is one command."""
        settings = self._robot.settings
        self._input += data
        if not settings.terminator:
            self._line(self._input.strip(b"\r\n"), time_s)
            self._input = b""
        while b"\r" in self._input:
            line, _, self._input = self._input.partition(b"\r")
            self._line(line.strip(b"\n"), time_s)

    def _line(self, line: bytes, time_s: float) -> None:
        robot, settings = self._robot, self._robot.settings
        byte_s = 12.0 / settings.baud if settings.baud else 0.0
        heard_s = time_s + (len(line) + 1) * byte_s
        busy = robot.moving(heard_s)
        if len(line) > 255:
            text, ready_s = f"QeR{SYNTAX:04d}", heard_s
        else:
            text, ready_s = robot.answer(line.decode("ascii", errors="replace"), self, heard_s)
        if busy:  # asked again too soon, it takes its time
            ready_s = max(ready_s, self._answered_s + PAUSE_S)
        answer = text.encode("ascii") + settings.terminator
        sent_s = max(ready_s, self._answered_s) + settings.answer_s + len(answer) * byte_s
        self._answered_s = sent_s
        self._output.append((sent_s, answer))
