"""The CANopen master of one arm: SYNC, heartbeats, samples and the watch over the nodes.

Everything that is received passes through `_pump`. In the cell a keeper thread pumps while the driver
is not asked for anything, so that drives see SYNC and heartbeat; in the deterministic cell nothing runs
while nobody waits, and the keeper is not started.
"""

import contextlib
import functools
import math
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from operator import and_, or_
from typing import Final, NamedTuple

from drivers.clock import Clock
from drivers.links.canopen_sdo import SdoPort
from drivers.links.foreground import Foreground
from drivers.links.interfaces import CanFrame, CanLink
from drivers.robots import canopen_arm_codec as codec
from estimation.errors import DeviceError, DeviceTimeout

HEARTBEAT_PERIOD_S: Final = 0.1
MOST_DOUBLE_ANSWERS: Final = 10  # of one joint in DOUBLE_WINDOW SYNCs; a few are a link that stalls
DOUBLE_WINDOW: Final = 50
LOST_ANSWERS: Final = 25  # so many times the wait for an answer, and there is none
KEEPER_SLICE_S: Final = 0.005
DRAIN_LIMIT_S: Final = 0.5
SDO_BYTES: Final = 8
LAST_EMERGENCIES: Final = 64  # that are kept

_unpack_tpdo1 = codec.TPDO1.unpack  # 300 frames/s go through here


class Sample(NamedTuple):
    """What all joints answered to one SYNC."""

    number: int  # of the SYNC
    time_s: float  # when the SYNC was sent
    all_set: int  # statuswords, and
    any_set: int  # statuswords, or
    statuswords: tuple[int, ...]
    counts: tuple[int, ...]


