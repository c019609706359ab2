"""The Robot capability of a CANopen CiA 402 arm, one node per joint, in profile position mode.

A move is two PDOs per joint: target and profile velocity (RPDO2), controlword and profile acceleration
(RPDO1). The new set-point bit is raised one SYNC after the target, so that no drive can start on the old one,
and all joints start at the same SYNC.
"""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from drivers.capabilities import (
    Contact,
    Identity,
    JointReadings,
    LinkHealth,
    RobotAbilities,
    StopWay,
    TouchProbe,
)
from drivers.clock import Clock
from drivers.links.interfaces import CanLink
from drivers.robots import canopen_arm_codec as codec
from drivers.robots.canopen_arm_setup import ArmConfig, ArmSetup
from drivers.robots.canopen_arm_units import JointUnits
from drivers.robots.canopen_latch import ContactLatch
from drivers.robots.canopen_master import CanopenMaster, Sample
from drivers.robots.canopen_path import PathFollower
from drivers.robots.rest import only_still_moving
from estimation.errors import DeviceError, DeviceTimeout, MotionStopped, StillMoving
from estimation.transform import FloatArray

_FAULT_BIT: Final = 1 << 3  # set in "fault" and "fault reaction active" only
_ENABLED_MASK: Final = 0x6F
_ENABLED: Final = 0x27
_NOT_ENABLED: Final = _ENABLED_MASK & ~_ENABLED
_DISABLE_TIMEOUT_S: Final = 1.0
_END_MARGIN: Final = 2  # SYNC periods; so long before its computed end a free move is watched closely


