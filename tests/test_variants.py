"""The first cell with each robot of the list: its `[robot]` table alone is another one."""

import shutil
from pathlib import Path

import pytest

from controller.packml import State
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


def composed(variant: str, folder: Path) -> Path:
    """The cell file with the robot of a variant; the joints stay, as they are of the same arm."""
    shutil.copytree(BENCH_BLOCK, folder, dirs_exist_ok=True)
    text = (BENCH_BLOCK / "cell.toml").read_text()
    start, end = text.index("[robot]"), text.index("# Link i:")
    path = folder / "cell.toml"
    path.write_text(text[:start] + (VARIANTS / f"{variant}.toml").read_text() + "\n" + text[end:])
    return path


def test_every_variant_has_a_verdict_in_the_readme() -> None:
    assert set(stated()) == {path.stem for path in VARIANTS.glob("*.toml")}


@pytest.mark.parametrize(
    "variant",
    [
        "igus-irc",
        *(
            pytest.param(name, marks=pytest.mark.campaign)  # some ten seconds each
            for name in ("abb-open", "melfa-serial", "melfa-tcp", "ur")
        ),
    ],
)
def test_the_cell_ends_as_the_readme_says(variant: str, tmp_path: Path) -> None:
    cell = DeterministicCell(seed=1, cell_path=composed(variant, tmp_path))
    try:
        state = cell.run()
        assert state is State.COMPLETED
        assert (state.value, cell.job.outcome().value) == stated()[variant]
        before = {name: result.verdict for name, result in cell.results().items() if name != "inspect"}
        assert set(before.values()) == {Outcome.OK.value}
    finally:
        cell.close()
