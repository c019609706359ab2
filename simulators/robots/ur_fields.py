"""What RTDE can tell of a robot: fields by name, with their type and how they follow from an instant."""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray

REGISTERS: Final = 48
POWER_OFF, POWER_ON, IDLE, RUNNING = 3, 4, 5, 7
NORMAL, PROTECTIVE_STOP, ROBOT_EMERGENCY_STOP = 1, 3, 7  # safety modes
SAFETY_BITS: Final = {
    NORMAL: 1 << 0,
    PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
PACKING: Final = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}


@dataclass(frozen=True, slots=True)
class UrState:
    """What changes in steps."""

    mode: int = POWER_OFF
    safety: int = NORMAL
    program_runs: bool = False
    registers: tuple[int, ...] = (0,) * REGISTERS

    def with_register(self, number: int, value: int) -> "UrState":
        """One output integer register changed."""
        registers = (*self.registers[:number], value, *self.registers[number + 1 :])
        return replace(self, registers=registers)


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """A robot at one instant of its control cycle."""

    timestamp_s: float  # of the controller's clock
    joints_rad: FloatArray  # (6,) as the encoders give them
    planned_rad: FloatArray  # (6,)
    speeds_rad_s: Callable[[], list[float]]  # (6,); seldom asked for
    base_T_tcp: FloatArray  # (4, 4) from the encoders
    state: UrState

    @property
    def pose(self) -> tuple[float, ...]:
        """Metres and rotation vector."""
        rows = self.base_T_tcp.tolist()
        return (rows[0][3], rows[1][3], rows[2][3], *_rotation_vector(rows))


def _rotation_vector(rows: list[list[float]]) -> tuple[float, float, float]:
    """Of a rotation matrix, by its quaternion; for every package, so without arrays."""
    (xx, xy, xz, *_), (yx, yy, yz, *_), (zx, zy, zz, *_) = rows[:3]
    # The largest of the four components is not near zero.
    w, x, y, z = max(
        (1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz),
        key=lambda q: q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2,
    )
    sign = -1.0 if w < 0.0 else 1.0
    sine = math.sqrt(x * x + y * y + z * z)
    scale = sign * 2.0 * math.atan2(sine, abs(w)) / sine if sine > 0.0 else 0.0
    return x * scale, y * scale, z * scale


Value = float | int | tuple[float, ...]
Field = tuple[str, Callable[[Moment], Value]]


class Sampled(Protocol):
    """Whatever can be looked at through RTDE."""

    def moment(self, time_s: float) -> Moment:
        """The robot at an instant up to the present."""


def _same(kind: str, value: Value) -> Field:
    return kind, lambda moment: value


_ZEROS: Final = (0.0,) * 6
FIELDS: Final[dict[str, Field]] = {
    "timestamp": ("DOUBLE", lambda m: m.timestamp_s),
    "target_q": ("VECTOR6D", lambda m: tuple(m.planned_rad)),
    "target_qd": ("VECTOR6D", lambda m: tuple(m.speeds_rad_s())),
    "actual_q": ("VECTOR6D", lambda m: tuple(m.joints_rad)),
    "actual_qd": ("VECTOR6D", lambda m: tuple(m.speeds_rad_s())),
    "actual_TCP_pose": ("VECTOR6D", lambda m: m.pose),
    "target_TCP_pose": ("VECTOR6D", lambda m: m.pose),
    "robot_mode": ("INT32", lambda m: m.state.mode),
    "joint_mode": ("VECTOR6INT32", lambda m: (253 if m.state.mode == RUNNING else 239,) * 6),
    "safety_mode": ("INT32", lambda m: m.state.safety),
    "safety_status": ("INT32", lambda m: m.state.safety),
    "safety_status_bits": ("UINT32", lambda m: SAFETY_BITS[m.state.safety]),
    "robot_status_bits": (
        "UINT32",
        lambda m: (m.state.mode > POWER_OFF) | m.state.program_runs << 1,
    ),
    "runtime_state": ("UINT32", lambda m: 2 if m.state.program_runs else 1),
    "speed_scaling": _same("DOUBLE", 1.0),
    "target_speed_fraction": _same("DOUBLE", 1.0),
    "actual_execution_time": _same("DOUBLE", 0.4),
    "actual_main_voltage": _same("DOUBLE", 48.0),
    "actual_robot_voltage": _same("DOUBLE", 48.0),
    "actual_robot_current": _same("DOUBLE", 0.6),
    "actual_momentum": _same("DOUBLE", 0.0),
    "actual_digital_input_bits": _same("UINT64", 0),
    "actual_digital_output_bits": _same("UINT64", 0),
    "actual_tool_accelerometer": _same("VECTOR3D", (0.0, 0.0, 9.82)),
    "payload": _same("DOUBLE", 0.0),
    "payload_cog": _same("VECTOR3D", (0.0, 0.0, 0.0)),
    "payload_inertia": _same("VECTOR6D", _ZEROS),
    "joint_temperatures": _same("VECTOR6D", (28.0,) * 6),
    "actual_joint_voltage": _same("VECTOR6D", (48.0,) * 6),
    **{
        name: _same("VECTOR6D", _ZEROS)
        for name in (
            "target_qdd",
            "target_current",
            "target_moment",
            "actual_current",
            "joint_control_output",
            "actual_TCP_speed",
            "actual_TCP_force",
            "target_TCP_speed",
            "ft_raw_wrench",
        )
    },
    **{f"standard_analog_{way}{i}": _same("DOUBLE", 0.0) for way in ("input", "output") for i in range(2)},
    **{f"output_double_register_{i}": _same("DOUBLE", 0.0) for i in range(REGISTERS)},
    **{
        f"output_int_register_{i}": ("INT32", lambda m, i=i: m.state.registers[i])  # type: ignore[misc]
        for i in range(REGISTERS)
    },
}


class Recipe:
    """The fields of one client's data packages."""

    def __init__(self, names: list[str]) -> None:
        self.types = [FIELDS[name][0] if name in FIELDS else "NOT_FOUND" for name in names]
        self.complete = "NOT_FOUND" not in self.types
        self._values = [FIELDS[name][1] for name in names if name in FIELDS]
        packing = "".join(PACKING[kind] for kind in self.types if kind in PACKING)
        self._packing = struct.Struct(">B" + packing)

    def package(self, moment: Moment) -> bytes:
        """Payload of a data package."""
        numbers = list[float | int]()
        for value_of in self._values:
            value = value_of(moment)
            numbers += value if isinstance(value, tuple) else (value,)
        return self._packing.pack(1, *numbers)


def pose_matrix(pose: tuple[float, ...]) -> FloatArray:
    """(4, 4) from metres and rotation vector."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix
