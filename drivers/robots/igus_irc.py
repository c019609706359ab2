"""igus / Commonplace Robotics controllers (iRC, TinyCtrl) over Modbus TCP, mapping version 1."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.capabilities import Contact, Identity, LinkHealth, RobotAbilities, StopWay
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.links.modbus_tcp import ModbusTcp
from drivers.robots import igus_irc_codec as codec
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch
from estimation.transform import FloatArray, Transform

ENABLE_TIMEOUT_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class IgusConfig:
    """Settings of one controller."""

    max_speed_rad_s: float  # of the fastest joint at 100 %
    model: str = ""  # "iRC" or "TinyCtrl", as the software number says; "" does not compare
    unit: int = 1
    reply_timeout_s: float = 0.2
    stop_delay_s: float = 0.1  # longest, from the request until the arm slows down
    euler: Literal["xyz", "zyx"] = "xyz"  # fixed axes about which A, B and C turn, in this order


class IgusController:
    """A `RobotController`. It has no stop: a move by nothing takes the place of the present one."""

    def __init__(self, link: ByteLink, config: IgusConfig, clock: Clock) -> None:
        self._link, self._config, self._clock = link, config, clock
        self._modbus = ModbusTcp(
            link,
            clock,
            name="iRC",
            unit=config.unit,
            reply_timeout_s=config.reply_timeout_s,
            silence_s=config.reply_timeout_s,
            on_resync=self._after_timeout,
        )
        self._opened = 0

    @property
    def abilities(self) -> RobotAbilities:
        """Positions have no time stamp: a contact is read at rest, late by the stop delay at most."""
        return RobotAbilities(
            StopWay.NEXT,
            stop_delay_s=self._config.stop_delay_s,
            contact_delay_s=self._config.stop_delay_s,
            joint_resolution_rad=codec.STEP_RAD,
            linear_moves=True,
            reports_pose=True,
        )

    def connect(self) -> Identity:
        """Identity. Raises DeviceError, DeviceTimeout, IdentityMismatch."""
        self._link.reopen()
        self._opened += 1
        self._modbus.reset()
        software, version = self._prove_identity()
        return Identity(software, "", version, (("mapping", str(codec.MAPPING_VERSION)),))

    def enable(self) -> None:
        """Errors reset, motors enabled. Raises DeviceError, DeviceTimeout."""
        if not (self._coil(codec.MODULE_OK) and self._coil(codec.KINEMATICS_OK)):
            self._edge(codec.RESET)
        if not self._coil(codec.ENABLE):
            self._edge(codec.ENABLE)
        deadline_s = self._clock.now_s() + ENABLE_TIMEOUT_S
        while not self._coil(codec.ENABLE):
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeout(
                    f"The motors are not enabled within {ENABLE_TIMEOUT_S:g} s",
                    "Check emergency stop and supply, then reset",
                )
            self._clock.sleep(0.05)
        if not self._coil(codec.REFERENCED):
            raise DeviceError("The robot is not referenced", "Reference it at its pendant, then reset")
        self._modbus.write_register(codec.OVERRIDE, 10_000)

    def close(self) -> None:
        """Release the connection; safe twice."""
        self._link.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        modbus = self._modbus
        return LinkHealth(modbus.frames, modbus.bad_frames, modbus.timeouts, max(0, self._opened - 1))

    def read_joints(self) -> tuple[float, FloatArray]:
        """All twelve words in one request, so that no value tears."""
        words = self._modbus.read_input_registers(codec.JOINTS, 12)
        return (self._modbus.sent_s + self._modbus.received_s) / 2.0, codec.angles(words)

    def read_pose(self) -> Transform:
        """base_T_flange as the controller computes it."""
        words = self._modbus.read_input_registers(codec.POSE, 12)
        matrix = np.eye(4)
        rotation = Rotation.from_euler(self._config.euler, codec.angles(words[6:]))
        matrix[:3, :3] = rotation.as_matrix()
        matrix[:3, 3] = codec.lengths(words[:6])
        return Transform("base", "flange", matrix)

    def is_moving(self) -> bool:
        """Coil 112. Raises DeviceError for an error of module or kinematics, and for motors that are off."""
        states = self._modbus.read_coils(codec.MODULE_OK, codec.ENABLE - codec.MODULE_OK + 1)
        on = {codec.MODULE_OK + i for i, state in enumerate(states) if state}
        if codec.MODULE_OK not in on:
            words = ", ".join(text for coil, text in codec.MODULE_ERRORS.items() if coil in on) or "unknown"
            raise DeviceError(
                f"A module of the robot reports an error: {words}", "Remove the cause, then reset"
            )
        if codec.KINEMATICS_OK not in on:
            (code,) = self._modbus.read_input_registers(codec.KINEMATIC_ERROR, 1)
            raise DeviceError(
                f"The robot has a {codec.kinematic_words(code)}", "Choose another pose, then reset"
            )
        if codec.ENABLE not in on:
            raise DeviceError("The motors of the robot are off", "Check the emergency stop, then reset")
        return self._coil(codec.MOVING)

    def start_move(self, target_rad: FloatArray, speed_rad_s: float) -> None:
        """Target, speed, then the edge."""
        tenths = math.floor(1000.0 * speed_rad_s / self._config.max_speed_rad_s * (1 + 1e-9))
        if tenths < 1:
            slowest = math.degrees(self._config.max_speed_rad_s) / 1000.0
            raise DeviceError(
                f"Speed {math.degrees(speed_rad_s):.4f} deg/s, the slowest of this robot is {slowest:.4f}",
                "Give a higher speed, such as touch_speed in the cell file",
            )
        self._modbus.write_registers(codec.JOINT_TARGET, codec.angle_words(target_rad))
        self._modbus.write_register(codec.SPEED, min(tenths, 1000))
        self._edge(codec.MOVE_JOINTS)

    def start_linear(self, base_T_flange: Transform, speed_m_s: float) -> None:
        """Likewise on a straight line, in 0.1 mm/s."""
        angles = Rotation.from_matrix(base_T_flange.rotation).as_euler(self._config.euler)
        words = codec.length_words(base_T_flange.origin_m) + codec.angle_words(np.asarray(angles))
        self._modbus.write_registers(codec.POSE_TARGET, words)
        self._modbus.write_register(codec.SPEED, max(1, math.floor(speed_m_s * 1e4)))
        self._edge(codec.MOVE_CARTESIAN)

    def halt(self) -> None:
        """A new move stops the present one before it begins; this one leads nowhere."""
        self._modbus.write_registers(codec.JOINT_TARGET, [0] * 12)
        self._edge(codec.MOVE_JOINTS_RELATIVE)

    def recover(self) -> None:
        """Nothing: the stop was a move that has ended."""

    def contact_at(self, touched_s: float, late_s: float) -> Contact | None:
        """None: positions carry no time stamp."""
        return None

    def _prove_identity(self) -> tuple[str, str]:
        software, major, minor, mapping = self._modbus.read_input_registers(codec.SOFTWARE_ID, 4)
        name = codec.SOFTWARE.get(software, f"software {software}")
        if self._config.model and name != self._config.model:
            raise IdentityMismatch(
                f"The controller says it is {name}, the cell file {self._config.model}",
                "Check host and port, or correct the cell file",
            )
        if mapping != codec.MAPPING_VERSION:
            raise IdentityMismatch(
                f"Modbus mapping version {mapping}, this driver knows {codec.MAPPING_VERSION}",
                "Use a controller software with that version",
            )
        return name, f"{major}.{minor}"

    def _after_timeout(self) -> None:
        """Part of the resynchronisation: the controller that answers now is still the one that was asked."""
        self._prove_identity()

    def _coil(self, address: int) -> bool:
        return self._modbus.read_coils(address, 1)[0]

    def _edge(self, address: int) -> None:
        """Actions happen on a rising edge."""
        self._modbus.write_coil(address, False)
        self._modbus.write_coil(address, True)
