"""The engine with a job and devices that do as they are told: every way out of every acting state."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from controller.engine import Engine
from controller.faults import GateHeld, OutsideCause
from controller.gates import Proof, Verdict
from controller.packml import Command, State
from drivers.capabilities import Devices, Identity, LinkHealth
from estimation.errors import (
    CellError,
    DeviceError,
    DeviceTimeout,
    IllegalTransition,
    MotionStopped,
    StoreError,
)
from estimation.statistics import Outcome
from simulators.virtual import VirtualClock

UNCERTAIN = Verdict(
    (Proof("U", 0.5, 0.4, "mm", Outcome.NOT_DECIDABLE),), "U is 0.500 mm, limit 0.400 mm", "Measure more"
)


@dataclass
class FakeDevice:
    """Connects, or fails as arranged."""

    name: str
    failure: CellError | None = None
    connected: int = 0
    stops: int = 0
    released: int = 0
    closed: int = 0

    def connect(self) -> Identity:
        if self.failure is not None:
            raise self.failure
        self.connected += 1
        return Identity(self.name, "1", "")

    def close(self) -> None:
        self.closed += 1

    def health(self) -> LinkHealth:
        return LinkHealth(0, 0, 0, 0)

    def stop(self) -> None:
        self.stops += 1

    def release(self) -> None:
        self.released += 1

    def is_at_rest(self) -> bool:
        return True


@dataclass
class FakeJob:
    """Runs a script: each call of `execute` does the next thing in `acts`."""

    acts: list[Callable[[Callable[[], None]], None]] = field(default_factory=list)
    impossible: CellError | None = None
    moved: CellError | None = None
    called: list[str] = field(default_factory=list)
    broken_store: bool = False

    def prepare(self) -> None:
        self.called.append("prepare")
        if self.impossible is not None:
            raise self.impossible

    def begin(self) -> None:
        self.called.append("begin")

    def execute(self, checkpoint: Callable[[], None]) -> None:
        self.called.append("execute")
        if self.acts:
            self.acts.pop(0)(checkpoint)

    def verify_reference(self) -> None:
        self.called.append("reference")
        if self.moved is not None:
            raise self.moved

    def complete(self) -> None:
        self.called.append("complete")

    def end(self, state: str) -> None:
        self.called.append(f"end {state}")

    def status(self) -> dict[str, Any]:
        return {"progress": {}}

    def record(self, kind: str, text: str, **data: Any) -> None:
        if self.broken_store:
            raise StoreError("Disk full", "Free space")


@dataclass
class Cell:
    job: FakeJob = field(default_factory=FakeJob)
    robot: FakeDevice = field(default_factory=lambda: FakeDevice("robot"))
    laser: FakeDevice = field(default_factory=lambda: FakeDevice("laser"))
    probe: FakeDevice = field(default_factory=lambda: FakeDevice("probe"))
    clock: VirtualClock = field(default_factory=VirtualClock)

    def __post_init__(self) -> None:
        devices = Devices(self.robot, self.laser, self.probe)  # type: ignore[arg-type]
        self.engine = Engine(self.job, devices, self.clock)

    def command(self, *commands: Command) -> State:
        for command in commands:
            self.engine.submit(command, "test")
            self.engine.run_until_waiting()
        return self.engine.state

    def start(self) -> State:
        return self.command(Command.RESET, Command.START)


@pytest.fixture
def cell() -> Cell:
    return Cell()


def _raise(error: BaseException) -> Callable[[Callable[[], None]], None]:
    def act(checkpoint: Callable[[], None]) -> None:
        raise error

    return act


def _then_checkpoint(cell: Cell, command: Command) -> Callable[[Callable[[], None]], None]:
    def act(checkpoint: Callable[[], None]) -> None:
        cell.engine.submit(command, "test")
        checkpoint()
        raise RuntimeError("went on after the checkpoint")

    return act


def test_an_undisturbed_job_completes(cell: Cell) -> None:
    assert cell.start() is State.COMPLETED
    assert cell.job.called == ["prepare", "begin", "execute", "complete"]
    assert cell.engine.status()["fault"] is None


@pytest.mark.parametrize(
    ("error", "state", "code"),
    [
        (DeviceTimeout("Laser silent for 0.25 s", "Check the cable"), State.HELD, "L4"),
        (DeviceError("Joint 2 is at 3 deg", "Look"), State.HELD, "D"),
        (GateHeld("hand-eye", UNCERTAIN), State.HELD, "G"),
        (OutsideCause("No part", "Put it in"), State.SUSPENDED, "P1"),
        (StoreError("Disk full", "Free space"), State.ABORTED, "S2"),
        (ZeroDivisionError("a defect"), State.ABORTED, "H7"),
    ],
)
def test_each_kind_of_error_ends_where_the_catalogue_says(
    cell: Cell, error: BaseException, state: State, code: str
) -> None:
    cell.job.acts = [_raise(error)]
    assert cell.start() is state
    fault = cell.engine.status()["fault"]
    assert fault["code"] == code and fault["text"] and fault["remedy"]
    assert "complete" not in cell.job.called
    assert cell.robot.stops > 0  # nothing moves in a wait state


def test_a_held_job_goes_on_after_the_reference(cell: Cell) -> None:
    cell.job.acts = [_raise(DeviceTimeout("Laser silent", "Check"))]
    cell.start()
    connected = cell.laser.connected
    assert cell.command(Command.UNHOLD) is State.COMPLETED
    assert cell.job.called[-4:] == ["execute", "reference", "execute", "complete"]
    assert cell.laser.connected == connected + 1  # a device fault: the identity is read again
    assert cell.engine.status()["fault"] is None


def test_a_moved_reference_holds_again(cell: Cell) -> None:
    cell.job.acts = [_raise(DeviceTimeout("Laser silent", "Check"))]
    cell.start()
    cell.job.moved = DeviceError("The reference moved by 0.6 mm, limit 0.2 mm", "Calibrate again")
    assert cell.command(Command.UNHOLD) is State.HELD
    assert "0.6 mm" in cell.engine.status()["fault"]["text"]


def test_the_reference_comes_before_the_reconnected_arm_measures(cell: Cell) -> None:
    cell.laser.failure = DeviceTimeout("Laser silent", "Check the cable")
    assert cell.start() is State.HELD
    assert "begin" not in cell.job.called
    assert cell.command(Command.UNHOLD) is State.HELD  # still unplugged
    cell.laser.failure = None
    assert cell.command(Command.UNHOLD) is State.COMPLETED


@pytest.mark.parametrize(
    ("command", "state"),
    [(Command.HOLD, State.HELD), (Command.SUSPEND, State.SUSPENDED), (Command.ABORT, State.ABORTED)],
)
def test_a_command_takes_effect_at_the_next_checkpoint(cell: Cell, command: Command, state: State) -> None:
    cell.job.acts = [_then_checkpoint(cell, command)]
    assert cell.start() is state


def test_stop_ends_the_run_without_a_verdict(cell: Cell) -> None:
    cell.job.acts = [_then_checkpoint(cell, Command.STOP)]
    assert cell.start() is State.STOPPED
    assert "end Stopped" in cell.job.called and "complete" not in cell.job.called


def test_an_arm_that_a_stop_command_stopped_is_not_a_fault(cell: Cell) -> None:
    def act(checkpoint: Callable[[], None]) -> None:
        stopper = threading.Thread(target=cell.engine.submit, args=(Command.STOP, "test"))
        stopper.start()
        stopper.join()
        raise MotionStopped("The arm was stopped", "Unhold")

    cell.job.acts = [act]
    assert cell.start() is State.STOPPED
    assert cell.engine.status()["fault"] is None


def test_an_arm_that_moves_on_is_not_called_stopped(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def moving() -> bool:
        cell.clock.sleep(0.1)
        return False

    monkeypatch.setattr(cell.robot, "is_at_rest", moving)
    cell.job.acts = [_then_checkpoint(cell, Command.STOP)]
    assert cell.start() is State.STOPPED
    status = cell.engine.status()
    assert status["message"] != "Stopped"
    assert status["fault"]["text"] == "The arm still moves 2 s after the request to stop"


def test_an_arm_that_stops_by_itself_is_a_fault(cell: Cell) -> None:
    cell.job.acts = [_raise(MotionStopped("The arm was stopped", "Find out why"))]
    assert cell.start() is State.HELD
    assert cell.engine.status()["fault"]["text"] == "The arm was stopped"


def test_a_limit_that_cannot_be_met_opens_no_device(cell: Cell) -> None:
    cell.job.impossible = GateHeld("localize", UNCERTAIN)
    assert cell.start() is State.HELD
    assert cell.robot.connected == cell.laser.connected == cell.probe.connected == 0


def test_a_refused_command_changes_nothing_and_says_what_is_allowed(cell: Cell) -> None:
    with pytest.raises(IllegalTransition, match=r"Unhold while Stopped.*Allowed now: Reset, Abort"):
        cell.engine.submit(Command.UNHOLD, "test")
    assert cell.engine.state is State.STOPPED and cell.job.called == []


def test_stop_reaches_the_robot_even_when_the_state_refuses_it(cell: Cell) -> None:
    with pytest.raises(IllegalTransition):
        cell.engine.submit(Command.STOP, "test")
    assert cell.robot.stops == 1


def test_a_broken_store_does_not_keep_the_arm_moving(cell: Cell) -> None:
    def act(checkpoint: Callable[[], None]) -> None:
        cell.job.broken_store = True
        raise StoreError("Disk full", "Free space")

    cell.job.acts = [act]
    assert cell.start() is State.ABORTED
    assert cell.robot.stops > 0 and cell.robot.closed > 0


def test_aborted_is_left_only_by_clear_then_reset_then_start(cell: Cell) -> None:
    cell.job.acts = [_raise(ZeroDivisionError("a defect"))]
    cell.start()
    for command in (Command.RESET, Command.START, Command.UNHOLD, Command.STOP):
        with pytest.raises(IllegalTransition):
            cell.engine.submit(command, "test")
    assert cell.command(Command.CLEAR) is State.STOPPED
    assert cell.start() is State.COMPLETED


def test_shutdown_stops_the_arm_and_ends_the_thread(cell: Cell) -> None:
    at_work, go_on = threading.Event(), threading.Event()

    def act(checkpoint: Callable[[], None]) -> None:
        at_work.set()
        go_on.wait(10)
        checkpoint()

    cell.job.acts = [act]
    thread = threading.Thread(target=cell.engine.run_forever)
    thread.start()
    cell.engine.submit(Command.RESET, "test")
    for state in _states(cell):
        if state is State.IDLE:
            break
    cell.engine.submit(Command.START, "test")
    assert at_work.wait(10)
    cell.engine.shutdown()
    go_on.set()
    thread.join(10)
    assert not thread.is_alive()
    assert cell.robot.stops > 0 and cell.robot.closed > 0


def _states(cell: Cell) -> Iterator[State]:
    """The states as they come, without sleeping."""
    changed = threading.Event()
    unsubscribe = cell.engine.subscribe(lambda event: changed.set())
    try:
        while True:
            yield cell.engine.state
            changed.wait(1)
            changed.clear()
    finally:
        unsubscribe()
