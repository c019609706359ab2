"""Modbus map of igus / Commonplace Robotics controllers, version 1: addresses as written, not less one.

32-bit values are two's complement with the low word first; positions are in 0.01 mm and 0.01 degree.
Source: igus ReBeL user manual, chapter 10; coil numbers of motion from two public clients.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from estimation.errors import FrameError
from estimation.transform import FloatArray

MAPPING_VERSION: Final = 1
SOFTWARE: Final = {902: "iRC", 980: "TinyCtrl"}

# coils
MODULE_OK: Final = 20
MODULE_ERRORS: Final = {
    21: "over-temperature",
    22: "emergency stop or undervoltage",
    23: "motor not enabled",
    24: "communication",
    25: "position lag",
    26: "encoder",
    27: "overcurrent",
    28: "driver",
    29: "bus dead",
    30: "module dead",
}
KINEMATICS_OK: Final = 37
RESET, ENABLE, REFERENCED = 52, 53, 60  # edges; the last two read back the state
MOVE_CARTESIAN, MOVE_JOINTS, MOVE_JOINTS_RELATIVE = 100, 103, 104  # edges
MOVING: Final = 112

# input registers
SOFTWARE_ID: Final = 0  # and major, minor, mapping version
KINEMATIC_ERROR: Final = 95
POSE: Final = 130  # X, Y, Z, A, B, C; the joints follow, and can be read in the same request
JOINTS: Final = 142

# holding registers
POSE_TARGET, JOINT_TARGET = 130, 142
SPEED: Final = 180  # 0.1 mm/s or 0.1 %
OVERRIDE: Final = 187  # 0.01 %

STEP_RAD: Final = math.radians(0.01)
STEP_M: Final = 1e-5

_KINEMATIC_WORDS: Final = {
    13: "lower axis limit",
    14: "upper axis limit",
    21: "singularity in the centre",
    22: "out of reach",
    23: "singularity of the wrist",
    30: "virtual box, X+",
    31: "virtual box, X-",
    32: "virtual box, Y+",
    33: "virtual box, Y-",
    34: "virtual box, Z+",
    35: "virtual box, Z-",
    50: "no number",
    90: "motion not allowed",
}


def kinematic_words(code: int) -> str:
    """The kinematic error of register 95."""
    return f"kinematic error {code} ({_KINEMATIC_WORDS.get(code, 'unknown')})"


def pack(values: Sequence[int]) -> list[int]:
    """Signed 32-bit values as registers, low word first."""
    return [word for value in values for word in (value & 0xFFFF, value >> 16 & 0xFFFF)]


def unpack(words: Sequence[int]) -> list[int]:
    """Registers as signed 32-bit values. Raises FrameError for half a value."""
    if len(words) % 2:
        raise FrameError(f"{len(words)} registers, not pairs", "Read both words of a value in one request")
    values = [high << 16 | low for low, high in zip(words[::2], words[1::2], strict=True)]
    return [value - (value >> 31 << 32) for value in values]


def angles(words: Sequence[int]) -> FloatArray:
    """Angles, rad, from registers in 0.01 degree."""
    return np.array(unpack(words)) * STEP_RAD


def lengths(words: Sequence[int]) -> FloatArray:
    """Lengths, m, from registers in 0.01 mm."""
    return np.array(unpack(words)) * STEP_M


def angle_words(angles_rad: FloatArray) -> list[int]:
    """Registers for angles, rounded to 0.01 degree."""
    return pack([round(float(angle) / STEP_RAD) for angle in angles_rad])


def length_words(lengths_m: FloatArray) -> list[int]:
    """Registers for lengths, rounded to 0.01 mm."""
    return pack([round(float(length) / STEP_M) for length in lengths_m])
