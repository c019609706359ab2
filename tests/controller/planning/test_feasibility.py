"""Limits that no measurement can meet are refused before anything moves."""

from pathlib import Path

import pytest

from controller.cellfile import Cell, check_cell, load_cell
from controller.faults import GateHeld
from controller.planning.feasibility import Reachable, feasibility, limit_mistakes, refuse_impossible_limits
from controller.planning.plan import GatedPrediction
from tests.controller.planning.planned import CELL


@pytest.fixture(scope="module")
def tight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example cell with a limit of 0.08 mm on the part."""
    folder = tmp_path_factory.mktemp("tight")
    text = (CELL / "cell.toml").read_text(encoding="utf-8")
    head, faces, rest = text.partition("faces = [")
    assert rest.count('limit = "0.40 mm"') == 1
    (folder / "cell.toml").write_text(head + faces + rest.replace('"0.40 mm"', '"0.08 mm"'), encoding="utf-8")
    (folder / "block.step").write_bytes((CELL / "block.step").read_bytes())
    return folder


def test_the_example_can_meet_its_limits(cell: Cell) -> None:
    assert [reachable.phase for reachable in feasibility(cell)] == ["hand-eye", "localize"]
    assert all(reachable.met for reachable in feasibility(cell))
    assert limit_mistakes(cell) == []
    refuse_impossible_limits(cell)


def test_a_limit_out_of_reach_is_refused_with_the_best_and_its_source(tight: Path) -> None:
    with pytest.raises(GateHeld) as held:
        refuse_impossible_limits(load_cell(tight))
    assert held.value.phase == "localize"
    assert "best reachable 0.19 mm, limit 0.08 mm" in held.value.problem
    assert "dominated by kinematics" in held.value.problem
    assert "calibrate the arm's kinematics" in held.value.remedy


@pytest.mark.parametrize(
    ("source", "cure"),
    [
        ("kinematics", "calibrate the arm's kinematics and declare the smaller uncertainties"),
        ("laser scale", "have the laser's scale certified more closely"),
        ("hand-eye range noise", "allow more measurements, or use a laser with less noise"),
        ("plate place", "reduce plate place"),
    ],
)
def test_the_remedy_is_for_the_source_that_dominates(source: str, cure: str) -> None:
    best = GatedPrediction("corner", 2e-4, {source: 0.5, "part form": 0.3, "part place": 0.2})
    reachable = Reachable("localize", 3, best, 1e-4, 60, 30)
    assert reachable.problem.endswith(f"dominated by {source}, 50% of the variance")
    assert reachable.remedy == f"raise the limit to 0.21 mm, or {cure}"


def test_the_mistake_names_the_line_of_the_limit(tight: Path) -> None:
    mistakes = check_cell(tight, feasibility=limit_mistakes)
    assert len(mistakes) == 1
    lines = (tight / "cell.toml").read_text(encoding="utf-8").splitlines()
    assert lines[mistakes[0].line - 1] == 'limit = "0.08 mm"'
    assert "best reachable" in mistakes[0].problem
