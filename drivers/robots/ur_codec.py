"""Universal Robots: RTDE frames (TCP 30004), URScript programs and dashboard answers as pure values.

RTDE: size u16 (with these three bytes), type u8, payload, big-endian; protocol version 2.
Source: the maker's RTDE guide and client library, URScript manual, dashboard server list of commands.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.errors import FrameError
from estimation.transform import FloatArray

VERSION: Final = ord("V")  # of the protocol
CONTROLLER: Final = ord("v")  # version of the controller's software
OUTPUTS: Final = ord("O")
START: Final = ord("S")
PAUSE: Final = ord("P")
DATA: Final = ord("U")
TEXT: Final = ord("M")
TYPES: Final = frozenset((VERSION, CONTROLLER, OUTPUTS, START, PAUSE, DATA, TEXT))

PROTOCOL: Final = struct.pack(">H", 2)
LONGEST_FRAME: Final = 4096  # longer than any answer to this driver; a size beyond it is no size
_HEADER: Final = struct.Struct(">HB")
_PACKING: Final = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I"}

PROGRAM_RUNNING: Final = 1 << 1  # of robot_status_bits
MODE_RUNNING: Final = 7
MODES: Final = {
    -1: "NO_CONTROLLER",
    0: "DISCONNECTED",
    1: "CONFIRM_SAFETY",
    2: "BOOTING",
    3: "POWER_OFF",
    4: "POWER_ON",
    5: "IDLE",
    6: "BACKDRIVE",
    7: "RUNNING",
    8: "UPDATING_FIRMWARE",
}
_SAFETY_WORDS: Final = (  # bits of safety_status_bits that end a motion, the most telling first
    (6, "emergency stop at the robot"),
    (5, "emergency stop of the system"),
    (7, "emergency stop"),
    (8, "safety violation"),
    (9, "safety fault"),
    (4, "safeguard stop"),
    (2, "protective stop"),
    (3, "recovery mode"),
    (10, "stop by the safety system"),
)


def encode(kind: int, payload: bytes = b"") -> bytes:
    """One frame."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


