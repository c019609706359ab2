"""One row of the benchmark: ours and a peer in turns, on the same arrays, and how far they agree."""

import ctypes
import gc
import os
import platform
import statistics
import time
import tracemalloc
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

PACKAGES: Final = ("numpy", "scipy", "numba", "gtsam", "open3d", "small-gicp")
_HEAD: Final = (
    "| task | peer | goal | times faster | peer (ms) | truecell (ms) | memory, peer / ours (MB) | "
    "off the tight solution (sigma) | cost over the peer's | off the truth (sigma) |\n"
    + "| --- " * 10
    + "|\n"
)


@dataclass(frozen=True, slots=True)
class Row:
    """What one task gave.

    `goal` is the least ratio asked for. Of ours: `off_sigma`, the largest freedom against a solution to the
    last digit; `cost_excess`, relative; `truth_sigma`, the largest freedom against the truth.
    """

    task: str
    peer: str
    goal: float | None
    peer_s: float
    ours_s: float
    peer_mb: float
    ours_mb: float
    off_sigma: float | None = None
    cost_excess: float | None = None
    truth_sigma: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the goal is reached; None without one."""
        return None if self.goal is None else self.peer_s >= self.goal * self.ours_s

    def __str__(self) -> str:
        goal = "" if self.goal is None else f"{self.goal:g} {'' if self.met else '**missed**'}".strip()
        return (
            f"| {self.task} | {self.peer} | {goal} | {self.peer_s / self.ours_s:.2g} "
            f"| {self.peer_s * 1e3:.3g} | {self.ours_s * 1e3:.3g} | {self.peer_mb:.1f} / {self.ours_mb:.1f} "
            f"| {_small(self.off_sigma)} | {_small(self.cost_excess)} "
            f"| {'' if self.truth_sigma is None else f'{self.truth_sigma:.1f}'} |"
        )


def medians(*calls: Callable[[], object], repeat: int = 7) -> list[float]:
    """Median CPU seconds of each call, which all threads of the process spend; all are called in turns.

    On one idle core this is the time on the wall; what others do on the machine hardly enters.
    """
    for call in calls:
        call()  # compiled and in the caches
    taken: list[list[float]] = [[] for _ in calls]
    for _ in range(repeat):
        for call, times in zip(calls, taken, strict=True):
            start = time.process_time()
            call()
            times.append(time.process_time() - start)
    return [statistics.median(times) for times in taken]


def once(call: Callable[[], object]) -> float:
    """CPU seconds of one call of what is compiled by now."""
    start = time.process_time()
    call()
    return time.process_time() - start


def peak_mb(call: Callable[[], object]) -> float:
    """Most memory that the process held in a call beyond its start, whoever asked for it."""
    gc.collect()
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)  # what was freed before must not hide what is taken now
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:  # no such system, or no such right: what Python and numpy take
        tracemalloc.start()
        call()
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        return peak
    before = _status_kb("VmRSS")
    call()
    return (_status_kb("VmHWM") - before) * 1024 / 1e6


def document(sections: Iterable[tuple[str, str, list[Row]]], begun_load: str, seconds: float) -> str:
    """docs/performance.md from (title, text, rows)."""
    sections = list(sections)
    rows = [row for _, _, rows in sections for row in rows if row.goal is not None]
    missed = [row for row in rows if not row.met]
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    text = (
        "# Performance\n\n"
        "Written by `make bench`. Ours and the peer run in turns in one process on the same arrays; both\n"
        "are held to one core, and the times are medians of CPU time, which on an idle core is that on the\n"
        "wall. Absolute times depend on the machine, the ratios much less. Compilation is not in the times.\n"
        "Memory is the peak of the resident set beyond its size before the call.\n\n"
        f"Python {platform.python_version()}, {packages}; {_processor()}, {os.cpu_count()} cores,\n"
        f"shared with others: load {begun_load} at the begin, {load()} at the end of {seconds:.0f} s.\n\n"
    )
    text += f"{len(rows) - len(missed)} of {len(rows)} goals are met.\n"
    for row in missed:
        text += (
            f"- Missed: {row.task} against {row.peer}: {row.peer_s / row.ours_s:.2g}, goal {row.goal:g}.\n"
        )
    for title, words, rows in sections:
        text += f"\n## {title}\n\n{words}\n"
        if rows:
            text += "\n" + _HEAD + "\n".join(map(str, rows)) + "\n"
    return text


def load() -> str:
    """Mean number of processes that wanted to run, over a minute."""
    return f"{os.getloadavg()[0]:.1f}"


def _small(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"


def _status_kb(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1])
    raise OSError(f"no {name} in /proc/self/status")


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()
