"""The states against ISA-TR88.00.02-2022, written here a second time and in another shape."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.packml import STATE_COMPLETE, Command, PackMLMachine, State, StateChange, allowed_commands
from estimation.errors import IllegalTransition

# One row per state; columns are the events in this order. "." is refused.
EVENT_TEXT = "Reset Start Stop Hold Unhold Suspend Unsuspend Abort Clear Complete StateComplete"
EVENTS = EVENT_TEXT.split()
REFERENCE_TEXT = """
1  Clearing     . . . . . . . Aborting . . Stopped
2  Stopped      Resetting . . . . . . Aborting . . .
3  Starting     . . Stopping Holding . . . Aborting . . Execute
4  Idle         . Starting Stopping . . . . Aborting . . .
5  Suspended    . . Stopping Holding . . Unsuspending Aborting . Completing .
6  Execute      . . Stopping Holding . Suspending . Aborting . Completing .
7  Stopping     . . . . . . . Aborting . . Stopped
8  Aborting     . . . . . . . . . . Aborted
9  Aborted      . . . . . . . . Clearing . .
10 Holding      . . Stopping . . . . Aborting . . Held
11 Held         . . Stopping . Unholding . . Aborting . Completing .
12 Unholding    . . Stopping Holding . . . Aborting . . Execute
13 Suspending   . . Stopping Holding . . . Aborting . . Suspended
14 Unsuspending . . Stopping Holding . . . Aborting . . Execute
15 Resetting    . . Stopping . . . . Aborting . . Idle
16 Completing   . . Stopping . . . . Aborting . . Completed
17 Completed    Resetting . Stopping . . . . Aborting . . .
"""
ROWS = [line.split() for line in REFERENCE_TEXT.strip().splitlines()]
REFERENCE = {
    (row[1], event): target
    for row in ROWS
    for event, target in zip(EVENTS, row[2:], strict=True)
    if target != "."
}
CELLS = [(row[1], event) for row in ROWS for event in EVENTS]


def step(machine: PackMLMachine, event: str) -> State:
    return machine.state_complete() if event == STATE_COMPLETE else machine.fire(Command(event))


def test_the_reference_covers_every_state_and_event() -> None:
    assert len(CELLS) == 187
    assert {row[1] for row in ROWS} == {state.value for state in State}
    assert {*EVENTS} == {*Command, STATE_COMPLETE}


@pytest.mark.parametrize(("state", "event"), CELLS)
def test_every_state_and_event(state: str, event: str) -> None:
    machine = PackMLMachine(State(state))
    if (state, event) in REFERENCE:
        assert step(machine, event) == machine.state == REFERENCE[state, event]
    else:
        with pytest.raises(IllegalTransition, match=f"{event} while {state}"):
            step(machine, event)
        assert machine.state == state


def test_numbers_are_those_of_isa() -> None:
    assert {state.value: state.number for state in State} == {row[1]: int(row[0]) for row in ROWS}
    assert [command.number for command in (Command.RESET, Command.START, Command.COMPLETE)] == [1, 2, 10]


def test_waiting_states_are_left_only_by_a_command() -> None:
    waiting = {state for state in State if not state.is_acting}
    assert waiting == {
        State.STOPPED, State.IDLE, State.SUSPENDED, State.ABORTED, State.HELD, State.COMPLETED
    }  # fmt: skip


def test_a_refusal_names_what_is_allowed() -> None:
    with pytest.raises(IllegalTransition) as refused:
        PackMLMachine(State.EXECUTE).fire(Command.UNHOLD)
    assert refused.value.problem == "Unhold while Execute"
    assert refused.value.remedy == "Allowed now: Stop, Hold, Suspend, Abort, Complete"
    with pytest.raises(IllegalTransition, match="ends by itself"):
        PackMLMachine(State.ABORTING).fire(Command.START)
    assert allowed_commands(State.ABORTED) == (Command.CLEAR,)


def test_listeners_hear_changes_and_no_refusals() -> None:
    machine, heard = PackMLMachine(State.IDLE), list[StateChange]()
    machine.on_change(heard.append)
    machine.fire(Command.START)
    with pytest.raises(IllegalTransition):
        machine.fire(Command.START)
    machine.state_complete()
    assert heard == [
        StateChange(State.IDLE, Command.START, State.STARTING),
        StateChange(State.STARTING, STATE_COMPLETE, State.EXECUTE),
    ]


@given(st.sampled_from(State), st.lists(st.sampled_from(EVENTS), max_size=200))
def test_a_random_walk_follows_the_reference(start: State, events: list[str]) -> None:
    machine, expected = PackMLMachine(start), start.value
    for event in events:
        if (expected, event) in REFERENCE:
            step(machine, event)
            expected = REFERENCE[expected, event]
        else:
            with pytest.raises(IllegalTransition):
                step(machine, event)
        assert machine.state == expected
        assert [*machine.allowed()] == [c for c in Command if (expected, c.value) in REFERENCE]
