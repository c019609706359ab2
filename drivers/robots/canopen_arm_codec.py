"""CANopen CiA 402 arm: PDO layouts, drive states and emergency messages as pure values.

The object family is that of the Pilz PRBT and Schunk drives, read from the public device file prbt_0_1.dcf.
Positions are in counts of 0.001 degree, velocities in counts/s, accelerations in counts/s^2.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

NMT: Final = 0x000
SYNC: Final = 0x080
EMCY: Final = 0x080
TPDO: Final = (0x180, 0x280, 0x380, 0x480)
RPDO: Final = (0x200, 0x300)
HEARTBEAT: Final = 0x700

NMT_START: Final = 0x01
NMT_PRE_OPERATIONAL: Final = 0x80
BOOT_UP: Final = 0x00
OPERATIONAL: Final = 0x05
NMT_STATES: Final[Mapping[int, str]] = {
    BOOT_UP: "boot-up",
    0x04: "stopped",
    OPERATIONAL: "operational",
    0x7F: "pre-operational",
}

CONTROLWORD: Final = 0x6040
STATUSWORD: Final = 0x6041
MODE: Final = 0x6060
MODE_DISPLAY: Final = 0x6061
POSITION_ACTUAL: Final = 0x6064
TARGET_POSITION: Final = 0x607A
PROFILE_VELOCITY: Final = 0x6081
PROFILE_ACCELERATION: Final = 0x6083  # 6084h, profile deceleration, does not exist: this serves both ramps
INTERPOLATION_SET_POINT: Final = 0x60C1
PROFILE_POSITION_MODE: Final = 1
INTERPOLATED_MODE: Final = 7
MODE_WORDS: Final[Mapping[int, str]] = {
    PROFILE_POSITION_MODE: "profile position",
    INTERPOLATED_MODE: "interpolated position",
}

SHUTDOWN: Final = 0x0006
SWITCH_ON: Final = 0x0007
ENABLE: Final = 0x000F
DISABLE_VOLTAGE: Final = 0x0000
QUICK_STOP: Final = 0x0002
FAULT_RESET: Final = 0x0080  # acts on the rising edge
NEW_SET_POINT: Final = 0x0010
ENABLE_INTERPOLATION: Final = 0x0010  # the same bit, in mode 7
CHANGE_IMMEDIATELY: Final = 0x0020
HALT: Final = 0x0100

TARGET_REACHED: Final = 1 << 10
SET_POINT_ACKNOWLEDGED: Final = 1 << 12
INTERPOLATION_ACTIVE: Final = 1 << 12  # the same bit, in mode 7
FOLLOWING_ERROR: Final = 1 << 13


class DriveState(StrEnum):
    """States of CiA 402, in words for the operator."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


POWERLESS: Final = (
    DriveState.NOT_READY, DriveState.SWITCH_ON_DISABLED, DriveState.READY, DriveState.FAULT
)  # fmt: skip
_STATE_TESTS: Final = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, DriveState.FAULT_REACTION),
    (0x4F, 0x08, DriveState.FAULT),
)


def drive_state(statusword: int) -> DriveState | None:
    """State that a statusword (6041h) encodes; None for a pattern that CiA 402 does not define."""
    for mask, value, state in _STATE_TESTS:
        if statusword & mask == value:
            return state
    return None


# The table that enables a drive: what to send in each state, one step per SYNC.
# After a quick stop the way leads through "switch on disabled", because 605Ah (what else could
# happen) does not exist. A fault needs an edge, so the driver alternates.
NEXT_CONTROLWORD: Final[Mapping[DriveState, int]] = {
    DriveState.NOT_READY: DISABLE_VOLTAGE,
    DriveState.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveState.READY: SWITCH_ON,
    DriveState.SWITCHED_ON: ENABLE,
    DriveState.OPERATION_ENABLED: ENABLE,
    DriveState.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
    DriveState.FAULT_REACTION: DISABLE_VOLTAGE,
    DriveState.FAULT: DISABLE_VOLTAGE,
}


@dataclass(frozen=True, slots=True)
class MappedObject:
    """One object in a PDO; `code` is its `struct` letter."""

    index: int
    subindex: int
    code: str

    @property
    def mapping_word(self) -> int:
        """The entry of the mapping object: index, subindex, length in bits."""
        return self.index << 16 | self.subindex << 8 | 8 * struct.calcsize("<" + self.code)


