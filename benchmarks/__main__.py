"""`make bench`: every task beside what people use today; writes docs/performance.md."""

import os
import time

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"  # before numpy loads: peers and ours in one thread
if hasattr(os, "sched_setaffinity"):  # Open3D asks nobody how many threads it may have
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

from pathlib import Path  # noqa: E402

try:
    from benchmarks import ellipsoids, fits, growth, localization, planning, replicas, single
except ImportError as error:
    raise SystemExit(
        f"A peer could not be loaded: {error}. Run `make bench`, which installs them; where a library of the "
        "system is missing, on Debian: apt install libusb-1.0-0 libgl1 libgomp1"
    ) from None
from benchmarks.harness import document, load  # noqa: E402

DOCS = Path(__file__).parents[1] / "docs"

if __name__ == "__main__":
    begun_s, begun_load = time.monotonic(), load()
    sections = [
        (part.TITLE, part.WORDS, part.rows())
        for part in (replicas, single, localization, fits, ellipsoids, planning)
    ]
    sections.append((growth.TITLE, growth.words(DOCS / "performance.png"), []))
    (DOCS / "performance.md").write_text(document(sections, begun_load, time.monotonic() - begun_s))
