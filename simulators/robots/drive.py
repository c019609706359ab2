"""One joint of the arm: CiA 402 drive with NMT, heartbeat, PDOs and profile position mode."""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from operator import call
from typing import Final

from simulators.canopen_objects import BAD_VALUE, Key, SdoAbort, SdoServer, Value, entry_of
from simulators.canopen_pdo import SYNCHRONOUS, TimedPdo, active_pdos, check_pdo_write, default_can_ids
from simulators.robots import touch_input
from simulators.robots.drive_objects import ENTRIES
from simulators.robots.drive_states import TRANSITIONS, Command, DriveState, command_of
from simulators.robots.motion_profile import AxisMotion
from simulators.robots.positioner import INTERPOLATED, PROFILE_POSITION, Positioner
from simulators.robots.touch_input import TouchInput

MODES: Final = (1, 2, 7)
HEARTBEAT_LOST: Final = 0x8130  # life guard or heartbeat error; also for a silent SYNC
FOLLOWING_ERROR: Final = 0x8611
PDO_TOO_SHORT: Final = 0x8210
NEVER: Final = math.inf


class Nmt(IntEnum):
    """Network states, as a heartbeat shows them."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 0x7F


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """What the drive is at power-on. A count is 0.001 degree."""

    node: int
    device_name: str
    serial_number: int
    limits_counts: tuple[int, int]
    speed_limit: float  # counts/s
    acceleration: float  # counts/s^2
    quick_stop: float  # counts/s^2
    step_counts: float  # of the encoder
    enable_delay_s: float
    boot_time_s: float


class Drive:
    """Driven by its bus: `advance` to an instant, then what happens there. Positions in counts.

    `emit(time_s, can_id, data)` sends a frame; `noise()` is the error of one position reading.
    """

    def __init__(
        self,
        settings: DriveSettings,
        position: float,
        noise: Callable[[], float],
        emit: Callable[[float, int, bytes], None],
    ) -> None:
        self.settings = settings
        self.motion = AxisMotion(position)
        self.run_permitted = True
        self._noise, self._emit, self._step = noise, emit, settings.step_counts
        self._now_s = 0.0
        self._sdo = SdoServer(ENTRIES, self._read, self._write)
        self._touch: TouchInput | None = None
        self._power_on()
        self.nmt = Nmt.PRE_OPERATIONAL
        self._boot_s = NEVER

    def wire_touch_input(self, first_closing: Callable[[float, float], float | None]) -> None:
        """Give the drive a touch-probe input; `first_closing(since_s, until_s)` is when it closes."""
        self._touch = TouchInput(first_closing, self._measured_at)
        self._sdo = SdoServer({**ENTRIES, **touch_input.ENTRIES}, self._read, self._write)

    # -- life ------------------------------------------------------------------------------------

    def _power_on(self) -> None:
        """Everything that was set at run time is lost."""
        s = self.settings
        self.values: dict[Key, Value] = {key: entry.default for key, entry in ENTRIES.items()}
        default_can_ids(self.values, s.node)
        self.values[0x1008, 0] = s.device_name
        self.values[0x1018, 4] = s.serial_number
        self.values[0x607D, 1], self.values[0x607D, 2] = s.limits_counts
        self.values[0x6083, 0] = round(s.acceleration)
        if self._touch is not None:
            self._touch.reset()
        self.state = DriveState.SWITCH_ON_DISABLED
        self.nmt = Nmt.INITIALISING
        self._controlword = 0
        self._mode = int(self.values[0x6060, 0])
        self._positioner = Positioner(self.motion, self.values, s.speed_limit, self._now_s)
        self._consumed: dict[int, float] = {}  # nodes whose heartbeat is watched, and its longest period
        self._silent_s: dict[int, float] = {}  # when each of them counts as lost; once it was heard
        self._last_sync_s = -math.inf
        self._enable_s = self._heartbeat_s = self._sync_check_s = NEVER
        self._pending: dict[int, bytes] = {}
        self._configure_pdos()
        self.next_event_s = self._other_event_s = NEVER
        self._word, self._word_until_s = 0, -math.inf  # 6041h, and how long it stays so

    def network(self, command: int, time_s: float) -> None:
        """An NMT command; ignored before boot-up."""
        self._now_s = time_s
        if command in (0x81, 0x82):
            self._stop_motion()
            self._power_on()
            self._boot_s = time_s + self.settings.boot_time_s
        elif self.nmt is not Nmt.INITIALISING and command in (0x01, 0x02, 0x80):
            self.nmt = {0x01: Nmt.OPERATIONAL, 0x02: Nmt.STOPPED, 0x80: Nmt.PRE_OPERATIONAL}[command]
            self._pending.clear()
            if self.nmt is not Nmt.OPERATIONAL and self.state is DriveState.OPERATION_ENABLED:
                self._command(Command.QUICK_STOP)
        self._reschedule()

    def advance(self, time_s: float) -> None:
        """Let everything happen that is due by then, in order."""
        while self.next_event_s <= time_s:
            self._now_s = self.next_event_s
            if self._now_s < self._other_event_s:  # as nearly always: a heartbeat and nothing else
                self._beat()
                self.next_event_s = min(self._heartbeat_s, self._other_event_s)
            else:
                self._due()
                self._reschedule()
        self._now_s = time_s

    def _beat(self) -> None:
        self._emit(self._now_s, 0x700 + self.settings.node, bytes((self.nmt,)))
        self._heartbeat_s += int(self.values[0x1017, 0]) / 1000

    def _due(self) -> None:
        now = self._now_s
        if now >= self._boot_s:
            self._boot_s, self.nmt = NEVER, Nmt.PRE_OPERATIONAL
            self._emit(now, 0x700 + self.settings.node, b"\x00")
        if now >= self._enable_s:
            self._enable_s, self.state = NEVER, DriveState.OPERATION_ENABLED
        if now >= self._heartbeat_s:
            self._beat()
        if now >= self.motion.end_s:
            if self.state is DriveState.QUICK_STOP_ACTIVE:  # 605Ah is absent: the usual option, 2
                self.state = DriveState.SWITCH_ON_DISABLED
            elif self.state is DriveState.FAULT_REACTION_ACTIVE:
                self.state = DriveState.FAULT
        if now >= self._positioner.buffered_start_s:
            self._positioner.start_buffered(now)
            self._watch_sync()
        if now >= self._sync_check_s:
            self._sync_check_s = NEVER
            if self.motion.moving(now):
                self._sync_check_s = self._last_sync_s + self._sync_timeout_s()
                if self._sync_check_s <= now:
                    self._sync_check_s = NEVER
                    self.fault(HEARTBEAT_LOST, 0x11)
        if now >= self._event_timer_s:
            self._send_timed(now)
        for node in [node for node, deadline in self._silent_s.items() if now >= deadline]:
            del self._silent_s[node]  # watched again from its next heartbeat on
            if self.state is DriveState.OPERATION_ENABLED:
                self.fault(HEARTBEAT_LOST, 0x11)

    def _reschedule(self) -> None:
        ends = self.state in (DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)
        self._word_until_s = -math.inf
        self._other_event_s = min(
            self._boot_s,
            self._enable_s,
            self._sync_check_s,
            self._event_timer_s,
            max(self.motion.end_s, self._now_s) if ends else NEVER,
            max(self._positioner.buffered_start_s, self._now_s),
            *self._silent_s.values(),
        )
        self.next_event_s = min(self._heartbeat_s, self._other_event_s)

    def _sync_timeout_s(self) -> float:
        period_s = int(self.values[0x1006, 0]) * 1e-6
        return int(self.values[0x200E, 0]) * (period_s or self._interpolation_s())

    def _interpolation_s(self) -> float:
        return float(int(self.values[0x60C2, 1]) * 10.0 ** int(self.values[0x60C2, 2]))

    # -- frames ----------------------------------------------------------------------------------

    def heartbeat(self, node: int, time_s: float) -> None:
        """Somebody else's heartbeat; watched if 1016h says so."""
        if node in self._consumed:
            deadline = self._silent_s[node] = time_s + self._consumed[node]
            self._other_event_s = min(self._other_event_s, deadline)
            self.next_event_s = min(self.next_event_s, deadline)

    def request(self, data: bytes, time_s: float) -> bytes:
        """Answer to an SDO request; b"" if none."""
        if self.nmt in (Nmt.INITIALISING, Nmt.STOPPED):
            return b""
        self._now_s = time_s
        answer = self._sdo.answer(data)
        self._reschedule()
        return answer

    def receive(self, can_id: int, data: bytes, time_s: float) -> bool:
        """A process data frame; True if a move waits to be started."""
        if self.nmt is not Nmt.OPERATIONAL:
            return False
        pdo = self._receive_pdos[can_id]
        if len(data) < pdo.layout.size:
            self._emergency(PDO_TOO_SHORT, 0x11, time_s)
            return False
        self._now_s = time_s
        self._pending[can_id] = data
        return pdo.kind not in SYNCHRONOUS and self._apply_pending(synchronous=False)

    def answer_sync(self, time_s: float) -> list[tuple[int, bytes]]:
        """SYNC, first half: the identifiers and data of what is sent; all of it is true now."""
        if self.nmt is not Nmt.OPERATIONAL:
            return []
        self._now_s = self._last_sync_s = time_s
        return [(can_id, pack(*map(call, reads))) for can_id, pack, reads in self._on_sync]

    @property
    def awaits_sync(self) -> bool:
        """The second half has something to do."""
        return bool(self._pending) or self._mode == INTERPOLATED

    def sync_apply(self) -> bool:
        """SYNC, second half: take over the set-points received; True if a move waits to be started."""
        starts = bool(self._pending) and self._apply_pending(synchronous=True)
        if self._mode == INTERPOLATED and self._interpolating():
            self._word_until_s = -math.inf
            if not self._positioner.interpolate(self._interpolation_s(), self._now_s):
                self.fault(FOLLOWING_ERROR, 0x21)
            self._watch_sync()
        return starts

    def _apply_pending(self, synchronous: bool) -> bool:
        controlled = False
        for can_id in list(self._pending):
            pdo = self._receive_pdos[can_id]
            if (pdo.kind in SYNCHRONOUS) != synchronous:
                continue
            data = self._pending.pop(can_id)[: pdo.layout.size]
            for key, value in zip(pdo.keys, pdo.layout.unpack(data), strict=True):
                self.values[key] = value
                controlled |= key == (0x6040, 0)
                if key == (0x6060, 0) and value in MODES:
                    self._mode = value
        self._word_until_s = -math.inf
        return controlled and self._control()

    def _configure_pdos(self) -> None:
        self._receive_pdos = {pdo.can_id: pdo for pdo in active_pdos(ENTRIES, self.values, receive=True)}
        self._pending = {cob: data for cob, data in self._pending.items() if cob in self._receive_pdos}
        sent = [
            (pdo, (pdo.can_id, pdo.layout.pack, tuple(self._reader(key) for key in pdo.keys)))
            for pdo in active_pdos(ENTRIES, self.values, receive=False)
        ]
        self._on_sync = [frame for pdo, frame in sent if pdo.kind in SYNCHRONOUS]
        self._timed = [
            TimedPdo(self._now_s + pdo.event_s, pdo.event_s, frame)
            for pdo, frame in sent
            if pdo.event_s and pdo.kind not in SYNCHRONOUS
        ]
        self._event_timer_s = min([timed.due_s for timed in self._timed], default=NEVER)

    def _send_timed(self, time_s: float) -> None:
        for timed in self._timed:
            if timed.due_s <= time_s:
                timed.due_s += timed.period_s
                can_id, pack, reads = timed.frame
                if self.nmt is Nmt.OPERATIONAL:
                    self._emit(time_s, can_id, pack(*map(call, reads)))
        self._event_timer_s = min([timed.due_s for timed in self._timed], default=NEVER)

    @property
    def receive_ids(self) -> tuple[int, ...]:
        """CAN identifiers of the process data that this drive takes."""
        return tuple(self._receive_pdos)

    # -- objects ---------------------------------------------------------------------------------

    def _reader(self, key: Key) -> Callable[[], int | float]:
        live: dict[Key, Callable[[], int]] = {
            (0x6041, 0): self.statusword,
            (0x6061, 0): lambda: self._mode,
            (0x6062, 0): lambda: round(self.motion.position(self._now_s)),
            (0x6064, 0): self._measured,
            (0x606B, 0): lambda: round(self.motion.velocity(self._now_s)),
            (0x606C, 0): lambda: round(self.motion.velocity(self._now_s)),
            (0x20A0, 7): lambda: int(self.run_permitted),
        }
        if key in live:
            return live[key]
        return lambda: self.values[key]  # type: ignore[return-value]  # texts are not mappable

    def _measured(self) -> int:
        return self._measured_at(self._now_s)

    def _measured_at(self, time_s: float) -> int:
        step = self._step
        return int(round((self.motion.position(time_s) + self._noise()) / step) * step)

    def _read(self, key: Key) -> Value:
        if self._touch is not None and key in touch_input.ENTRIES:
            return self._touch.read(key, self._now_s)
        entry_of(ENTRIES, key)
        return self.values[key] if isinstance(self.values[key], str) else self._reader(key)()

    def _write(self, key: Key, value: Value) -> None:
        index, _ = key
        if self._touch is not None and key == touch_input.FUNCTION:
            self._touch.write(int(value), self._now_s)
        elif key == (0x6060, 0):
            if value not in MODES:
                raise SdoAbort(BAD_VALUE)
            self._mode = int(value)
        elif 0x1400 <= index < 0x1C00:
            check_pdo_write(ENTRIES, self.values, key, value)
        elif key == (0x1003, 0) and value != 0:
            raise SdoAbort(BAD_VALUE)
        self.values[key] = value
        if 0x1400 <= index < 0x1C00:
            self._configure_pdos()
        elif key == (0x1017, 0):
            self._heartbeat_s = self._now_s + int(value) / 1000 if value else NEVER
        elif index == 0x1016:
            words = [int(self.values[0x1016, sub]) for sub in (1, 2)]
            self._consumed = {word >> 16 & 0x7F: (word & 0xFFFF) / 1000 for word in words if word & 0xFFFF}
            self._silent_s.clear()
        elif key == (0x6040, 0) and self._control():
            self.start_move(1.0)

    # -- state machine ---------------------------------------------------------------------------

    def statusword(self) -> int:
        """6041h now."""
        now = self._now_s
        if now >= self._word_until_s:  # it was not asked for since something happened
            bits = self._positioner.status_bits(self._mode, self._interpolating(), now)
            self._word = self.state | 0x210 | bits  # voltage enabled, remote
            self._word_until_s = self.motion.end_s if self.motion.moving(now) else math.inf
        return self._word

    def _interpolating(self) -> bool:
        active = self._mode == INTERPOLATED and self._controlword & 0x10
        return bool(active) and self.state is DriveState.OPERATION_ENABLED

    def _command(self, command: Command) -> None:
        after = TRANSITIONS.get((self.state, command))
        if after is None or (command is Command.SHUTDOWN and not self.run_permitted):
            return
        if after is DriveState.OPERATION_ENABLED:
            if self._enable_s == NEVER:
                self._enable_s = self._now_s + self.settings.enable_delay_s
            return
        self._enable_s = NEVER
        if self.state is DriveState.OPERATION_ENABLED:
            self._stop_motion()
        self.state = after

    def permit(self, permitted: bool, time_s: float) -> None:
        """The cell's run permission (emergency stop, guard)."""
        self._now_s, self.run_permitted = time_s, permitted
        if not permitted and self.state is DriveState.OPERATION_ENABLED:
            self._command(Command.QUICK_STOP)
        elif not permitted:
            self._command(Command.DISABLE_VOLTAGE)
        self._reschedule()

    def fault(self, code: int, register: int) -> None:
        """Quick stop and latch; says so with an emergency frame."""
        if self.state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            return
        self._enable_s = NEVER
        self.state = DriveState.FAULT_REACTION_ACTIVE
        self._stop_motion()
        self._emergency(code, register, self._now_s)
        self._reschedule()

    def _emergency(self, code: int, register: int, time_s: float) -> None:
        self.values[0x1001, 0] = register
        if code:
            count = min(int(self.values[0x1003, 0]) + 1, 8)
            for sub in range(count, 1, -1):
                self.values[0x1003, sub] = self.values[0x1003, sub - 1]
            self.values[0x1003, 1], self.values[0x1003, 0] = code, count
        frame = struct.pack("<HB5x", code, register)
        self._emit(time_s, 0x80 + self.settings.node, frame)

    def _control(self) -> bool:
        """Act on a controlword just written; True if a move waits to be started."""
        word, before = int(self.values[0x6040, 0]), self._controlword
        self._controlword = word
        rising = word & ~before
        if self.state is DriveState.FAULT and rising & 0x80:
            self.state = DriveState.SWITCH_ON_DISABLED
            self._emergency(0, 0, self._now_s)
        elif self.state not in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            self._command(command_of(word))
        starts = False
        if not word & 0x10:
            self._positioner.release_set_point()
        if self.state is DriveState.OPERATION_ENABLED and self._mode == PROFILE_POSITION:
            starts = self._positioner.control(word, rising, self._now_s)
        self._reschedule()
        return starts

    # -- motion ----------------------------------------------------------------------------------

    def start_move(self, factor: float) -> None:
        """Start the move that waits, its time divided by `factor`."""
        self._positioner.start(self._now_s, factor)
        self._watch_sync()
        self._reschedule()

    @property
    def waiting_speed(self) -> float:
        """Profile velocity of the move that waits to be started, counts/s; 0 if it is no move."""
        return self._positioner.waiting_speed(self._now_s)

    def _watch_sync(self) -> None:
        if self.motion.moving(self._now_s) and self._last_sync_s > -math.inf:
            self._sync_check_s = self._last_sync_s + self._sync_timeout_s()

    def _stop_motion(self) -> None:
        self._positioner.stop(self.settings.quick_stop, self._now_s)
