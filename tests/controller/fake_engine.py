"""An engine that only knows its states: for the daemon and the console."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from controller.packml import Command, PackMLMachine, State


@dataclass(frozen=True)
class Reply:
    """What a command leads to."""

    command: Command
    state: State


class FakeEngine:
    """States and events without job and devices."""

    def __init__(self, initial: State = State.IDLE) -> None:
        self.machine = PackMLMachine(initial)
        self.heard: list[tuple[Command, str, str]] = []
        self.script: list[dict[str, Any] | State] = []  # what happens after Start, Clear or Reset
        self.extra: dict[str, Any] = {}  # more of the status
        self.was_shut_down = False
        self._listeners: list[Callable[[dict[str, Any]], None]] = []
        self._end = threading.Event()

    def submit(self, command: Command, who: str, reason: str = "") -> Reply:
        state = self.machine.fire(command)
        self.heard.append((command, who, reason))
        self._tell(state)
        if command in (Command.START, Command.CLEAR, Command.RESET):
            for happening in self.script:
                if isinstance(happening, State):
                    self.machine = PackMLMachine(happening)
                    self._tell(happening)
                else:
                    self.publish(happening)
        return Reply(command, state)

    def _tell(self, state: State) -> None:
        self.publish({"event": "state", "state": state.value, "message": ""})

    def publish(self, event: dict[str, Any]) -> None:
        for listener in self._listeners:
            listener(event)

    def status(self) -> dict[str, Any]:
        state = self.machine.state
        unknown = float("nan")
        return {"state": state.value, "state_no": state.number, "fault": None, "u_m": unknown, **self.extra}

    def subscribe(self, listener: Callable[[dict[str, Any]], None], /) -> Callable[[], None]:
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def run_forever(self) -> None:
        self._end.wait()

    def die(self) -> None:
        self._end.set()

    def shutdown(self) -> None:
        self.was_shut_down = True
        self._end.set()
