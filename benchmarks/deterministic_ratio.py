"""How much faster than real time the deterministic cell runs one whole job, and which part takes the time.

    python -m benchmarks.deterministic_ratio [seed]

The ratio is of a run by itself, after another one has loaded the compiled parts of the libraries. The shares
are of one more under the profiler, which makes many short calls look dearer than they are; libraries (numpy,
pymodbus, sqlite ...) and built-in functions are one line.
"""

import cProfile
import os
import pstats
import sys
import time
from collections import Counter
from pathlib import Path

from tests.support.deterministic import DeterministicCell

ROOT = Path(__file__).parents[1]
PARTS = (
    "drivers",
    "simulators",
    "estimation",
    "controller/planning",
    "controller/store",
    "controller",
    "tests",
)


def part_of(filename: str) -> str:
    """The part of this project that a function belongs to, or "libraries"."""
    path = Path(filename)
    if not path.is_relative_to(ROOT):
        return "libraries"
    inside = path.relative_to(ROOT).as_posix()
    return next((part for part in PARTS if inside.startswith(part + "/")), "libraries")


def shares(seed: int) -> Counter[str]:
    """Seconds of each part's own code, under the profiler."""
    cell, profile = DeterministicCell(seed), cProfile.Profile()
    profile.runcall(cell.run)
    cell.close()
    spent = Counter[str]()
    for (filename, _, _), (_, _, own_s, _, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        spent[part_of(filename)] += own_s
    return spent


def main() -> None:
    """Print the ratio and the shares."""
    os.chdir(ROOT)
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    first = DeterministicCell(seed + 1)
    first.run()
    first.close()
    cell = DeterministicCell(seed)
    cpu_s = time.process_time()
    state = cell.run()
    cpu_s, simulated_s = time.process_time() - cpu_s, cell.world.clock.now_s()
    cell.close()
    print(f"seed {seed}: {state.value}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"simulated {simulated_s:.1f} s, wall {cell.wall_s:.2f} s, CPU {cpu_s:.2f} s")
    print(f"simulated / wall {simulated_s / cell.wall_s:.0f}, simulated / CPU {simulated_s / cpu_s:.0f}")
    spent = shares(seed)
    for part, own_s in spent.most_common():
        print(f"{own_s / spent.total():6.1%}  {part}")


if __name__ == "__main__":
    main()
