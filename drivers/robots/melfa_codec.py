"""Mitsubishi MELFA R-protocol, non-procedural: command and answer lines (manual BFP-A4288-V).

`[robot];[slot];COMMAND` one way, `QoK...` or `QeR....` the other. A lower-case third letter (`Qok`, `Qer`)
says that the controller is in an error state; the answer itself is as good as any other.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.errors import DeviceError, FrameError
from estimation.transform import FloatArray

MOST_COMMAND_BYTES: Final = 255
MOST_ANSWER_BYTES: Final = 1024
TERMINATORS: Final = {"CR": b"\r", "CR LF": b"\r\n", "none": b""}

SERVO_ON, RUNNING, OPERATION_RIGHT = 1 << 5, 1 << 6, 1 << 7  # of RR, the run status
EMERGENCY_STOP, STOPPED = 1 << 0, 1 << 1  # of SS, the stop status

NO_RIGHT: Final = 6020
BUSY: Final = 5640

_ERROR_WORDS: Final = {
    50: "emergency stop",
    61: "emergency stop",
    70: "emergency stop",
    2000: "servo is off",
    2601: "start position beyond the limits",
    2602: "target beyond the limits",
    2603: "way leads beyond the limits",
    2800: "illegal position data",
    2802: "illegal position data",
    2810: "posture flag disagrees with the position",
    4140: "program not found",
    5600: "cannot run while in error",
    5610: "cannot run while STOP is on",
    5640: "already running",
    6020: "no operation right",
}
_ANSWER: Final = re.compile(r"Q(o[Kk]|e[Rr])(.*)", re.DOTALL)
_DSTATE: Final = re.compile(r"([0-9A-F]{2})([0-9A-F]{2})([0-9]+);")
_NUMBER: Final = re.compile(r"[+-]?[0-9]+(\.[0-9]+)?")


def error_words(number: int) -> str:
    """An error of the controller in words."""
    return f"error {number:04d} ({_ERROR_WORDS.get(number, 'see the list of errors of the controller')})"


_CHECK_LINE: Final = "Check the terminator and the line settings"
_ONE_CLIENT: Final = "Check that only this controller asks"


class MelfaRefusal(DeviceError):
    """The controller answered QeR; `number` is its error."""

    def __init__(self, problem: str, remedy: str, number: int = 0) -> None:
        super().__init__(problem, remedy)
        self.number = number


@dataclass(frozen=True, slots=True)
class Answer:
    """What follows QoK, and whether the controller was in error then."""

    text: str
    controller_in_error: bool


def encode(command: str, *, robot: int = 1, slot: int = 1, terminator: bytes = b"\r") -> bytes:
    """A command line. Raises DeviceError if the controller would not take it."""
    line = f"{robot};{slot};{command}".encode("ascii") + terminator
    if len(line) > MOST_COMMAND_BYTES:
        raise DeviceError(
            f"MELFA command of {len(line)} bytes, limit {MOST_COMMAND_BYTES}", "Shorten names or numbers"
        )
    return line


def parse_answer(line: bytes, command: str) -> Answer:
    """Raises MelfaRefusal, FrameError."""
    match = _ANSWER.fullmatch(line.decode("ascii", errors="replace").strip("\r\n"))
    if match is None:
        raise FrameError(f"MELFA answered {line!r} to {command}", _CHECK_LINE)
    kind, text = match.groups()
    in_error = kind[1].islower()
    if kind[0] == "o":
        return Answer(text, in_error)
    if not re.match(r"[0-9]{4}", text):
        raise FrameError(f"MELFA answered {line!r} to {command}", _CHECK_LINE)
    number = int(text[:4])
    remedy = "Reset" if number != NO_RIGHT else "Switch the controller to automatic, then reset"
    raise MelfaRefusal(f"MELFA refused {command}: {error_words(number)}", remedy, number)


class AnswerLines:
    """Cuts a byte stream into answers. What does not begin with Q is noise and counted.

    Without a terminator an answer ends where the line falls silent: `flush` then.
    """

    def __init__(self, terminator: bytes) -> None:
        self._terminator, self._buffer = terminator, bytearray()
        self.bad_frames = 0

    def clear(self) -> None:
        self._buffer.clear()

    @property
    def rest(self) -> bytes:
        """What has come behind the last answer."""
        return bytes(self._buffer).strip(b"\r\n")

    def feed(self, data: bytes) -> None:
        self._buffer += data
        if len(self._buffer) > MOST_ANSWER_BYTES:
            self._buffer.clear()
            self.bad_frames += 1

    def next_line(self) -> bytes | None:
        """The next complete answer. A lone LF after CR belongs to the end of the line before."""
        while self._terminator:
            end = self._buffer.find(b"\r")
            if end < 0:
                return None
            line = bytes(self._buffer[:end]).lstrip(b"\n")
            del self._buffer[: end + 1]
            if line.startswith(b"Q"):
                return line
            self.bad_frames += bool(line)
        return None

    def flush(self) -> bytes | None:
        """What has come, as the answer of a controller that sends no terminator."""
        line = bytes(self._buffer).strip(b"\r\n")
        self._buffer.clear()
        return line or None


@dataclass(frozen=True, slots=True)
class RunState:
    """Answer to DSTATE or STATE."""

    run: int
    stop: int
    error: int  # 0 if none

    @property
    def is_running(self) -> bool:
        return bool(self.run & RUNNING)


def parse_dstate(text: str) -> RunState:
    """`<RR><SS><error>;<step>;<mechanism>`, two hexadecimal numbers and a decimal one without separator."""
    match = _DSTATE.match(text)
    if match is None:
        raise FrameError(f"MELFA sent {text!r}, not a run state", _ONE_CLIENT)
    run, stop, error = match.groups()
    return RunState(int(run, 16), int(stop, 16), int(error))


def parse_state(text: str) -> RunState:
    """The same three numbers are the fifth field of STATE."""
    fields = text.split(";")
    if len(fields) < 7:
        raise FrameError(f"MELFA sent {text!r}, not a state", _ONE_CLIENT)
    return parse_dstate(f"{fields[4]};")


@dataclass(frozen=True, slots=True)
class Position:
    """Answer to JPOSF or PPOSF: axes by name; mm and degrees as on the wire."""

    values: dict[str, float]
    override_percent: float
    speed_mm_s: float


def parse_position(text: str, names: Sequence[str]) -> Position:
    """`name;value;...;;flags;override;speed;limits`. Raises FrameError unless all `names` come first."""
    fields = text.split(";")
    try:
        end = fields.index("")
        rest = fields[end + 1 :]
        told = fields[:end:2]
        pairs = dict(zip(told, fields[1:end:2], strict=True))
        if (
            told[: len(names)] != list(names)
            or len(pairs) != len(told)
            or not all(map(_NUMBER.fullmatch, pairs.values()))
        ):
            raise ValueError("other axes")
        return Position({name: float(value) for name, value in pairs.items()}, float(rest[1]), float(rest[2]))
    except (ValueError, IndexError):
        raise FrameError(
            f"MELFA sent {text!r}, not a position", "Check that only this controller asks"
        ) from None


JOINTS: Final = ("J1", "J2", "J3", "J4", "J5", "J6")
POSE: Final = ("X", "Y", "Z", "A", "B", "C")


def parse_joints(text: str) -> FloatArray:
    """Answer to JPOSF: joints (6,), rad."""
    values = parse_position(text, JOINTS).values
    return np.radians([values[name] for name in JOINTS])


def parse_pose(text: str) -> tuple[FloatArray, FloatArray]:
    """Answer to PPOSF: position (3,), m, and the angles A, B, C (3,), rad."""
    values = parse_position(text, POSE).values
    numbers = np.array([values[name] for name in POSE])
    return numbers[:3] * 1e-3, np.radians(numbers[3:])


def joint_target(name: str, joints_rad: FloatArray) -> str:
    """The instruction that gives a joint variable its value, four decimals of a degree."""
    return f"{name}=({','.join(f'{math.degrees(q):.4f}' for q in joints_rad)})"


def pose_target(name: str, position_m: FloatArray, angles_rad: FloatArray) -> str:
    """The instruction that gives a position variable its value, mm and degrees."""
    values = [*(f"{1e3 * x:.3f}" for x in position_m), *(f"{math.degrees(a):.4f}" for a in angles_rad)]
    return f"{name}=({','.join(values)})"


@dataclass(frozen=True, slots=True)
class ControllerInfo:
    """Answer to OPEN=."""

    robot: str
    controller: str
    version: str
    serial_number: str


def parse_info(text: str) -> ControllerInfo:
    """Axis patterns, flags, jog speeds and file types come first; then robot, controller, series, version.

    A serial number stands between language and copyright, where the controller has one.
    """
    fields = text.split(";")
    if len(fields) < 11:
        raise FrameError(f"MELFA answered {text!r} to OPEN", "Check that this is a MELFA controller")
    after_language = fields[12] if len(fields) > 12 else ""
    serial = "" if after_language.upper().startswith("COPYRIGHT") else after_language
    return ControllerInfo(fields[6], fields[7], fields[10], serial)
