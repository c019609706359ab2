"""Replicas of the first cell's plan: the predicted uncertainty is the one that the estimator achieves."""

from pathlib import Path

import numpy as np
import pytest

from controller.verify.executor import open_executor
from controller.verify.replicas import prove

CELL = Path(__file__).parents[3] / "cells" / "bench-block"


def test_replicas_achieve_what_was_predicted() -> None:
    seen: list[int] = []
    with open_executor(workers=2) as executor:
        proofs = prove(CELL, executor, seed=3, most_replicas=400, progress=lambda done, _: seen.append(done))
    assert [proof.quantity.phase for proof in proofs] == ["hand-eye", "localize"]
    assert seen == [400]
    for proof in proofs:
        assert proof.coverage.verdict == "honest"
        assert proof.ratio == pytest.approx(1.0, abs=0.12)  # four standard deviations of 400 replicas
        assert proof.coverage.cells == 400
        assert np.isfinite(proof.validation.d_low)
