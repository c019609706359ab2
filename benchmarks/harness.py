"""One row of the benchmark: ours and a peer in turns, on the same arrays, and how far they agree."""

import platform
import statistics
import time
import tracemalloc
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

_HEAD: Final = (
    "| task | peer | goal | times faster | peer (ms) | truecell (ms) | memory, peer / ours (MB) | "
    "off the tight solution (sigma) | cost over the peer's |\n" + "| --- " * 9 + "|\n"
)


@dataclass(frozen=True, slots=True)
class Row:
    """What one task gave. `goal` is the least ratio asked for; `error_sigma` and `cost_excess` are ours."""

    task: str
    peer: str
    goal: float | None
    peer_s: float
    ours_s: float
    peer_mb: float
    ours_mb: float
    error_sigma: float
    cost_excess: float

    def __str__(self) -> str:
        goal = "" if self.goal is None else f"{self.goal:g}"
        return (
            f"| {self.task} | {self.peer} | {goal} | {self.peer_s / self.ours_s:.1f} "
            f"| {self.peer_s * 1e3:.3g} | {self.ours_s * 1e3:.3g} "
            f"| {self.peer_mb:.1f} / {self.ours_mb:.1f} | {self.error_sigma:.1e} | {self.cost_excess:.1e} |"
        )


def medians(*calls: Callable[[], object], repeat: int = 7) -> list[float]:
    """Median seconds of each call; all are called in turns, so that a busy machine is busy for all."""
    for call in calls:
        call()  # compiled and in the caches
    taken: list[list[float]] = [[] for _ in calls]
    for _ in range(repeat):
        for call, times in zip(calls, taken, strict=True):
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
    return [statistics.median(times) for times in taken]


def peak_mb(call: Callable[[], object]) -> float:
    """Most memory that Python and numpy held beyond the start of the call."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def document(sections: Iterable[tuple[str, str, list[Row]]]) -> str:
    """docs/performance.md from (title, text, rows)."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba"))
    text = (
        "# Performance\n\n"
        "Written by `make bench`. Ours and the peer run in turns in one process and one thread on the same\n"
        f"arrays; medians. Python {platform.python_version()}, {packages}; {_processor()}. Absolute times\n"
        "depend on machine and load, the ratios much less. Compilation is not in the times.\n"
    )
    for title, words, rows in sections:
        text += f"\n## {title}\n\n{words}\n"
        if rows:
            text += "\n" + _HEAD + "\n".join(map(str, rows)) + "\n"
    return text


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()