class FrameReader:
    """Cuts a stream into frames, however the bytes arrive."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def clear(self) -> None:
        self._buffer.clear()

    def feed(self, data: bytes) -> None:
        self._buffer += data

    def next_frame(self) -> tuple[int, bytes] | None:
        """Type and payload, or None until more bytes come. Raises FrameError: the stream is lost then."""
        if len(self._buffer) < _HEADER.size:
            return None
        size, kind = _HEADER.unpack_from(self._buffer)
        if not _HEADER.size <= size <= LONGEST_FRAME or kind not in TYPES:
            raise FrameError(
                f"RTDE sent a frame of type {kind:02X}h and {size} bytes",
                "Check that the port is RTDE's, 30004",
            )
        if len(self._buffer) < size:
            return None
        payload = bytes(self._buffer[_HEADER.size : size])
        del self._buffer[:size]
        return kind, payload


@dataclass(frozen=True, slots=True, eq=False)
class Package:
    """One data package; which registers count the programs is up to the driver."""

    timestamp_s: float  # of the controller's clock
    joints_rad: FloatArray  # (6,)
    base_T_tcp: FloatArray  # (6,) metres and rotation vector
    mode: int
    safety_bits: int
    status_bits: int
    begun: int  # number of the program that began last
    ended: int  # and of that which ended last

    @property
    def program_runs(self) -> bool:
        """Whether any program is being executed."""
        return bool(self.status_bits & PROGRAM_RUNNING)

    @property
    def obstacle(self) -> str:
        """What keeps the robot from moving, in words; "" if nothing does."""
        for bit, words in _SAFETY_WORDS:
            if self.safety_bits >> bit & 1:
                return words
        return "" if self.mode == MODE_RUNNING else f"robot mode {MODES.get(self.mode, self.mode)}"


class Recipe:
    """Which fields a data package carries. `register` and the one after it count programs."""

    def __init__(self, register: int) -> None:
        self.fields = {
            "timestamp": "DOUBLE",
            "actual_q": "VECTOR6D",
            "actual_TCP_pose": "VECTOR6D",
            "robot_mode": "INT32",
            "safety_status_bits": "UINT32",
            "robot_status_bits": "UINT32",
            f"output_int_register_{register}": "INT32",
            f"output_int_register_{register + 1}": "INT32",
        }
        self._packing = struct.Struct(">B" + "".join(_PACKING[kind] for kind in self.fields.values()))
        self._id = 0

    def request(self, rate_hz: float) -> bytes:
        """Payload of the set-up of outputs."""
        return struct.pack(">d", rate_hz) + ",".join(self.fields).encode("ascii")

    def accept(self, payload: bytes) -> None:
        """The answer to it. Raises FrameError, naming the field that the controller does not have."""
        types = payload[1:].decode("ascii", errors="replace").split(",")
        for (name, wanted), found in zip(self.fields.items(), types, strict=False):
            if found != wanted:
                raise FrameError(
                    f"RTDE field {name} is {found}, expected {wanted}",
                    "Use a controller software that has it",
                )
        if len(types) != len(self.fields):
            raise FrameError(
                f"RTDE answered {len(types)} types to {len(self.fields)} fields",
                "Check that the port is RTDE's",
            )
        self._id = payload[0]

    def parse(self, payload: bytes) -> Package:
        """Raises FrameError for another recipe, and for values that no robot has."""
        if len(payload) != self._packing.size or payload[0] != self._id:
            raise FrameError(
                f"RTDE sent {len(payload)} bytes of recipe {payload[:1].hex()}, "
                f"expected {self._packing.size} of {self._id:02x}",
                "Reset; check the network if it recurs",
            )
        _, timestamp, *numbers = self._packing.unpack(payload)
        joints, pose = np.array(numbers[:6]), np.array(numbers[6:12])
        values = np.array([timestamp, *joints, *pose])
        if not np.isfinite(values).all() or np.abs(joints).max() > 3.0 * math.pi or np.abs(pose).max() > 10.0:
            raise FrameError("RTDE sent values that no robot has", "Reset; check the network if it recurs")
        return Package(timestamp, joints, pose, *numbers[12:])


# --- URScript ------------------------------------------------------------------------------------------


def program(name: str, statements: Sequence[str]) -> bytes:
    """A program as it is sent to the controller, which runs it at once in the place of any other."""
    return "\n".join([f"def {name}():", *(f"  {line}" for line in statements), "end\n"]).encode("ascii")


def set_register(register: int, value: int) -> str:
    """What lets RTDE see how far a program has come."""
    return f"write_output_integer_register({register}, {value})"


def move_joints(target_rad: FloatArray, speed_rad_s: float, acceleration_rad_s2: float) -> str:
    """All joints start and stop together; speed and acceleration are of the leading one."""
    return f"movej([{_numbers(target_rad)}], a={acceleration_rad_s2:.6f}, v={speed_rad_s:.6f})"


def move_linear(base_T_tcp: FloatArray, speed_m_s: float, acceleration_m_s2: float) -> str:
    """The TCP on a straight line to a pose (6,) of metres and rotation vector."""
    return f"movel(p[{_numbers(base_T_tcp)}], a={acceleration_m_s2:.6f}, v={speed_m_s:.6f})"


def stop_joints(deceleration_rad_s2: float) -> str:
    """Come to rest."""
    return f"stopj({deceleration_rad_s2:.6f})"


TCP_IS_FLANGE: Final = "set_tcp(p[0, 0, 0, 0, 0, 0])"


def _numbers(values: FloatArray) -> str:
    return ", ".join(f"{value:.9f}" for value in values)


# --- dashboard -----------------------------------------------------------------------------------------

GREETING: Final = "Connected:"


def value_of(answer: str, name: str) -> str:
    """`Robotmode: RUNNING` is RUNNING. Raises FrameError for the answer to something else."""
    found, colon, value = answer.partition(":")
    if not colon or found.strip().lower() != name.lower():
        raise FrameError(f"The dashboard answered {answer!r}, not {name}", "Check that the port is 29999")
    return value.strip()
