"""The first cell with each robot, laser and probe of the list: one table of its file is another one."""

import re
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import pytest

from controller.demo_cell import copy_bench_block, variants, with_device
from controller.truth_table import compare
from estimation.errors import CellFileError
from estimation.statistics import Outcome
from tests.support.deterministic import BENCH_BLOCK, DeterministicCell

VARIANTS = BENCH_BLOCK / "variants"
TABLE_HEAD = "| Variant | Ends in | Job |"


def stated() -> dict[str, tuple[str, str]]:
    """Variant: state and verdict of the job, as the README says beforehand."""
    lines = (VARIANTS / "README.md").read_text().splitlines()
    rows = lines[next(i for i, line in enumerate(lines) if line.startswith(TABLE_HEAD)) + 2 :]
    table = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows if row.startswith("|")]
    return {row[0].strip("`"): (row[1], row[2]) for row in table}


def variant_cell(seed: int, folder: Path, others: Sequence[str]) -> DeterministicCell:
    """The same cell each time: a copy gets free TCP ports, and the plan follows from the whole file."""
    path, numbers = copy_bench_block(folder, others), count(5001)
    path.write_text(re.sub(r"port = \d+", lambda _: f"port = {next(numbers)}", path.read_text()))
    return DeterministicCell(seed=seed, cell_path=path)


def test_every_variant_has_a_verdict_in_the_readme() -> None:
    assert set(stated()) == set(variants())


@pytest.mark.parametrize(
    "others",
    [
        ("igus-irc",),
        ("riftek-binary", "wago-750-337"),
        *(pytest.param((name,), marks=pytest.mark.campaign) for name in variants()),  # some ten seconds each
    ],
    ids="+".join,
)
def test_the_cell_ends_as_the_readme_says(others: tuple[str, ...], tmp_path: Path) -> None:
    cell = variant_cell(1, tmp_path, others)
    try:
        drivers = {cell.cell.robot.driver, cell.cell.laser.driver, cell.cell.probe.driver}
        assert drivers >= set(others)
        state = cell.run()
        print(others, state.value, {phase: result.verdict for phase, result in cell.results().items()})
        (expected,) = {stated()[name] for name in others}
        assert (state.value, cell.job.outcome().value) == expected
        before = {name: result.verdict for name, result in cell.results().items() if name != "inspect"}
        assert set(before.values()) == {Outcome.OK.value}
    finally:
        cell.close()


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("other", variants())
def test_whatever_the_device_nothing_is_released_wrongly(other: str, seed: int, tmp_path: Path) -> None:
    """Five cells a variant: what is stated is compared with the truth, whatever the verdict."""
    cell = variant_cell(seed, tmp_path, (other,))
    try:
        state = cell.run()
        verdict = cell.job.outcome().value
        rows = compare(cell.cell, list(cell.results().values()), cell.truth.to_json()).rows
        inside = sum(row.inside for row in rows)
        why = "" if state.value == "Completed" else cell.engine.status()["message"]
        print(f"| {other} | {seed} | {state.value} | {verdict} | {inside} of {len(rows)} | {why} |")
        assert state.value == "Completed", why
        assert not [row for row in rows if row.wrongly_released]
        if stated()[other][1] != Outcome.OK.value:
            assert verdict != Outcome.OK.value
    finally:
        cell.close()


def test_a_device_that_is_no_variant_is_refused_with_those_that_are() -> None:
    with pytest.raises(CellFileError, match=r"No device 'kuka' for the demo. Choose one of abb-open, "):
        with_device((BENCH_BLOCK / "cell.toml").read_text(), "kuka")
