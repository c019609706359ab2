"""`truecell demo` as people call it: scenarios end as the README says, and no seed is released wrongly."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.processes import ROOT

pytestmark = [pytest.mark.wire, pytest.mark.campaign]

ENDINGS = {  # exit code, state, words of the last message
    "bumped-laser": (6, "Held", ("bump of the laser", "limit")),
    "noisy-joint": (6, "Held", ("noise of joint 4", "limit")),
    "cable-pulled": (0, "Completed", ("All phases ended",)),
    "part-missing": (8, "Suspended", ("No part",)),
}


def demo(folder: Path, scenario: str = "honest", seed: int = 1) -> tuple[int, dict[str, Any], str]:
    """Exit code, the answer if there is one, and what stands on standard error."""
    command = [sys.executable, "-m", "controller", "demo", "--json", "--folder", str(folder)]
    done = subprocess.run(
        [*command, "--scenario", scenario, "--seed", str(seed)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "Traceback" not in done.stdout + done.stderr
    return done.returncode, json.loads(done.stdout) if done.stdout else {}, done.stderr


@pytest.mark.parametrize("scenario", ENDINGS)
def test_a_scenario_ends_as_the_readme_says(scenario: str, tmp_path: Path) -> None:
    code, answer, _ = demo(tmp_path, scenario)
    expected, state, words = ENDINGS[scenario]
    assert (code, answer["status"]["state"]) == (expected, state)
    fault = answer["status"]["fault"]
    message = fault["text"] if fault else answer["status"]["message"]
    assert all(word in message for word in words), message
    assert not [row for row in answer["truth"] if row["wrongly_released"]]


def test_a_limit_that_cannot_be_met_opens_nothing(tmp_path: Path) -> None:
    code, _, complaint = demo(tmp_path, "tight-limit")
    assert code == 2
    assert "best reachable" in complaint and "limit 0.08 mm" in complaint


@pytest.mark.parametrize("seed", range(1, 11))
def test_what_is_released_over_real_wires_is_within_its_limits(seed: int, tmp_path: Path) -> None:
    """Prints what docs/evidence.md tells; whether the truth lies within U is printed, not asserted."""
    code, answer, _ = demo(tmp_path, seed=seed)
    rows = answer["truth"]
    print(
        f"seed {seed}: exit code {code}, {answer['status']['state']}; "
        f"{sum(row['verdict'] == 'OK' for row in rows)} of {len(rows)} quantities OK, "
        f"truth within U in {sum(row['inside'] for row in rows)}"
    )
    assert not [row for row in rows if row["wrongly_released"]]
