"""What `truecell` returns to the shell. Scripts rely on these numbers: add, never change."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any


class ExitCode(IntEnum):
    """Documented in docs/console.md, which a test compares with this list."""

    OK = 0
    DEFECT = 1
    BAD_INPUT = 2
    NO_DAEMON = 3
    REFUSED = 4
    NOT_OK = 5
    NOT_DECIDABLE = 6
    FAULT = 7
    SUSPENDED = 8
    STOPPED = 9
    ABORTED = 10
    INTERRUPTED = 130

    @property
    def meaning(self) -> str:
        """One line for people."""
        return _MEANINGS[self]


_MEANINGS = {
    ExitCode.OK: "done; a job: all phases OK",
    ExitCode.DEFECT: "unexpected defect of truecell",
    ExitCode.BAD_INPUT: "bad input: wrong usage, cell file with mistakes, unknown run or sample",
    ExitCode.NO_DAEMON: "no daemon answers",
    ExitCode.REFUSED: "refused in the present state",
    ExitCode.NOT_OK: "verdict NotOK: proven to be outside a limit",
    ExitCode.NOT_DECIDABLE: "verdict NotDecidable: too uncertain to claim anything",
    ExitCode.FAULT: "Held by a fault, or verdict Undefined; for a command without daemon: its fault",
    ExitCode.SUSPENDED: "Suspended: the cause lies outside the cell",
    ExitCode.STOPPED: "Stopped, Idle or Held by a person: a job that did not end is no success",
    ExitCode.ABORTED: "Aborted: latched until Clear",
    ExitCode.INTERRUPTED: "Ctrl-C; the daemon and its job go on",
}

_OF_OUTCOME = {
    "OK": ExitCode.OK,
    "NotOK": ExitCode.NOT_OK,
    "NotDecidable": ExitCode.NOT_DECIDABLE,
    "Undefined": ExitCode.FAULT,
}
_SEVERITY = ("OK", "NotDecidable", "NotOK", "Undefined")


def code_of_outcome(outcome: str | None) -> ExitCode:
    """Of one verdict; anything unknown counts as Undefined."""
    return _OF_OUTCOME.get(outcome or "", ExitCode.FAULT)


def code_of_verdicts(verdicts: list[str]) -> ExitCode:
    """Of the worst of several verdicts; of none, Undefined."""
    known = [verdict if verdict in _SEVERITY else "Undefined" for verdict in verdicts]
    return code_of_outcome(max(known, key=_SEVERITY.index, default=None))


def code_of_status(status: Mapping[str, Any]) -> ExitCode:
    """Of a cell that waits: how the job ended, or why it waits."""
    progress = status.get("progress") or {}
    outcome = progress.get("outcome")
    match status.get("state"):
        case "Completed":
            return code_of_outcome(outcome)
        case "Held" if status.get("fault") is None:
            return ExitCode.STOPPED
        case "Held" if progress.get("activity") == "gated" and outcome not in (None, "OK"):
            return code_of_outcome(outcome)
        case "Held":
            return ExitCode.FAULT
        case "Suspended":
            return ExitCode.SUSPENDED
        case "Aborted":
            return ExitCode.ABORTED
        case "Stopped" | "Idle":
            return ExitCode.STOPPED
        case _:
            return ExitCode.DEFECT  # asked while the cell still acts