class CanopenArm:
    """Six (or any number of) synchronised joints.

    `stop` may be called from any thread; everything else from one thread at a time.
    `keep_alive_thread` keeps SYNC and heartbeat alive while no method runs; the deterministic cell, where
    nothing runs while nobody waits, goes without, and the drives are not told to watch the heartbeat.
    """

    def __init__(
        self, link: CanLink, config: ArmConfig, clock: Clock, *, keep_alive_thread: bool = True
    ) -> None:
        self._link, self._config, self._clock = link, config, clock
        self._keep_alive_thread = keep_alive_thread
        self._master = CanopenMaster(
            link,
            clock,
            config.node_ids,
            sync_period_s=config.sync_period_s,
            cruise_sync_period_s=config.cruise_sync_period_s,
            sdo_timeout_s=config.sdo_timeout_s,
            master_id=config.master_id,
            heartbeat_timeout_s=config.heartbeat_timeout_s,
            most_missed_syncs=config.most_missed_syncs,
            latest_answer_s=config.latest_answer_s,
            on_fault=self._quick_stop_all,
        )
        self._setup = ArmSetup(self._master, clock, config, master_is_watched=keep_alive_thread)
        self._joints = len(config.node_ids)
        self._units = JointUnits(config)
        self._path = PathFollower(
            link,
            clock,
            config,
            self._master,
            self._setup,
            self._units,
            self._command,
            self._motion_sample,
        )
        self._latch = ContactLatch(self._master, config) if config.touch_probe else None
        self._command_lock = threading.Lock()  # orders a stop against the frames of a starting move
        self._stop_requested = False
        self._connected, self._opened = False, 0
        self._halted = self._commanded = False
        self._acceleration = [1] * self._joints

    # --- Device --------------------------------------------------------------------------------------

    def connect(self) -> Identity:
        """Open the bus, compare identities, configure the PDOs, reset faults, enable the drives.

        Raises DeviceError, DeviceTimeout, IdentityMismatch.
        """
        self._connected = False
        self._master.stop_keeper()
        with self._master.foreground():
            self._link.reopen()
            self._opened += 1
            self._master.reset()
            identity = self._setup.configure()
            self._master.start_nodes()
            self._connected = True
            try:
                if not self._stop_requested:
                    self._enable(reset_faults=True)
                self._setup.check_mode()
            except BaseException:
                self._connected = False
                self._master.stop_sync()
                raise
        if self._keep_alive_thread:
            self._master.start_keeper()
        return identity

    def close(self) -> None:
        """Bring the arm to rest, disable the drives, release the bus; safe twice."""
        self._master.stop_keeper()
        if self._connected:
            self._connected = False
            disabled = False
            with contextlib.suppress(DeviceError), self._master.foreground():
                self._halt_and_wait()
                for controlword in (codec.SHUTDOWN, codec.DISABLE_VOLTAGE):
                    self._send_controlword([controlword] * self._joints)
                    self._master.next_sample(in_fault=True)
                    self._master.next_sample(in_fault=True)
                disabled = self._become_powerless()
            self._master.stop_sync()
            if disabled:  # else the drives go on to expect our heartbeat, and stop without it
                with contextlib.suppress(DeviceError):
                    self._setup.release()
        self._link.close()

    def _become_powerless(self) -> bool:
        """Whether all drives are without power before long: a brake or a ramp takes its time."""
        deadline_s = self._clock.now_s() + _DISABLE_TIMEOUT_S
        while self._clock.now_s() < deadline_s:
            sample = self._master.next_sample(in_fault=True)
            if all(codec.drive_state(word) in codec.POWERLESS for word in sample.statuswords):
                return True
        return False

    def health(self) -> LinkHealth:
        """Link counters."""
        master = self._master
        bad_frames = master.bad_frames + int(getattr(self._link, "bad_frames", 0))
        return LinkHealth(master.frames, bad_frames, master.timeouts, max(0, self._opened - 1))

    # --- Robot ---------------------------------------------------------------------------------------

    @property
    def abilities(self) -> RobotAbilities:
        """Quick stop with a SYNC out of turn; a contact is interpolated between SYNCs."""
        return RobotAbilities(
            StopWay.AT_ONCE,
            stop_delay_s=self._config.latest_answer_s,
            contact_delay_s=0.0,
            joint_resolution_rad=1.0 / self._config.counts_per_rad,
            joint_paths=True,
        )

    def move_joints(self, target_rad: FloatArray, speed_fraction: float = 1.0) -> None:
        """Move on a straight line in joint space; returns at rest within the in-position window.

        `target_rad` (joints,); `speed_fraction` in (0, 1] of the speed limits.
        Raises MotionStopped, DeviceError (outside limits, not at target, drive fault), DeviceTimeout.
        """
        if not 0.0 < speed_fraction <= 1.0:
            raise DeviceError(f"Speed fraction {speed_fraction:g}", "Give a fraction in (0, 1]")
        target = self._units.counts(target_rad)
        speed_rad_s = np.array(self._config.speed_limit_rad_s) * speed_fraction
        with self._at_rest_on_error():
            end_s, deadline_s = self._start(target, speed_rad_s)
            previous: Sample | None = None
            with self._master.cruising(end_s - _END_MARGIN * self._config.sync_period_s):
                while not self._arrived(previous, sample := self._motion_sample(), target):
                    previous = sample
                    if self._clock.now_s() > deadline_s:
                        raise self._units.not_at_target(sample.counts, target)
            self._wait(self._config.settle_time_s)

    def follow_path(self, path_rad: FloatArray) -> None:
        """Pass through joint positions (n, joints), one for each SYNC period; at rest at the last on return.

        In interpolated position mode, for paths that are no straight line in joint space. The path begins
        where the arm stands and keeps the speed limits; ramps at its ends are up to the caller.
        Raises as `move_joints`.
        """
        with self._at_rest_on_error():
            sample = self._ready()
            self._path.follow(self._path.plan(path_rad, sample.counts))
            self._commanded = False
            self._wait(self._config.settle_time_s)

    def move_until_contact(
        self, target_rad: FloatArray, speed_rad_s: float, probe: TouchProbe
    ) -> Contact | None:
        """Move towards the target until the probe trips; the joints at the contact.

        The joints are interpolated between the SYNC samples around the time of contact; where the drives have
        touch-probe inputs, they are what these held. None if the target was reached without contact. At rest
        on return. Raises as `move_joints`, and what the probe raises.
        """
        target = self._units.counts(target_rad)
        limits = np.minimum(np.array(self._config.speed_limit_rad_s), speed_rad_s)
        with self._at_rest_on_error():
            if self._latch is not None:
                self._require_connection()
                self._latch.arm()
            _, deadline_s = self._start(target, limits)
            seen = self._master.samples[-1]
            with self._master.foreground():  # nobody else on the bus: no thread keeps a reply waiting
                while (touched_s := probe.touched_at_s()) is None:
                    self._master.service()
                    sample = self._master.samples[-1]
                    if sample is seen:
                        if self._stop_requested:
                            raise self._stopped()
                        continue
                    self._check_sample(sample)
                    if self._arrived(seen, sample, target):
                        return None
                    if self._clock.now_s() > deadline_s:
                        raise self._units.not_at_target(sample.counts, target)
                    seen = sample
            # The SYNC that makes the halt act also samples the joints: the first sample after the contact.
            self._command(codec.ENABLE | codec.HALT)
            self._halted = True
            self._master.hurry()
            while self._motion_sample().time_s < touched_s:
                pass
            contact = self._units.contact_at(touched_s, list(self._master.samples), probe.poll_uncertainty_s)
            self._halt_and_wait()
            if self._latch is None:
                return contact
            within = limits * self._config.counts_per_rad * contact.late_s + self._units.apart
            seen_counts = contact.joints_rad * self._config.counts_per_rad
            held = self._latch.counts(seen_counts.tolist(), within.tolist())
            joints_rad = np.array(held, dtype=np.float64) / self._config.counts_per_rad
            return Contact(joints_rad, 1.0, self._config.latch_delay_s)

    def read_joints(self, count: int) -> JointReadings:
        """`count` consecutive samples, of SYNCs sent after the call; stamped with the time of the SYNC."""
        self._require_connection()
        samples = [self._master.next_sample() for _ in range(count)]
        counts = np.array([sample.counts for sample in samples], dtype=np.float64)
        times_s = np.array([sample.time_s for sample in samples])
        return JointReadings(times_s, counts.reshape(count, self._joints) / self._config.counts_per_rad)

    def is_at_rest(self) -> bool:
        """Two fresh samples agree, and every enabled drive reports its target or halt as reached."""
        self._require_connection()
        first = self._master.next_sample()
        return self._resting(first, self._master.next_sample())

    def stop(self) -> None:
        """Quick stop of all joints at once; safe from any thread, at any time, and twice."""
        with self._command_lock:
            self._stop_requested = True
            if self._connected:
                with contextlib.suppress(DeviceError):  # without a bus, the drives stop by their own watch
                    self._send_controlword_unlocked([codec.QUICK_STOP] * self._joints)
                    self._master.interrupt()

    def release(self) -> None:
        """Forget an earlier `stop`; the next move enables the drives again."""
        with self._command_lock:
            self._stop_requested = False

    # --- commands ------------------------------------------------------------------------------------

    def _send_controlword_unlocked(self, controlwords: Sequence[int]) -> None:
        for node, word, acceleration in zip(
            self._config.node_ids, controlwords, self._acceleration, strict=True
        ):
            self._link.send(codec.RPDO[0] + node, codec.RPDO1.pack(word, acceleration))

    def _send_controlword(self, controlwords: Sequence[int]) -> None:
        with self._command_lock:
            self._send_controlword_unlocked(controlwords)

    def _command(self, controlword: int) -> None:
        """The same controlword to all joints, unless a stop was requested."""
        with self._command_lock:
            if self._stop_requested:
                raise self._stopped()
            self._send_controlword_unlocked([controlword] * self._joints)

    def _quick_stop_all(self) -> None:
        """A joint in fault stops alone: the others have to be told."""
        if self._connected:
            self._send_controlword([codec.QUICK_STOP] * self._joints)

    def _enable(self, *, reset_faults: bool = False, timeout_s: float = 3.0) -> None:
        """Lead every drive to "operation enabled", one step of the table per SYNC."""
        self._halted = self._commanded = False
        deadline_s = self._clock.now_s() + timeout_s
        resetting = False
        while True:
            sample = self._master.next_sample()
            states = [codec.drive_state(word) for word in sample.statuswords]
            if all(state is codec.DriveState.OPERATION_ENABLED for state in states):
                return
            faults = [i for i, state in enumerate(states) if state is codec.DriveState.FAULT]
            expired = self._clock.now_s() > deadline_s
            if faults and (expired or not reset_faults):
                raise self._setup.fault_of(faults)
            if expired:
                stuck = [i for i, s in enumerate(states) if s is not codec.DriveState.OPERATION_ENABLED]
                words = states[stuck[0]] or f"statusword {sample.statuswords[stuck[0]]:04X}h"
                raise DeviceTimeout(
                    f"{self._master.name(stuck)} cannot be enabled within {timeout_s:g} s: {words}",
                    "Check the safety circuit and the supply of the drives, then reset",
                )
            resetting = not resetting  # a fault reset acts on the rising edge
            controlwords = [codec.NEXT_CONTROLWORD[s] if s else codec.DISABLE_VOLTAGE for s in states]
            for i in faults if resetting else ():
                controlwords[i] = codec.FAULT_RESET
            with self._command_lock:
                if self._stop_requested:
                    raise self._stopped()
                self._send_controlword_unlocked(controlwords)

    def _ready(self) -> Sample:
        """The drives enabled; where the joints are."""
        self._require_connection()
        sample = self._master.next_sample()
        if self._stop_requested:
            raise self._stopped()
        if faults := _joints_in_fault(sample):
            raise self._setup.fault_of(faults)
        if any(word & _ENABLED_MASK != _ENABLED for word in sample.statuswords):
            self._enable()
            sample = self._master.next_sample()
        return sample

    def _start(self, target: list[int], speed_limit_rad_s: FloatArray) -> tuple[float, float]:
        """Start all joints at one SYNC; returns when they should have arrived, and when they must have."""
        sample, config = self._ready(), self._config
        velocity, self._acceleration, duration_s = self._units.move(sample.counts, target, speed_limit_rad_s)
        # A halt stays until the new set-point replaces the old one: released alone, the old move would go on.
        self._command(codec.ENABLE | (codec.HALT if self._halted else 0))
        with self._command_lock:
            for node, counts, speed in zip(config.node_ids, target, velocity, strict=True):
                self._link.send(codec.RPDO[1] + node, codec.RPDO2.pack(counts, speed))
        self._master.hurry()  # the arm rests: nothing is sampled that would need evenly spaced SYNCs
        self._motion_sample()
        self._commanded = True
        self._command(codec.ENABLE | codec.NEW_SET_POINT | codec.CHANGE_IMMEDIATELY)
        self._master.hurry()
        within_s = self._master.sample_timeout_s
        acknowledge_by_s = self._clock.now_s() + within_s
        while not (sample := self._motion_sample()).all_set & codec.SET_POINT_ACKNOWLEDGED:
            if self._clock.now_s() > acknowledge_by_s:
                silent = [
                    i for i, word in enumerate(sample.statuswords) if not word & codec.SET_POINT_ACKNOWLEDGED
                ]
                raise DeviceTimeout(
                    f"{self._master.name(silent)} did not take the set-point within {within_s:g} s",
                    "Reset; if it recurs, check the mode of operation of this drive",
                )
        self._halted = False
        self._command(codec.ENABLE)
        now = self._clock.now_s()
        allowed_s = 1.1 * duration_s + config.settle_time_s + config.move_margin_s
        return now + duration_s, now + allowed_s

    # --- watching a move -----------------------------------------------------------------------------

    def _motion_sample(self) -> Sample:
        sample = self._master.next_sample()
        self._check_sample(sample)
        return sample

    def _check_sample(self, sample: Sample) -> None:
        """Raise if a move cannot go on."""
        if self._stop_requested:
            raise self._stopped()
        if not sample.any_set & _NOT_ENABLED and sample.all_set & _ENABLED == _ENABLED:
            if sample.any_set & codec.FOLLOWING_ERROR:
                joints = [i for i, word in enumerate(sample.statuswords) if word & codec.FOLLOWING_ERROR]
                raise DeviceError(
                    f"{self._master.name(joints)} does not follow its set-point",
                    "Check for a collision, the payload and the speed, then reset",
                )
            return
        faults = _joints_in_fault(sample)
        if faults:
            self._quick_stop_all()
            raise self._setup.fault_of(faults)
        off = [i for i, word in enumerate(sample.statuswords) if word & _ENABLED_MASK != _ENABLED]
        state = codec.drive_state(sample.statuswords[off[0]]) or "in an unknown state"
        raise DeviceError(
            f"{self._master.name(off)} is {state} during a move",
            "Check whether the safety system stopped the arm, then reset",
        )

    def _arrived(self, previous: Sample | None, sample: Sample, target: list[int]) -> bool:
        """At rest in the window, by the drives' word and by the positions of two samples."""
        if previous is None or not sample.all_set & codec.TARGET_REACHED:
            return False
        window, apart = self._units.window, self._units.apart
        return all(
            abs(now - wanted) <= window and abs(now - before) <= apart
            for now, before, wanted in zip(sample.counts, previous.counts, target, strict=True)
        )

    def _resting(self, first: Sample, second: Sample) -> bool:
        for word, before, now in zip(second.statuswords, first.counts, second.counts, strict=True):
            enabled = word & _ENABLED_MASK == _ENABLED
            if abs(now - before) > self._units.apart:
                return False
            # A drive that never got a set-point may leave the bit clear.
            if enabled and self._commanded and not word & codec.TARGET_REACHED:
                return False
        return True

    def _halt_and_wait(self) -> None:
        """Ramp down without disabling, unless a stop or a fault has already gone further."""
        with self._command_lock:
            if not self._stop_requested and self._master.samples:
                words = self._master.samples[-1].statuswords
                if all(word & _ENABLED_MASK == _ENABLED for word in words):
                    self._send_controlword_unlocked([codec.ENABLE | codec.HALT] * self._joints)
                    self._halted = True
        self._wait_for_rest()

    def _wait_for_rest(self) -> None:
        deadline_s = self._clock.now_s() + self._config.move_margin_s
        first = self._master.next_sample(in_fault=True)
        while not self._resting(first, second := self._master.next_sample(in_fault=True)):
            if self._clock.now_s() > deadline_s:
                raise StillMoving(
                    f"The arm is not at rest {self._config.move_margin_s:g} s after it was stopped",
                    "Use the emergency stop and check the brakes",
                )
            first = second

    @contextlib.contextmanager
    def _at_rest_on_error(self) -> Iterator[None]:
        """Whatever ends a move early, the arm is at rest before the error is raised.

        Raises StillMoving when it is not.
        """
        try:
            yield
        except BaseException as error:
            if self._connected:
                if not isinstance(error, MotionStopped):
                    with contextlib.suppress(DeviceError):
                        self._quick_stop_all()
                with only_still_moving(error):
                    self._wait_for_rest()
            raise

    def _wait(self, duration_s: float) -> None:
        until_s = self._clock.now_s() + duration_s
        while self._clock.now_s() < until_s:
            self._motion_sample()

    # --- errors -------------------------------------------------------------------------------------

    def _require_connection(self) -> None:
        if not self._connected:
            raise DeviceError("The arm is not connected", "Connect it first")

    @staticmethod
    def _stopped() -> MotionStopped:
        return MotionStopped(
            "The arm was stopped on request before its target", "Release the stop when motion is safe again"
        )


def _joints_in_fault(sample: Sample) -> list[int]:
    return [i for i, word in enumerate(sample.statuswords) if word & _FAULT_BIT]
