"""Answers of the daemon as tables for people."""

import os
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from controller.link_rows import COLUMNS, NOTE, link_rows

_COLOURS: Final = {
    "OK": "green",
    "NotOK": "red",
    "NotDecidable": "yellow",
    "Undefined": "magenta",
    "Execute": "green",
    "Completed": "green",
    "Held": "yellow",
    "Suspended": "yellow",
    "Aborted": "red",
    "Aborting": "red",
}
_WHOLE_COLUMNS: Final = ("step", "joints_deg", "on", "verdict")
_WIDTH_OF_FILES: Final = 200
_STATE_OF_RUN_OPEN: Final = "open"


def coloured(word: str) -> str:
    """A state or verdict in its colour; the word itself always says it too."""
    colour = _COLOURS.get(word)
    return f"[{colour}]{escape(word)}[/{colour}]" if colour else escape(word)


def local_time(utc_s: float | None) -> str:
    """Seconds since 1970 as date and time of this computer."""
    return "" if utc_s is None else f"{datetime.fromtimestamp(utc_s, UTC).astimezone():%Y-%m-%d %H:%M:%S}"


def progress_text(progress: Mapping[str, Any]) -> str:
    """'hand-eye acquiring 12/80, no target', as far as it is known."""
    words = [str(progress[key]) for key in ("phase", "activity") if progress.get(key)]
    if progress.get("steps"):
        words.append(f"{progress.get('step', 0)}/{progress['steps']}")
    text = " ".join(words)
    if progress.get("outcome"):
        text += f": {progress['outcome']}"
    return f"{text}, {progress['text']}" if progress.get("text") else text


def fault_text(fault: Mapping[str, Any]) -> str:
    """Code, what was seen, what to do."""
    return f"{fault.get('code', '?')}: {fault.get('text', '')}. {fault.get('remedy', '')}."


def status_table(status: Mapping[str, Any]) -> Table:
    """State, job, fault and links of a cell."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column()

    def row(name: str, text: str) -> None:
        if text:
            table.add_row(name, text)

    row("cell", escape(str(status.get("cell") or "")))
    row("state", f"{coloured(status['state'])} ({status.get('state_no')})")
    row("run", str(status.get("run") or ""))
    over = status["state"] in ("Stopped", "Aborted", "Idle")
    row("last step" if over else "job", escape(progress_text(status.get("progress") or {})))
    row("message", escape(str(status.get("message") or "")))
    if status.get("fault"):
        row("fault", f"[red]{escape(fault_text(status['fault']))}[/red]")
    row("allowed", ", ".join(status.get("allowed") or []))
    for name, health in (status.get("devices") or {}).items():
        row(name, ", ".join(f"{count} {what.replace('_', ' ')}" for what, count in health.items()))
    return table


def links_table(counters: Mapping[str, Any]) -> Table:
    """What drivers and links have counted."""
    table = Table(*COLUMNS, box=None, pad_edge=False, caption=NOTE, caption_justify="left")
    for row in link_rows(counters):
        table.add_row(*map(escape, row))
    return table


def results_table(results: Sequence[Mapping[str, Any]]) -> Table:
    """Verdicts with the numbers that they rest on."""
    table = Table("phase", "attempt", "verdict", "proof", "value", "limit", box=None, pad_edge=False)
    for result in results:
        verdict = (result.get("result") or {}).get("verdict") or {}
        table.add_row(escape(result["phase"]), str(result["attempt"]), coloured(result["verdict"]))
        for proof in verdict.get("proofs") or []:
            unit = proof.get("unit") or ""
            name = f"{coloured(proof['outcome'])} {escape(proof['name'])}"
            table.add_row("", "", "", name, *(_number(proof.get(key), unit) for key in ("value", "limit")))
        if verdict.get("message"):
            table.add_row("", "", "", escape(verdict["message"]))
        if verdict.get("remedy"):
            table.add_row("", "", "", f"[bold]{escape(verdict['remedy'])}[/bold]")
    return table


def _number(value: object, unit: str) -> str:
    text = f"{value:.4g}" if isinstance(value, int | float) else "" if value is None else str(value)
    return f"{text} {escape(unit)}".strip()


def history_table(runs: Sequence[Mapping[str, Any]]) -> Table:
    """Runs with their verdicts, newest first."""
    table = Table("run", "started", "ended", "end", "verdicts", box=None, pad_edge=False)
    for run in runs:
        verdicts = ", ".join(f"{escape(phase)} {coloured(v)}" for phase, v in run["verdicts"].items())
        end = run["end_state"] or _STATE_OF_RUN_OPEN
        if run["simulated"]:
            end += " (simulated)"
        times = local_time(run["started_utc_s"]), local_time(run["ended_utc_s"])
        table.add_row(str(run["id"]), *times, coloured(end), verdicts)
    return table


def samples_table(samples: Sequence[Mapping[str, Any]]) -> Table:
    """Measurements, marked ones too."""
    table = Table("sample", "phase", "attempt", "step", "kind", "quality", "mark", box=None, pad_edge=False)
    for s in samples:
        mark = f"{s['mark']} by {s['mark_who']}: {s['mark_reason']}" if s["mark"] else ""
        quality = str(s["payload"].get("quality", ""))
        cells = (s["id"], s["phase"], s["attempt"], s["step"], s["kind"], quality, mark)
        table.add_row(*(escape(str(cell)) for cell in cells))
    return table


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Rows with the same keys, which become the headings."""
    table = Table(box=None, pad_edge=False)
    for column in rows[0] if rows else ():
        table.add_column(column.replace("_", " "), no_wrap=column in _WHOLE_COLUMNS)
    for row in rows:
        table.add_row(*("" if value is None else escape(str(value)) for value in row.values()))
    return table


def console() -> Console:
    """Standard output; plain text when it is no terminal, and then wide enough not to cut tables."""
    narrow = sys.stdout.isatty() or "COLUMNS" in os.environ
    return Console(highlight=False, soft_wrap=True, width=None if narrow else _WIDTH_OF_FILES)
