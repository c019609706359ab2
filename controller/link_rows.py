"""What the links of a cell have seen, as rows of text: for the report of a run, and for the console."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from drivers.links.meter import LinkStatistics

NOTHING: Final = "–"
COLUMNS: Final = (
    "Device",
    "Frames",
    "Bad",
    "Timeouts",
    "Reconnects",
    "Late",
    "Median (ms)",
    "99 % (ms)",
    "Longest (ms)",
)


NOTE: Final = "Median, 99 % and longest: from a question to the first of its answer, as the driver waited."


def link_rows(counters: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """A row for each device, from `Devices.counters`; a second link of a device has a row of its own."""
    links = {name: _statistics(seen) for name, seen in (counters.get("links") or {}).items()}
    for role, health in (counters.get("devices") or {}).items():
        counts = (str(health[key]) for key in ("frames", "bad_frames", "timeouts", "reconnects"))
        yield (role, *counts, *_answers(links.pop(role, None)))
    for name, seen in links.items():
        yield (name, *(NOTHING,) * 4, *_answers(seen))


def _statistics(seen: Mapping[str, Any]) -> LinkStatistics:
    return LinkStatistics(**{**seen, "answers": tuple(seen["answers"])})


def _answers(seen: LinkStatistics | None) -> tuple[str, ...]:
    if seen is None or not any(seen.answers):
        return (NOTHING,) * 4
    within = (seen.answered_within_s(0.5), seen.answered_within_s(0.99))
    bounds = (NOTHING if bound_s is None else f"{bound_s * 1e3:.3g}" for bound_s in within)
    return (str(seen.late), *bounds, f"{seen.longest_answer_s * 1e3:.1f}")
