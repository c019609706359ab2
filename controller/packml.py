"""The machine states of the cell: PackML, ISA-TR88.00.02-2022, as one table.

The table holds the defaults of the 2022 report, and honours Hold also in Starting, Suspending,
Unsuspending and Unholding, so that a fault found there ends in Held instead of Aborted.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from transitions import Machine, MachineError

from estimation.errors import IllegalTransition


class State(StrEnum):
    """The 17 states; `number` is the ISA number (OPC 30060 numbers them otherwise)."""

    CLEARING = "Clearing"
    STOPPED = "Stopped"
    STARTING = "Starting"
    IDLE = "Idle"
    SUSPENDED = "Suspended"
    EXECUTE = "Execute"
    STOPPING = "Stopping"
    ABORTING = "Aborting"
    ABORTED = "Aborted"
    HOLDING = "Holding"
    HELD = "Held"
    UNHOLDING = "Unholding"
    SUSPENDING = "Suspending"
    UNSUSPENDING = "Unsuspending"
    RESETTING = "Resetting"
    COMPLETING = "Completing"
    COMPLETED = "Completed"

    @property
    def number(self) -> int:
        """ISA number, 1 to 17."""
        return _STATE_NUMBERS[self]

    @property
    def is_acting(self) -> bool:
        """The state does something and ends by itself, at the latest with StateComplete or Complete."""
        return self is State.EXECUTE or (self, STATE_COMPLETE) in TRANSITIONS


_STATE_NUMBERS: Final = {state: number for number, state in enumerate(State, start=1)}


class Command(StrEnum):
    """The 10 commands that a person or a host may give; `number` is the ISA number."""

    RESET = "Reset"
    START = "Start"
    STOP = "Stop"
    HOLD = "Hold"
    UNHOLD = "Unhold"
    SUSPEND = "Suspend"
    UNSUSPEND = "Unsuspend"
    ABORT = "Abort"
    CLEAR = "Clear"
    COMPLETE = "Complete"

    @property
    def number(self) -> int:
        """ISA number, 1 to 10 (0 means undefined)."""
        return _COMMAND_NUMBERS[self]


_COMMAND_NUMBERS: Final = {command: number for number, command in enumerate(Command, start=1)}

STATE_COMPLETE: Final = "StateComplete"  # only the engine fires it: an acting state has done its work


def _rows() -> Iterable[tuple[State, str, State]]:
    """Every accepted (state, event, next state)."""
    s, c = State, Command
    yield from (
        (s.CLEARING, STATE_COMPLETE, s.STOPPED),
        (s.STOPPED, c.RESET, s.RESETTING),
        (s.RESETTING, STATE_COMPLETE, s.IDLE),
        (s.IDLE, c.START, s.STARTING),
        (s.STARTING, STATE_COMPLETE, s.EXECUTE),
        (s.EXECUTE, c.COMPLETE, s.COMPLETING),  # the sequencer commands it when the last phase has ended
        (s.EXECUTE, c.SUSPEND, s.SUSPENDING),
        (s.HOLDING, STATE_COMPLETE, s.HELD),
        (s.HELD, c.UNHOLD, s.UNHOLDING),
        (s.HELD, c.COMPLETE, s.COMPLETING),
        (s.UNHOLDING, STATE_COMPLETE, s.EXECUTE),
        (s.SUSPENDING, STATE_COMPLETE, s.SUSPENDED),
        (s.SUSPENDED, c.UNSUSPEND, s.UNSUSPENDING),
        (s.SUSPENDED, c.COMPLETE, s.COMPLETING),
        (s.UNSUSPENDING, STATE_COMPLETE, s.EXECUTE),
        (s.COMPLETING, STATE_COMPLETE, s.COMPLETED),
        (s.COMPLETED, c.RESET, s.RESETTING),
        (s.STOPPING, STATE_COMPLETE, s.STOPPED),
        (s.ABORTING, STATE_COMPLETE, s.ABORTED),
        (s.ABORTED, c.CLEAR, s.CLEARING),
    )
    for state in (s.EXECUTE, s.SUSPENDED, s.STARTING, s.SUSPENDING, s.UNSUSPENDING, s.UNHOLDING):
        yield state, c.HOLD, s.HOLDING
    for state in s:
        if state not in (s.STOPPED, s.STOPPING, s.ABORTED, s.ABORTING, s.CLEARING):
            yield state, c.STOP, s.STOPPING
        if state not in (s.ABORTED, s.ABORTING):
            yield state, c.ABORT, s.ABORTING


TRANSITIONS: Final[Mapping[tuple[State, str], State]] = {
    (state, event): target for state, event, target in _rows()
}


def allowed_commands(state: State) -> tuple[Command, ...]:
    """The commands that `state` accepts, in the order of their numbers."""
    return tuple(command for command in Command if (state, command) in TRANSITIONS)


@dataclass(frozen=True, slots=True)
class StateChange:
    """One step of the machine; `event` is a Command or STATE_COMPLETE."""

    source: State
    event: str
    target: State


class _Model:
    """What `transitions` hangs its triggers on, kept apart from our typed interface."""

    state: str
    trigger: Callable[[str], bool]


class PackMLMachine:
    """The state of the cell, changed by one thread only; others may read `state`."""

    def __init__(self, initial: State = State.STOPPED) -> None:
        self._model = _Model()
        Machine(
            model=self._model,
            states=[state.value for state in State],
            transitions=[
                [str(event), state.value, target.value] for (state, event), target in TRANSITIONS.items()
            ],
            initial=initial.value,
            auto_transitions=False,
        )
        self._listeners: list[Callable[[StateChange], None]] = []

    @property
    def state(self) -> State:
        """The present state."""
        return State(self._model.state)

    def accepts(self, command: Command) -> bool:
        """Whether `fire(command)` would succeed now."""
        return (self.state, command) in TRANSITIONS

    def allowed(self) -> tuple[Command, ...]:
        """The commands that the present state accepts."""
        return allowed_commands(self.state)

    def on_change(self, listener: Callable[[StateChange], None]) -> None:
        """Call `listener` after every change, in this thread."""
        self._listeners.append(listener)

    def fire(self, command: Command) -> State:
        """Obey a command; returns the new state.

        Raises IllegalTransition, and changes nothing, when the present state does not accept it.
        """
        return self._step(command)

    def state_complete(self) -> State:
        """The acting state has done its work; returns the new state. Raises IllegalTransition."""
        return self._step(STATE_COMPLETE)

    def _step(self, event: str) -> State:
        source = self.state
        try:
            self._model.trigger(str(event))
        except MachineError:
            allowed = ", ".join(self.allowed()) or "nothing, this state ends by itself"
            raise IllegalTransition(f"{event} while {source}", f"Allowed now: {allowed}") from None
        change = StateChange(source, event, self.state)
        for listener in self._listeners:
            listener(change)
        return change.target