class CanopenMaster:
    """One bus with one node per joint; only `interrupt` may be called from other threads."""

    def __init__(
        self,
        link: CanLink,
        clock: Clock,
        node_ids: Sequence[int],
        *,
        sync_period_s: float,
        cruise_sync_period_s: float,
        sdo_timeout_s: float,
        master_id: int,
        heartbeat_timeout_s: float,
        most_missed_syncs: int,
        latest_answer_s: float,
        on_fault: Callable[[], None],
    ) -> None:
        self._link, self._clock, self._on_fault = link, clock, on_fault
        self._heartbeat_timeout_s, self._most_missed = heartbeat_timeout_s, most_missed_syncs
        self._latest_answer_s = latest_answer_s
        self.sample_timeout_s = max(0.5, LOST_ANSWERS * latest_answer_s)
        self.node_ids = tuple(node_ids)
        self._period_s, self._heartbeat_id = sync_period_s, codec.HEARTBEAT + master_id
        self._cruise_period_s = max(sync_period_s, cruise_sync_period_s)
        self.sdo = SdoPort(link, node_ids, self._pump_for_sdo, sdo_timeout_s)
        self._tpdo = {codec.TPDO[0] + node: i for i, node in enumerate(self.node_ids)}
        self._emcy = {codec.EMCY + node: i for i, node in enumerate(self.node_ids)}
        self._heartbeats = {codec.HEARTBEAT + node: i for i, node in enumerate(self.node_ids)}
        self._full = (1 << len(self.node_ids)) - 1
        self.samples: deque[Sample] = deque(maxlen=256)
        self.frames = self.bad_frames = self.timeouts = 0
        self._foreground = Foreground()
        self._closing = threading.Event()
        self._keeper: threading.Thread | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the nodes: after the link was opened."""
        joints = len(self.node_ids)
        self._status, self._counts = [0] * joints, [0] * joints
        self._known_status, self._all_set, self._any_set = tuple[int, ...](), 0, 0
        self._nmt_state = [-1] * joints
        self._heard_s = [math.inf] * joints
        self._answered, self._awaiting, self._interrupted = 0, False, 0
        self._sync_number, self._sync_s, self._next_sync_s = 0, 0.0, math.inf
        self._next_heartbeat_s, self._cruise_until_s = math.inf, -math.inf
        self._due_s = math.inf
        self._missed, self._doubled = 0, [0] * joints
        self.samples.clear()
        self._news = 0  # complete samples and faults, for those who wait for either
        self.emergencies: deque[tuple[int, codec.Emergency]] = deque(maxlen=LAST_EMERGENCIES)
        self._fault: DeviceError | None = None

    # --- the driver's thread -------------------------------------------------------------------------

    def foreground(self) -> Foreground:
        """Exclusive use of the bus; the keeper stands back as long as anyone wants it."""
        return self._foreground

    def start_nodes(self, timeout_s: float = 1.0) -> None:
        """NMT start, SYNC and heartbeat; returns when every node has reported that it is operational."""

        def settled() -> bool:
            return self._fault is not None or all(s == codec.OPERATIONAL for s in self._nmt_state)

        self._nmt_state = [-1] * len(self.node_ids)
        self.sdo.send_nmt(codec.NMT_START)
        self._pump(self._clock.now_s() + timeout_s, settled)
        self.check()
        if not settled():
            late = [i for i, state in enumerate(self._nmt_state) if state != codec.OPERATIONAL]
            raise DeviceTimeout(
                f"{self.name(late)}: no operational heartbeat within {timeout_s:g} s after the start",
                "Check power and CAN wiring of this joint, then reset",
            )
        now = self._clock.now_s()
        self._heard_s = [now] * len(self.node_ids)
        self._next_sync_s = self._next_heartbeat_s = now

    def next_sample(self, timeout_s: float | None = None, *, in_fault: bool = False) -> Sample:
        """All joints at the first SYNC that is sent after this call.

        Raises the latched fault unless `in_fault`, and DeviceTimeout.
        """
        with self.foreground():
            timeout_s = self.sample_timeout_s if timeout_s is None else timeout_s
            asked, deadline_s = self._sync_number, self._clock.now_s() + timeout_s
            while True:
                if not in_fault:
                    self.check()
                if self.samples and self.samples[-1].number > asked:
                    return self.samples[-1]
                if self._clock.now_s() >= deadline_s:
                    raise DeviceTimeout(
                        f"No complete answer to SYNC within {timeout_s:g} s", "Check the CAN wiring"
                    )
                self._pump(deadline_s)

    def hurry(self) -> None:
        """Let the next SYNC leave as soon as the answers to the last one are in."""
        with self.foreground():
            if self._awaiting:
                self._pump(self._clock.now_s() + self._period_s / 2)
            self._next_sync_s = self._clock.now_s()

    @contextlib.contextmanager
    def cruising(self, until_s: float) -> Iterator[None]:
        """SYNC at the longer period as long as it fits in before `until_s`: nothing is expected earlier.

        A missing answer, an interruption, a fault or the end of the context returns to the short period.
        """
        self._cruise_until_s = until_s
        try:
            yield
        finally:
            with self.foreground():
                self._end_cruise()

    def _end_cruise(self) -> None:
        self._cruise_until_s = -math.inf
        if self._next_sync_s < math.inf:
            self._next_sync_s = min(self._next_sync_s, self._sync_s + self._period_s)

    def service(self) -> None:
        """Take what has arrived and send what is due, without waiting. Raises the latched fault."""
        with self.foreground():
            self._pump(self._clock.now_s())
            self.check()

    def check(self) -> None:
        """Raise what went wrong since the nodes were started."""
        if self._fault is not None:
            raise type(self._fault)(self._fault.problem, self._fault.remedy)

    def interrupt(self) -> None:
        """One SYNC out of turn, so that a stop acts at once; safe from any thread."""
        self._interrupted = 2  # SYNCs whose answers cannot be told from those to this one
        self._link.send(codec.SYNC, b"")

    def name(self, joints: Sequence[int]) -> str:
        """The joints in words."""
        return ", ".join(f"joint {i + 1} (node {self.node_ids[i]})" for i in joints).capitalize()

    def stop_sync(self) -> None:
        """End SYNC, heartbeat and the watch over the nodes."""
        self._next_sync_s = self._next_heartbeat_s = math.inf
        self._heard_s = [math.inf] * len(self.node_ids)

    # --- the keeper ----------------------------------------------------------------------------------

    def start_keeper(self) -> None:
        """Pump in the background from now on."""
        self._closing.clear()
        self._keeper = threading.Thread(target=self._keep, name="canopen-keeper", daemon=True)
        self._keeper.start()

    def stop_keeper(self) -> None:
        """End the background thread; safe twice."""
        self._closing.set()
        if self._keeper is not None:
            self._keeper.join()
            self._keeper = None

    def _keep(self) -> None:
        while not self._closing.is_set():
            self._foreground.idle.wait(self._period_s)
            if self._foreground.wanted or not self._foreground.lock.acquire(timeout=self._period_s):
                continue
            try:
                self._pump(self._clock.now_s() + KEEPER_SLICE_S)
            except DeviceError as error:
                self._latch(error)
                return
            except Exception as error:
                self._latch(DeviceError(f"The CAN keeper ended: {error!r}", "Reset; report it if it recurs"))
                return
            finally:
                self._foreground.lock.release()

    # --- receiving -----------------------------------------------------------------------------------

    def _pump_for_sdo(self, timeout_s: float, done: Callable[[], bool]) -> None:
        deadline_s = self._clock.now_s() + timeout_s
        while not done() and self._clock.now_s() < deadline_s:
            self._pump(deadline_s, done)

    def _pump(self, until_s: float, done: Callable[[], bool] | None = None) -> None:
        """Receive, and send what is due, until `until_s`, a complete sample or `done()`."""
        receive, now_s, dispatch = self._link.receive, self._clock.now_s, self._dispatch
        news = self._news
        now = now_s()
        while True:
            if now >= self._next_sync_s:
                if self._awaiting or now > self._next_sync_s + self._period_s:
                    self._drain(now + DRAIN_LIMIT_S)  # we were away: hear first what the nodes said
                    now = now_s()
                    if now > self._next_sync_s + self._period_s:
                        self._next_sync_s = now
                self._send_sync(now)
            if self._news != news:
                return
            limit_s = self._next_sync_s
            if until_s < limit_s:
                limit_s = until_s
            frames = receive(limit_s - now if limit_s > now else 0.0)
            now = now_s()
            if not frames:
                if now >= until_s:
                    return
                continue
            dispatch(frames)
            if self._news != news or (done is not None and done()) or now >= until_s + DRAIN_LIMIT_S:
                return

    def _drain(self, until_s: float) -> None:
        while (frames := self._link.receive(0.0)) and self._clock.now_s() < until_s:
            self._dispatch(frames)

    def _send_sync(self, now: float) -> None:
        self._watch(now)
        if now >= self._next_heartbeat_s:
            self._next_heartbeat_s = now + HEARTBEAT_PERIOD_S - self._period_s / 2
            self._link.send(self._heartbeat_id, bytes((codec.OPERATIONAL,)))
        if self._awaiting and now < self._sync_s + self._latest_answer_s:
            self._next_sync_s = self._sync_s + self._latest_answer_s  # one question at a time
            return
        if self._awaiting:
            # Stay silent for as long as an answer may be late: it must not be taken for the next one.
            self._awaiting = False
            self._missed += 1
            self.timeouts += 1
            if self._missed >= self._most_missed:
                silent = [i for i in range(len(self.node_ids)) if not self._answered >> i & 1]
                self._latch(
                    DeviceTimeout(
                        f"{self.name(silent)}: no answer to {self._missed} SYNCs in a row",
                        "Check power and CAN wiring of this joint, then reset",
                    )
                )
            self._next_sync_s = now + max(self._period_s, self._latest_answer_s)
            return
        self._answered, self._awaiting = 0, True
        if self._interrupted:
            self._interrupted -= 1
        self._sync_number += 1
        if self._sync_number % DOUBLE_WINDOW == 0:
            self._doubled = [0] * len(self.node_ids)
        self._sync_s = now
        period_s = self._cruise_period_s
        if now + period_s > self._cruise_until_s or self._missed or self._interrupted:
            period_s = self._period_s
        self._next_sync_s += period_s
        if self._next_sync_s <= now:
            self._next_sync_s = now + period_s
        self._due_s = self._next_sync_s
        self._link.send(codec.SYNC, b"")

    def _dispatch(self, frames: Sequence[CanFrame]) -> None:
        self.frames += len(frames)
        for can_id, data, time_s in frames:
            if (joint := self._tpdo.get(can_id)) is not None:
                self._take_answer(joint, data)
            elif (joint := self._heartbeats.get(can_id)) is not None:
                self._take_heartbeat(joint, data, time_s)
            elif (joint := self._emcy.get(can_id)) is not None:
                self._take_emergency(joint, data)
            elif 0x580 < can_id < 0x600:
                self.bad_frames += len(data) != SDO_BYTES
                self.sdo.deliver(can_id, data, time_s)

    def _take_answer(self, joint: int, data: bytes) -> None:
        """One joint's answer to SYNC."""
        if not self._awaiting:
            if self._answered == self._full:
                self._count_double(joint)
            return
        try:
            self._status[joint], self._counts[joint] = _unpack_tpdo1(data)
        except struct.error:  # another length
            self.bad_frames += 1
            return
        answered = self._answered | 1 << joint
        if answered == self._answered:
            self._count_double(joint)
        self._answered = answered
        if answered == self._full:
            self._complete_sample()

    def _complete_sample(self) -> None:
        self._awaiting, self._missed = False, 0
        self._next_sync_s = min(self._next_sync_s, self._due_s)
        if self._interrupted:
            return
        status, counts = tuple(self._status), tuple(self._counts)
        if status != self._known_status:
            self._known_status = status
            self._all_set, self._any_set = functools.reduce(and_, status), functools.reduce(or_, status)
        sample = Sample(self._sync_number, self._sync_s, self._all_set, self._any_set, status, counts)
        self.samples.append(sample)
        self._news += 1

    def _count_double(self, joint: int) -> None:
        if self._interrupted:
            return
        self._doubled[joint] += 1
        if self._doubled[joint] >= MOST_DOUBLE_ANSWERS:
            self._latch(
                DeviceError(
                    f"{self.name([joint])} answers twice to one SYNC: "
                    f"two nodes use {codec.TPDO[0] + self.node_ids[joint]:03X}h",
                    "Give every node on the bus its own id",
                )
            )

    def _take_heartbeat(self, joint: int, data: bytes, time_s: float) -> None:
        if len(data) != 1:
            self.bad_frames += 1
            return
        state, running = data[0] & 0x7F, self._heard_s[joint] != math.inf
        self._nmt_state[joint] = state
        if not running:
            return
        self._heard_s[joint] = time_s
        if state == codec.BOOT_UP:
            self._latch(
                DeviceError(
                    f"{self.name([joint])} restarted and lost its settings",
                    "Check its supply, then reset; what was measured since its last heartbeat is not used",
                )
            )
        elif state != codec.OPERATIONAL:
            self._latch(
                DeviceError(
                    f"{self.name([joint])} is {codec.NMT_STATES.get(state, state)} instead of operational",
                    "Check for a second master on the bus, then reset",
                )
            )

    def _take_emergency(self, joint: int, data: bytes) -> None:
        emergency = codec.parse_emergency(data)
        if emergency is None:
            self.bad_frames += 1
            return
        self.emergencies.append((joint, emergency))
        if not emergency.is_reset and self._heard_s[joint] != math.inf:
            self._latch(
                DeviceError(
                    f"{self.name([joint])} reports {emergency.words} (EMCY {emergency.code:04X}h)",
                    "Remove the cause, then reset",
                )
            )

    def _watch(self, now: float) -> None:
        if now - min(self._heard_s) > self._heartbeat_timeout_s:
            lost = [i for i, heard_s in enumerate(self._heard_s) if now - heard_s > self._heartbeat_timeout_s]
            self.timeouts += len(lost)
            self._latch(
                DeviceTimeout(
                    f"{self.name(lost)} lost: no heartbeat for {self._heartbeat_timeout_s:g} s",
                    "Check power and CAN wiring of this joint, then reset",
                )
            )

    def _latch(self, fault: DeviceError) -> None:
        if self._fault is None:  # the first one names the cause
            self._fault = fault
            self._news += 1
            self._end_cruise()  # what `on_fault` sends acts with the next SYNC
            with contextlib.suppress(DeviceError):
                self._on_fault()
