"""Watching a cell: live on a terminal, line by line elsewhere."""

import json
import sys
from collections.abc import Callable
from typing import Any, Final, Protocol, Self

from rich.console import Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.panel import Panel
from rich.progress_bar import ProgressBar

from controller.console.client import ConsoleError, DaemonClient
from controller.console.exit_codes import ExitCode
from controller.console.show import coloured, console, fault_text, progress_text, status_table
from controller.packml import State, allowed_commands

Status = dict[str, Any]

WAITING: Final = frozenset(state.value for state in State if not state.is_acting)
_WITHOUT_FAULT: Final = (State.EXECUTE, State.RESETTING, State.IDLE)  # none can be latched there


class View(Protocol):
    """Shows events as they come."""

    def __enter__(self) -> Self: ...
    def __exit__(self, *_: object) -> None: ...
    def show(self, status: Status, event: Status) -> None:
        """`status` as it is after `event`."""


class NoView:
    """Shows nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def show(self, status: Status, event: Status) -> None:
        pass


class JsonView(NoView):
    """One JSON document per event."""

    def show(self, status: Status, event: Status) -> None:
        print(json.dumps(event), flush=True)


class PlainView(NoView):
    """One line per event, for logs and pipes."""

    def show(self, status: Status, event: Status) -> None:
        match event["event"]:
            case "status" | "state":
                line = ": ".join(str(event[key]) for key in ("state", "message") if event.get(key))
            case "progress":
                line = progress_text(event)
            case "fault":
                line = f"fault {fault_text(event)}"
            case _:
                return
        if line:
            print(line, flush=True)


class LiveView:
    """A panel that is redrawn in place."""

    def __init__(self) -> None:
        self._live = Live(console=console(), refresh_per_second=8)

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.__exit__(None, None, None)

    def show(self, status: Status, event: Status) -> None:
        parts: list[RenderableType] = [status_table(status)]
        progress = status.get("progress") or {}
        if progress.get("steps"):
            parts.append(ProgressBar(total=progress["steps"], completed=progress.get("step", 0), width=60))
        title = f"{escape(str(status.get('cell') or 'cell'))}  {coloured(status['state'])}"
        self._live.update(Panel(Group(*parts), title=title, title_align="left", expand=False))


def choose_view(as_json: bool) -> View:
    """The view that suits standard output."""
    if as_json:
        return JsonView()
    return LiveView() if sys.stdout.isatty() else PlainView()


def updated(status: Status, event: Status) -> Status:
    """The status after an event."""
    match event["event"]:
        case "status":
            return event
        case "state":
            state = State(event["state"])
            return {
                **status,
                "state": state.value,
                "state_no": state.number,
                "allowed": [command.value for command in allowed_commands(state)],
                "message": event.get("message", ""),
                "fault": None if state in _WITHOUT_FAULT else status.get("fault"),
            }
        case "progress":
            return {**status, "progress": event}
        case "fault":
            return {**status, "fault": event}
        case _:
            return status


def follow(
    client: DaemonClient, view: View, until_waiting: bool, once_connected: Callable[[], object] | None = None
) -> Status:
    """Show events; with `until_waiting` return the status once the cell waits for somebody.

    `once_connected` runs when nothing can be missed any more. Raises ConsoleError when the daemon ends.
    """
    status: Status = {}
    with view:
        for event in client.events():
            status = updated(status, event)
            view.show(status, event)
            first = event["event"] == "status"
            if first and once_connected is not None:
                once_connected()
            elif until_waiting and event["event"] in ("status", "state") and event["state"] in WAITING:
                return client.get("/status")
    raise ConsoleError(
        ExitCode.NO_DAEMON, "The daemon has ended", "Start it again with `truecell serve CELL` to go on"
    )
