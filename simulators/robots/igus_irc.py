"""igus iRC controller behind its Modbus TCP map, version 1 (ReBeL manual, chapter 10).

Actions happen on a rising edge of a coil; nothing is queued; positions come in steps of
0.01 mm and 0.01 degree.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray
from simulators.interfaces import ByteDevice
from simulators.modbus_pdu import ILLEGAL_ADDRESS, Refused
from simulators.modbus_tcp_slave import RegisterConnection
from simulators.robots.controlled_arm import ControlledArm
from simulators.world.world_file import ArmSpec

FUNCTIONS: Final = (1, 2, 3, 4, 5, 6, 16)
COILS: Final = range(0, 428)
INPUTS: Final = range(0, 432)
HOLDINGS: Final = range(0, 299)
ERROR_BITS: Final = range(21, 31)
EMERGENCY_STOP: Final = 22
NOT_ENABLED: Final = 23
LOWER_LIMIT, UPPER_LIMIT, OUT_OF_RANGE, NOT_ALLOWED = 13, 14, 22, 90
KINEMATIC_COILS: Final = {13: 38, 14: 39, 21: 40, 22: 41, 23: 42, 90: 44}
EDGES: Final = (51, 52, 53, 60, *range(61, 67), *range(100, 105))


@dataclass(frozen=True, slots=True)
class IgusSettings:
    """What this controller is."""

    software: int = 902
    version: tuple[int, int] = (13, 2)
    mapping: int = 1
    reply_s: float = 0.004
    start_s: float = 0.06  # from the edge to the beginning of the motion
    enable_s: float = 0.5
    max_speed_rad_s: float = math.radians(90.0)  # of every joint at 100 %


class IgusRobot(ControlledArm):
    """The controller and its arm; any number of connections."""

    def __init__(
        self,
        spec: ArmSpec,
        rng: np.random.Generator,
        noise_factors: FloatArray | None = None,
        motion_speed: float = 1.0,
        settings: IgusSettings | None = None,
    ) -> None:
        super().__init__(spec, rng, noise_factors, motion_speed)
        self.settings = settings or IgusSettings()
        self.referenced = True
        self._coils = dict.fromkeys(EDGES, False)  # as written last
        self._holding = [0] * len(HOLDINGS)
        self._holding[187] = 10_000
        self._enabled_s = math.inf  # since when; inf is off
        self._module_errors = set[int]()
        self._kinematic_error = 0
        self._rest_s = self._begin_s = -math.inf  # between them, a move was taken and has not begun
        self._permitted = True

    def connections(self) -> dict[str, Callable[[], ByteDevice]]:
        return {"": lambda: RegisterConnection(self, FUNCTIONS, self.settings.reply_s)}

    # -- what happens to it ----------------------------------------------------------------------

    def permit(self, permitted: bool, time_s: float) -> None:
        self._permitted = permitted
        if not permitted:
            self.fault(0, EMERGENCY_STOP, time_s)

    def fault(self, joint: int, code: int, time_s: float) -> None:
        """A module raises the error of this coil; the motors go off."""
        self._module_errors.add(code if code in ERROR_BITS else NOT_ENABLED)
        self._enabled_s = math.inf
        self.halt(time_s)

    def restart(self, time_s: float) -> None:
        """Power comes back: motors off."""
        self.halt(time_s)
        self._enabled_s, self._kinematic_error = math.inf, 0
        self._module_errors.clear()

    # -- Modbus ----------------------------------------------------------------------------------

    def read_bits(self, function: int, address: int, count: int, time_s: float) -> Sequence[bool]:
        """Coils and discrete inputs, which are the same."""
        _refuse_outside(address, count, COILS)
        return [self._bit(address + i, time_s) for i in range(count)]

    def write_bits(self, address: int, states: Sequence[bool], time_s: float) -> None:
        """The coils that act."""
        if address not in self._coils:
            raise Refused(ILLEGAL_ADDRESS)
        self._write_coil(address, states[0], time_s)

    def read(self, function: int, address: int, count: int, time_s: float) -> Sequence[int]:
        """Holding registers (function 3) or input registers."""
        _refuse_outside(address, count, HOLDINGS if function == 3 else INPUTS)
        return (self._holding if function == 3 else self._inputs(time_s))[address : address + count]

    def write(self, address: int, words: Sequence[int], time_s: float) -> None:
        """Holding registers."""
        _refuse_outside(address, len(words), HOLDINGS)
        self._holding[address : address + len(words)] = words

    def _bit(self, address: int, time_s: float) -> bool:
        match address:
            case 20:
                return not self._module_errors
            case 37:
                return not self._kinematic_error
            case 53:
                return self._enabled(time_s)
            case 60 | 61 | 62 | 63 | 64 | 65 | 66:
                return self.referenced
            case 112:
                return self.moving(time_s) and not self._rest_s <= time_s < self._begin_s
        if address in ERROR_BITS:
            return address in self._module_errors
        return address == KINEMATIC_COILS.get(self._kinematic_error)

    def _inputs(self, time_s: float) -> list[int]:
        words = [0] * len(INPUTS)
        words[0:4] = [self.settings.software, *self.settings.version, self.settings.mapping]
        words[95] = self._kinematic_error
        joints = self.measured(time_s)
        pose = self.pose_of(joints)
        with warnings.catch_warnings():  # of gimbal lock: the controller shows one of the possible triples
            warnings.simplefilter("ignore", UserWarning)
            angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
        words[130:142] = _words([*(pose[:3, 3] * 1e5), *(angles * 100)])
        words[142:154] = _words(list(np.degrees(joints) * 100))
        return words

    def _enabled(self, time_s: float) -> bool:
        return time_s >= self._enabled_s

    def _write_coil(self, address: int, state: bool, time_s: float) -> None:
        rising = state and not self._coils[address]
        self._coils[address] = state
        if not rising:
            return
        match address:
            case 51:
                self.halt(time_s)
                self._enabled_s = math.inf
            case 52:
                self._kinematic_error = 0
                self._module_errors = set() if self._permitted else {EMERGENCY_STOP}
            case 53:
                if not self._module_errors:
                    self._enabled_s = min(self._enabled_s, time_s + self.settings.enable_s)
            case 60:
                self.referenced = True
            case 100 | 103 | 104:
                self._move(address, time_s)

    # -- motion ----------------------------------------------------------------------------------

    def _move(self, address: int, time_s: float) -> None:
        if not self._enabled(time_s) or self._module_errors or self._kinematic_error:
            self._kinematic_error = NOT_ALLOWED
            return
        rest_s = self.halt(time_s)  # a new target stops what moves
        begin_s = rest_s + self.settings.start_s
        speed, override = self._holding[180], self._holding[187] / 10_000
        if address == 100:
            values = np.array(_values(self._holding[130:142]))
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_euler("xyz", values[3:] / 100, degrees=True).as_matrix()
            pose[:3, 3] = values[:3] * 1e-5
            if not self.move_linear(begin_s, pose, max(speed, 1) * 1e-4 * override):
                self._kinematic_error = OUT_OF_RANGE
                return
        else:
            target = np.radians(np.array(_values(self._holding[142:154])) / 100)
            if address == 104:
                target = target + self.joints_at(rest_s)
            if not self.within_limits(target):
                self._kinematic_error = LOWER_LIMIT if (target < self.lower_rad).any() else UPPER_LIMIT
                return
            self.move(begin_s, target, max(speed, 1) / 1000 * self.settings.max_speed_rad_s * override)
        self._rest_s, self._begin_s = rest_s, begin_s


def _refuse_outside(address: int, count: int, table: range) -> None:
    if address not in table or address + count - 1 not in table:
        raise Refused(ILLEGAL_ADDRESS)


def _words(values: list[float]) -> list[int]:
    return [word for value in values for word in divmod(round(float(value)) & 0xFFFFFFFF, 0x10000)[::-1]]


def _values(words: list[int]) -> list[int]:
    data = b"".join(word.to_bytes(2, "little") for word in words)
    return [int.from_bytes(data[i : i + 4], "little", signed=True) for i in range(0, len(data), 4)]
