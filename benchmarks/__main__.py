"""`make bench`: every task beside what people use today; writes docs/performance.md."""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # before numpy loads: peers and ours in one thread

from pathlib import Path  # noqa: E402

from benchmarks import fits, replicas  # noqa: E402
from benchmarks.harness import document  # noqa: E402

DOCS = Path(__file__).parents[1] / "docs"

if __name__ == "__main__":
    words = (
        "Ours finds its start alone and its result has covariance and checks; scipy starts a hundredth off."
    )
    loops = "The peers' loops run over 100 of the replicas; their times are scaled. Ours solves all of them."
    sections = [
        ("Monte Carlo of a hand-eye", loops, replicas.rows()),
        ("Surfaces through points", words, fits.rows()),
        ("Growth", fits.growth(DOCS / "performance.png"), []),
    ]
    (DOCS / "performance.md").write_text(document(sections))