class PdoLayout:
    """What one PDO carries: written into the drive by SDO, and packed here without library or dictionary.

    `pack(*values) -> bytes` and `unpack(data) -> tuple` are those of `struct`, for speed.
    """

    def __init__(self, *objects: MappedObject) -> None:
        self.mapping = tuple(mapped.mapping_word for mapped in objects)
        packing = struct.Struct("<" + "".join(mapped.code for mapped in objects))
        self.size, self.pack, self.unpack = packing.size, packing.pack, packing.unpack


_CONTROLWORD = MappedObject(CONTROLWORD, 0, "H")
_STATUSWORD = MappedObject(STATUSWORD, 0, "H")
_POSITION = MappedObject(POSITION_ACTUAL, 0, "i")
_VELOCITY = MappedObject(0x606C, 0, "i")
_SET_POINT = MappedObject(INTERPOLATION_SET_POINT, 1, "i")
_TARGET = MappedObject(TARGET_POSITION, 0, "i")

# What the driver configures. A dongle carries about 3000 frames/s, so each joint sends one 6-byte frame per
# SYNC. A move is two frames per joint, and all six start at the same SYNC. Everything mapped here is
# mappable by the device file; RPDO2 keeps the mapping of the file.
TPDO1: Final = PdoLayout(_STATUSWORD, _POSITION)
RPDO1: Final = PdoLayout(_CONTROLWORD, MappedObject(PROFILE_ACCELERATION, 0, "I"))
RPDO2: Final = PdoLayout(_TARGET, MappedObject(PROFILE_VELOCITY, 0, "I"))
RPDO2_PATH: Final = PdoLayout(_SET_POINT)  # in interpolated position mode

# What the device file maps. RPDO1 carries the unused 6042h between controlword and set-point: leave it
# out, and the set-point is shifted by two bytes.
FILE_TPDO1: Final = PdoLayout(_STATUSWORD, MappedObject(MODE_DISPLAY, 0, "b"))
FILE_TPDO3: Final = PdoLayout(_POSITION, _VELOCITY)
FILE_RPDO1: Final = PdoLayout(_CONTROLWORD, MappedObject(0x6042, 0, "h"), _SET_POINT)


@dataclass(frozen=True, slots=True)
class Emergency:
    """An EMCY frame."""

    code: int
    error_register: int
    vendor: bytes

    @property
    def is_reset(self) -> bool:
        """True for the 00xx codes: the error has gone."""
        return self.code >> 8 == 0

    @property
    def words(self) -> str:
        """The code in words, as precise as the standards are."""
        return emergency_words(self.code)


# CiA 301 (classes, 81xx) and CiA 402 (drive codes); the nearest entry to the left of the code applies.
_EMERGENCY_WORDS: Final[Mapping[int, str]] = {
    0x0000: "error gone",
    0x1000: "generic error",
    0x2000: "current",
    0x2310: "continuous overcurrent",
    0x2320: "short circuit",
    0x2340: "short circuit in the motor",
    0x3000: "voltage",
    0x3110: "mains overvoltage",
    0x3120: "mains undervoltage",
    0x3210: "DC link overvoltage",
    0x3220: "DC link undervoltage",
    0x4000: "temperature",
    0x4210: "drive too hot",
    0x4310: "motor too hot",
    0x5000: "drive hardware",
    0x5113: "24 V supply",
    0x6000: "drive software",
    0x7000: "additional module",
    0x7110: "brake chopper",
    0x7121: "motor blocked",
    0x7300: "position sensor",
    0x8000: "monitoring",
    0x8110: "CAN overrun",
    0x8120: "CAN error passive",
    0x8130: "heartbeat of the controller missing",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier used twice",
    0x8200: "protocol error",
    0x8210: "PDO too short",
    0x8220: "PDO too long",
    0x8240: "SYNC with unexpected length",
    0x8250: "RPDO or SYNC missing",
    0x8611: "following error",
    0x8612: "position limit",
    0x9000: "external error",
    0xF000: "additional function",
    0xFF00: "device specific",
}


def emergency_words(code: int) -> str:
    """An EMCY or 1003h error code (u16) in words."""
    for mask in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        if code & mask in _EMERGENCY_WORDS:
            return _EMERGENCY_WORDS[code & mask]
    return "unknown error"


def parse_emergency(data: bytes) -> Emergency | None:
    """Decode an EMCY frame; None if it has not 8 bytes."""
    if len(data) != 8:
        return None
    code, register = struct.unpack_from("<HB", data)
    return Emergency(code, register, bytes(data[3:]))
