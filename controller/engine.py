"""The engine: one thread that owns the machine's acting states and drives the job through Execute.

Commands come from any thread and take effect on the state at once; the engine notices at its next
checkpoint. Stop and Abort also ask the robot to stop, from the commanding thread, before anything
else. Tests and the deterministic cell single-step the same engine with `run_until_waiting`.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from controller.faults import Defect, Fault, GateHeld, Interrupted, OutsideCause, fault_code
from controller.packml import Command, PackMLMachine, State, StateChange
from drivers.capabilities import Devices
from drivers.clock import Clock
from estimation.errors import (
    CellError,
    DeviceError,
    IllegalTransition,
    MotionStopped,
    StillMoving,
    StoreError,
)

log = logging.getLogger(__name__)

REST_TIMEOUT_S = 2.0

Listener = Callable[[dict[str, Any]], None]


@dataclass(frozen=True, slots=True)
class Reply:
    """A command was accepted; the machine is now in `state`."""

    command: Command
    state: State


class Job(Protocol):
    """What the engine runs inside Execute."""

    def prepare(self) -> None:
        """Before anything is opened: refuse what cannot succeed. Raises CellError."""

    def begin(self) -> None:
        """Open a run, or find the one to go on with."""

    def execute(self, checkpoint: Callable[[], None]) -> None:
        """Phases to the end. Raises Interrupted from `checkpoint`, and CellError for faults."""

    def verify_reference(self) -> None:
        """After an interruption: measure a known point again. Raises CellError if it moved."""

    def complete(self) -> None:
        """Close the run with its verdict."""

    def end(self, state: str) -> None:
        """Close the run without a verdict: a stopped run is never a success."""

    def status(self) -> dict[str, Any]:
        """Phase, step, progress, estimates, for people."""

    def record(self, kind: str, text: str, **data: Any) -> None:
        """Write an event to the audit trail."""


class Engine:
    """Couples machine, job and devices."""

    def __init__(
        self, job: Job, devices: Devices, clock: Clock, *, initial: State = State.STOPPED, reason: str = ""
    ) -> None:
        self._job, self._devices, self._clock = job, devices, clock
        self._machine = PackMLMachine(initial)
        self._machine.on_change(self._announce)
        self._lock = threading.RLock()
        self._wake = threading.Condition(self._lock)
        self._listeners: list[Listener] = []
        self._halting = 0
        self._shutdown = False
        self._connected = False
        self._began = False
        self._fault: Fault | None = None
        self._message = reason
        if initial is State.ABORTED:
            self._fault = Fault(
                "H1", reason, "Clear, Reset and Start go on from the last checkpoint", clock.utc_s()
            )
        self._handlers: Mapping[State, Callable[[], object]] = {
            State.CLEARING: self._clearing,
            State.RESETTING: self._resetting,
            State.STARTING: self._starting,
            State.EXECUTE: self._execute,
            State.HOLDING: self._come_to_rest,
            State.UNHOLDING: self._return_to_execute,
            State.SUSPENDING: self._come_to_rest,
            State.UNSUSPENDING: self._return_to_execute,
            State.COMPLETING: self._completing,
            State.STOPPING: self._stopping,
            State.ABORTING: self._come_to_rest,
        }

    # Commands, from any thread

    @property
    def state(self) -> State:
        return self._machine.state

    def submit(self, command: Command, who: str = "operator", reason: str = "") -> Reply:
        """Obey or refuse at once. Raises IllegalTransition with what is allowed now."""
        halts = command in (Command.STOP, Command.ABORT)
        if halts:
            self._halting += 1  # the engine must not take the stopped arm for a fault of its own
            self.request_stop()
        with self._wake:
            try:
                if self._shutdown and command is Command.START:
                    raise IllegalTransition("Start while the daemon shuts down", "Start the daemon again")
                before = self._machine.state
                state = self._machine.fire(command)
                self._job.record(
                    "command",
                    f"{command} by {who}" + (f": {reason}" if reason else ""),
                    command=command.value,
                    who=who,
                    reason=reason,
                    before=before.value,
                    after=state.value,
                )
                return Reply(command, state)
            finally:
                self._halting -= halts
                self._wake.notify_all()

    def request_stop(self) -> None:
        """Ask the robot to stop, now. Safe from any thread, at any time."""
        try:
            self._devices.robot.stop()
        except CellError as error:
            log.warning("request stop: %s", error)

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Call `listener` with every event, in the engine's thread; returns how to unsubscribe."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def publish(self, event: dict[str, Any]) -> None:
        """Tell everybody who watches."""
        for listener in tuple(self._listeners):
            listener(event)

    def status(self) -> dict[str, Any]:
        """A snapshot for console, page and scripts."""
        state = self._machine.state
        counters = self._devices.counters() if self._connected else {"devices": {}, "links": {}}
        return {
            "state": state.value,
            "state_no": state.number,
            "allowed": [command.value for command in self._machine.allowed()],
            "message": self._message,
            "fault": None if self._fault is None else asdict(self._fault),
            **counters,
            **self._job.status(),
        }

    # The engine's own thread

    def run_forever(self) -> None:
        """Act until `shutdown`."""
        while not self._shutdown:
            self.run_until_waiting()
            with self._wake:
                self._wake.wait_for(lambda: self._shutdown or self._machine.state.is_acting)
        self._disconnect()

    def shutdown(self) -> None:
        """End `run_forever` after the present acting state; the arm is asked to stop."""
        with self._lock:
            self._shutdown = True
            if self._machine.accepts(Command.STOP) and self._machine.state.is_acting:
                self._machine.fire(Command.STOP)
            self._wake.notify_all()
        self.request_stop()

    def run_until_waiting(self) -> State:
        """Work off acting states until a wait state is reached; returns it."""
        while (handler := self._handlers.get(state := self._machine.state)) is not None:
            try:
                handler()
            except Interrupted:
                continue
            except MotionStopped as error:
                if not self._halted_by_command(state):  # the arm was stopped behind our back
                    self._leave(Command.HOLD, error)
                continue
            except OutsideCause as error:
                self._leave(Command.SUSPEND, error)
                continue
            except StoreError as error:
                self._leave(Command.ABORT, error)
                continue
            except CellError as error:
                self._leave(Command.HOLD, error)
                continue
            except Exception as error:
                log.exception("Defect in state %s", state)
                wrapped = Defect(
                    f"Internal error: {error!r}", "Report it with the log; Clear and Reset to go on"
                )
                self._leave(Command.ABORT, wrapped)
                continue
            with self._lock:
                if self._machine.state is state:
                    if state is State.EXECUTE:
                        self._machine.fire(Command.COMPLETE)
                    else:
                        self._machine.state_complete()
        return self._machine.state

    def _halted_by_command(self, state: State) -> bool:
        with self._wake:
            while self._halting and self._machine.state is state:
                self._wake.wait(1.0)
            return self._machine.state is not state

    def _leave(self, command: Command, error: CellError) -> None:
        """Latch the fault and leave the acting state by `command`, or the hardest one that it accepts."""
        fault = self._latch(error)
        self._connected = self._connected and not isinstance(error, DeviceError)
        verdict = error.verdict.to_dict() if isinstance(error, GateHeld) else None
        with self._lock:
            self._record_fault(fault, verdict)
            for choice in (command, Command.HOLD, Command.ABORT):
                if self._machine.accepts(choice):
                    self._machine.fire(choice)
                    return
            if self._machine.state.is_acting:  # Holding, Stopping, Aborting, Completing: end there anyhow
                self._machine.state_complete()

    def _latch(self, error: CellError) -> Fault:
        fault = self._fault = Fault(fault_code(error), error.problem, error.remedy, self._clock.utc_s())
        self._message = str(error)
        return fault

    def _record_fault(self, fault: Fault, verdict: dict[str, Any] | None) -> None:
        try:
            self._job.record("fault", fault.text, code=fault.code, remedy=fault.remedy, verdict=verdict)
        except StoreError as error:  # the store itself is the fault
            log.error("audit: %s", error)
        self.publish({"event": "fault", **asdict(fault)})

    def _checkpoint(self) -> None:
        if self._machine.state is not State.EXECUTE:
            raise Interrupted

    # Acting states

    def _clearing(self) -> None:
        self._connect()
        self._forget_fault("Cleared")

    def _resetting(self) -> None:
        self._began = False
        self._forget_fault("Ready to start")

    def _starting(self) -> None:
        self._job.prepare()
        self._connect()
        self._job.begin()
        self._began = True
        self._forget_fault("")

    def _execute(self) -> None:
        self._job.execute(self._checkpoint)
        self._message = "All phases ended"

    def _come_to_rest(self) -> bool:
        """Holding, Suspending and Aborting: nothing moves any more, as far as the arm can still be asked.

        False when it can be asked, and moves.
        """
        self.request_stop()
        deadline_s, at_rest = self._clock.now_s() + REST_TIMEOUT_S, True
        try:
            while self._connected and not self._devices.robot.is_at_rest():
                if self._clock.now_s() > deadline_s:
                    raise StillMoving(
                        f"The arm still moves {REST_TIMEOUT_S:g} s after the request to stop",
                        "Use the stop at the robot, then Clear",
                    )
        except DeviceError as error:
            self._connected = False
            log.warning("coming to rest: %s", error)
            if isinstance(error, StillMoving):  # worse than what stopped it
                self._record_fault(self._latch(error), None)
                at_rest = False
        if self._machine.state is State.ABORTING:
            self._disconnect()
        return at_rest

    def _return_to_execute(self) -> None:
        """Unholding and Unsuspending: the cell is the one that was left, proven by a reference."""
        self._connect()
        if not self._began:
            self._job.prepare()
            self._job.begin()
            self._began = True
        self._job.verify_reference()
        self._forget_fault("")

    def _stopping(self) -> None:
        at_rest = self._come_to_rest()
        if self._began:
            self._job.end(State.STOPPED.value)
            self._began = False
        if at_rest:
            self._message = "Stopped"

    def _completing(self) -> None:
        self._job.complete()
        self._began = False
        self._message = "Completed"

    def _connect(self) -> None:
        """Links open, identities as declared, drives enabled, no motion."""
        if not self._connected:
            for device in self._devices.all():
                identity = self._devices.connect(device)
                self._job.record(
                    "connected",
                    f"{identity.model} {identity.serial_number}".strip(),
                    identity=asdict(identity),
                )
            self._connected = True
        self._devices.robot.release()

    def _disconnect(self) -> None:
        self._connected = False
        for device in self._devices.all():
            try:
                device.close()
            except CellError as error:
                log.warning("close: %s", error)

    def _forget_fault(self, message: str) -> None:
        self._fault, self._message = None, message

    def _announce(self, change: StateChange) -> None:
        try:
            self._job.record("state", f"{change.source} -> {change.target}", event=str(change.event))
        except StoreError as error:
            log.error("audit: %s", error)
        self.publish({"event": "state", "state": change.target.value, "message": self._message})
