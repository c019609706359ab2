"""Connecting the arm: who answers, and what every drive has to be told before it may move."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

from drivers.capabilities import Identity
from drivers.clock import Clock
from drivers.links.canopen_sdo import SdoAbort
from drivers.robots import canopen_arm_codec as codec
from drivers.robots.canopen_master import HEARTBEAT_PERIOD_S, CanopenMaster
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch

DEVICE_TYPE_DRIVE: Final = 402  # low word of 1000h
PDO_DISABLED: Final = 1 << 31
ON_EVERY_SYNC: Final = 1

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ArmConfig:
    """Settings of one arm; per-joint tuples from the base outwards."""

    node_ids: tuple[int, ...]
    lower_rad: tuple[float, ...]
    upper_rad: tuple[float, ...]
    speed_limit_rad_s: tuple[float, ...]
    acceleration_limit_rad_s2: tuple[float, ...]
    in_position_rad: float
    sync_period_s: float = 0.02
    cruise_sync_period_s: float = 0.0  # far from the end of a free move; never below sync_period_s
    settle_time_s: float = 0.0  # waited at rest before a move returns
    counts_per_rad: float = 180_000.0 / math.pi  # 0.001 degree
    model: str = ""  # for the record
    device_name: str = ""  # expected in 1008h of every node; "" does not compare
    serial_numbers: tuple[int, ...] = ()  # expected in 1018h:4; empty does not compare
    master_id: int = 1
    master_timeout_s: float = 0.5  # the drives fault when the controller is silent for so long
    boot_timeout_s: float = 5.0
    sdo_timeout_s: float = 0.3
    move_margin_s: float = 2.0  # allowed on top of the computed duration of a move
    heartbeat_timeout_s: float = 2.5 * HEARTBEAT_PERIOD_S  # a node silent for so long is lost
    most_missed_syncs: int = 3  # unanswered in a row
    latest_answer_s: float = (
        0.02  # after its SYNC; a missed answer is waited for so long before the next SYNC
    )
    sync_timeout_factor: int | None = None  # 200Eh; None leaves what the drive has
    touch_probe: bool = False  # the probe is wired to the touch-probe input of every drive as well
    latch_delay_s: float = 1e-4  # of these inputs, at most


class ArmSetup:
    """What happens by SDO: before operation, and after a fault."""

    def __init__(
        self, master: CanopenMaster, clock: Clock, config: ArmConfig, *, master_is_watched: bool
    ) -> None:
        self._master, self._clock, self._config = master, clock, config
        self._master_is_watched = master_is_watched
        self._sdo = master.sdo

    def configure(self) -> Identity:
        """Identify and configure all drives; they are left pre-operational and disabled.

        A drive forgets all of this when it restarts. Raises DeviceError, DeviceTimeout, IdentityMismatch.
        """
        self._sdo.send_nmt(codec.NMT_PRE_OPERATIONAL)
        deadline_s = self._clock.now_s() + self._config.boot_timeout_s
        for joint in range(len(self._config.node_ids)):
            self._wait_until_booted(joint, deadline_s)
        identity = self._identify()
        for node in self._config.node_ids:
            self._configure_node(node)
        return identity

    def release(self) -> None:
        """Leave the drives pre-operational, no longer expecting our heartbeat."""
        for node in self._config.node_ids:
            self._write_if_present(node, 0x1016, 1, 0, 4)
        self._sdo.send_nmt(codec.NMT_PRE_OPERATIONAL)

    def change_mode(self, mode: int, second_rpdo: codec.PdoLayout) -> None:
        """Put all drives into another mode, with what RPDO2 carries in it. Raises DeviceError."""
        for node in self._config.node_ids:
            self._sdo.write(node, codec.MODE, 0, mode, 1)
            self._map_pdo(node, 0x1401, codec.RPDO[1], second_rpdo)
        self.check_mode(mode)

    def check_mode(self, wanted: int = codec.PROFILE_POSITION_MODE) -> None:
        """Refuse a drive whose mode display is another one."""
        for joint, node in enumerate(self._config.node_ids):
            deadline_s = self._clock.now_s() + 0.5
            while (mode := self._sdo.read_int(node, codec.MODE_DISPLAY, signed=True)) != wanted:
                if self._clock.now_s() > deadline_s:
                    raise DeviceError(
                        f"{self._master.name([joint])} shows mode {mode}, "
                        f"{codec.MODE_WORDS[wanted]} is {wanted}",
                        "Check for a second master on the bus, then reset",
                    )

    def fault_of(self, joints: list[int]) -> DeviceError:
        """The error for drives in fault: EMCY seen so far and the newest entry of 1003h."""
        reasons = list[str]()
        for joint in joints:
            code = next((e.code for j, e in reversed(self._master.emergencies) if j == joint), 0)
            with contextlib.suppress(DeviceError), self._master.foreground():
                code = self._sdo.read_int(self._config.node_ids[joint], 0x1003, 1) & 0xFFFF or code
            name = self._master.name([joint])
            reasons.append(f"{name} in fault: {codec.emergency_words(code)} ({code:04X}h)")
        return DeviceError("; ".join(reasons), "Remove the cause, then reset")

    def _wait_until_booted(self, joint: int, deadline_s: float) -> None:
        node = self._config.node_ids[joint]
        while True:
            try:
                device_type = self._sdo.read_int(node, 0x1000)
            except SdoAbort:
                return  # it answers
            except DeviceTimeout:
                if self._clock.now_s() < deadline_s:
                    continue
                raise DeviceTimeout(
                    f"{self._master.name([joint])} does not answer within {self._config.boot_timeout_s:g} s",
                    "Check power, bit rate, node id and CAN wiring of this joint",
                ) from None
            if device_type & 0xFFFF != DEVICE_TYPE_DRIVE:
                raise IdentityMismatch(
                    f"{self._master.name([joint])} is of device type {device_type & 0xFFFF}, "
                    f"a drive is {DEVICE_TYPE_DRIVE}",
                    "Check the node ids in the cell file",
                )
            return

    def _identify(self) -> Identity:
        config, nodes = self._config, self._config.node_ids
        names = [self._text(node, 0x1008) for node in nodes]
        serials = [self._number(node, 0x1018, 4) for node in nodes]
        for joint, name in enumerate(names):
            if config.device_name and name and name != config.device_name:
                raise IdentityMismatch(
                    f"{self._master.name([joint])} says it is {name!r}, the cell file {config.device_name!r}",
                    "Connect the arm that the cell file names, or correct the cell file",
                )
        for joint, (serial, expected) in enumerate(zip(serials, config.serial_numbers, strict=False)):
            if serial != str(expected):
                raise IdentityMismatch(
                    f"{self._master.name([joint])} has serial number {serial or 'unknown'}, "
                    f"the cell file {expected}",
                    "Another drive voids the calibration: calibrate again and correct the cell file",
                )
        firmware = sorted({self._text(node, 0x100A) for node in nodes})
        return Identity(
            model=config.model or names[0],
            serial_number=",".join(serials),
            firmware=",".join(firmware),
            settings=(
                ("drives", ",".join(sorted(set(names)))),
                ("counts_per_rad", repr(config.counts_per_rad)),
            ),
        )

    def _configure_node(self, node: int) -> None:
        sdo, config = self._sdo, self._config
        if codec.drive_state(sdo.read_int(node, codec.STATUSWORD)) is codec.DriveState.OPERATION_ENABLED:
            sdo.write(node, codec.CONTROLWORD, 0, codec.QUICK_STOP, 2)  # left over from an earlier session
        sdo.write(node, 0x1017, 0, round(HEARTBEAT_PERIOD_S * 1000), 2)
        watch_ms = round(config.master_timeout_s * 1000) if self._master_is_watched else 0
        consumer = config.master_id << 16 | watch_ms if watch_ms else 0
        self._write_if_present(node, 0x1016, 1, consumer, 4)
        if config.sync_timeout_factor is not None:
            self._write_if_present(node, 0x200E, 0, config.sync_timeout_factor, 1)
        # What the sync timeout counts in is not documented: every period object is told the truth.
        self._write_if_present(node, 0x1006, 0, round(config.sync_period_s * 1e6), 4)
        self._write_if_present(node, 0x60C2, 1, round(config.sync_period_s * 1000), 1)
        sdo.write(node, codec.MODE, 0, codec.PROFILE_POSITION_MODE, 1)
        self._map_pdo(node, 0x1800, codec.TPDO[0], codec.TPDO1)
        for number in (1, 2, 3):
            sdo.write(node, 0x1800 + number, 1, PDO_DISABLED | codec.TPDO[number] + node, 4)
        self._map_pdo(node, 0x1400, codec.RPDO[0], codec.RPDO1)
        self._map_pdo(node, 0x1401, codec.RPDO[1], codec.RPDO2)

    def _map_pdo(self, node: int, communication: int, base_id: int, layout: codec.PdoLayout) -> None:
        """CiA 301: a mapping changes while its PDO is off and its count is zero."""
        write, mapping = self._sdo.write, communication + 0x200
        write(node, communication, 1, PDO_DISABLED | base_id + node, 4)
        write(node, mapping, 0, 0, 1)
        for number, word in enumerate(layout.mapping, start=1):
            write(node, mapping, number, word, 4)
        write(node, mapping, 0, len(layout.mapping), 1)
        write(node, communication, 2, ON_EVERY_SYNC, 1)
        write(node, communication, 1, base_id + node, 4)

    def _write_if_present(self, node: int, index: int, subindex: int, value: int, size: int) -> None:
        def write() -> None:
            self._sdo.write(node, index, subindex, value, size)

        _if_present(write, None)

    def _text(self, node: int, index: int) -> str:
        raw = _if_present(lambda: self._sdo.read(node, index), b"")
        return raw.split(b"\0")[0].decode("ascii", errors="replace").strip()

    def _number(self, node: int, index: int, subindex: int) -> str:
        """The number in decimal, "" if the drive has no such object."""
        return _if_present(lambda: str(self._sdo.read_int(node, index, subindex)), "")


def _if_present(access: Callable[[], T], default: T) -> T:
    try:
        return access()
    except SdoAbort as abort:
        if not abort.is_missing:
            raise
        return default
