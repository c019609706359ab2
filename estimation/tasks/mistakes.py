"""Mistakes that people make with any measured data: another unit, two names exchanged."""

from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.tasks import checks
from estimation.tasks.findings import Cause, Finding

UNIT_FACTORS: Final = {  # numbers that are too large by so much, and what was taken for what
    1e-3: "m for mm",
    1e3: "mm for m",
    25.4: "mm for inches",
    1 / 25.4: "inches for mm",
    10.0: "mm for cm",
    0.1: "cm for mm",
}


def other_units(fit: str) -> list[tuple[Finding, float]]:
    """What to divide numbers by, and what is found if they fit then; `fit` says so: "The poses fit when"."""
    return [
        (Finding(Cause.WRONG_UNITS, f"{fit} divided by {factor:.4g}: {units}", checks.METRES), factor)
        for factor, units in UNIT_FACTORS.items()
    ]


def exchanged(index: NDArray[np.intp], names: Sequence[str]) -> list[tuple[Finding, NDArray[np.intp]]]:
    """Labels with two names exchanged, for all pairs that were used."""
    found = []
    for first, second in combinations(np.unique(index).tolist(), 2):
        other = index.copy()
        other[index == first], other[index == second] = second, first
        finding = Finding(
            Cause.WRONG_SURFACE,
            f"The readings fit when {names[first]} and {names[second]} are exchanged",
            "Check which reading is of which",
        )
        found.append((finding, other))
    return found
