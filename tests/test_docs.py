"""What the documents say is there: links, commands, targets, scenarios with their exit codes."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperGroup

from controller.cellfile import load_cell
from controller.console.app import app
from controller.console.exit_codes import ExitCode, code_of_status
from controller.demo import SCENARIOS
from controller.demo_cell import copy_bench_block
from controller.robots import abilities_as_words, abilities_of

REPOSITORY = Path(__file__).parents[1]
README = REPOSITORY / "README.md"
BENCH_BLOCK = REPOSITORY / "cells" / "bench-block"
VARIANTS = sorted((BENCH_BLOCK / "variants").glob("*.toml"))
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "cells/*/*.md")
    for path in REPOSITORY.glob(pattern)
    if ".venv" not in path.parts
)
# what the README calls the end of a demo, as the daemon would say it
ENDINGS: dict[str, dict[str, Any]] = {
    "Completed": {"state": "Completed", "progress": {"outcome": "OK"}},
    "Held": {
        "state": "Held",
        "fault": {"code": "G"},
        "progress": {"activity": "gated", "outcome": "NotDecidable"},
    },
    "Suspended": {"state": "Suspended"},
}


def _name(path: Path) -> str:
    return str(path.relative_to(REPOSITORY))


def _code(path: Path) -> str:
    """Fenced blocks, with comments cut off, and code spans; the rest is prose."""
    text = path.read_text()
    fenced = re.findall(r"^```[^\n]*\n(.*?)^```", text, re.M | re.S)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    return "\n".join([*(re.sub(r"#.*", "", block) for block in fenced), *spans])


def _table(path: Path, first_heading: str) -> list[list[str]]:
    """Cells of the body of the table whose first column has this heading."""
    lines = iter(path.read_text().splitlines())
    for line in lines:
        if line.startswith(f"| {first_heading} |"):
            break
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows[1:]


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_every_relative_link_leads_somewhere(path: Path) -> None:
    targets = re.findall(r"\]\(([^)\s]+)\)", path.read_text())
    relative = [target.split("#")[0] for target in targets if "://" not in target]
    assert [target for target in relative if target and not (path.parent / target).exists()] == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_every_command_named_is_one(path: Path) -> None:
    command = typer.main.get_command(app)
    assert isinstance(command, TyperGroup)
    known = set(command.commands)
    named = set(re.findall(r"\btruecell ([a-z][a-z-]*)", _code(path)))
    assert named <= known
    if path == README:
        assert {"simulate", "serve", "start", "watch", "hold", "unhold", "results", "report"} <= named


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_every_make_target_and_file_named_exists(path: Path) -> None:
    code = _code(path)
    targets = set(re.findall(r"^([a-z]+):", (REPOSITORY / "Makefile").read_text(), re.M))
    assert set(re.findall(r"\bmake ([a-z]+)", code)) <= targets
    files = re.findall(r"\b((?:tests|docs|cells|controller|estimation|drivers|simulators)/[\w./-]+)", code)
    assert [file for file in files if not (REPOSITORY / file.rstrip("/.")).exists()] == []


def test_the_scenarios_of_the_readme_are_those_of_the_demo() -> None:
    rows = _table(README, "Scenario")
    assert tuple(row[0].strip("`") for row in rows) == SCENARIOS
    for _, _, state, _, code in rows:
        expected = ExitCode.BAD_INPUT if state == "refused" else code_of_status(ENDINGS[state])
        assert int(code) == expected


def test_the_scenarios_of_the_cell_are_those_of_its_world() -> None:
    world = tomllib.loads((BENCH_BLOCK / "world.toml").read_text())
    rows = _table(BENCH_BLOCK / "README.md", "Scenario")
    assert tuple(row[0].strip("`") for row in rows) == SCENARIOS
    assert set(SCENARIOS) == set(world["scenarios"])


def test_the_layout_in_the_readme_of_the_cell_is_that_of_its_cell_file() -> None:
    cell = tomllib.loads((BENCH_BLOCK / "cell.toml").read_text())
    rows = {row[0].strip("`"): row for row in _table(BENCH_BLOCK / "README.md", "Frame")}
    placed = {name: cell[name] for name in ("plate", "bar", "sphere", "part")}
    placed |= {name: cell[name]["mount"] for name in ("laser", "probe")}
    for name, nominal in placed.items():
        _, parent, origin, rotation, _ = rows[name]
        assert parent.strip("`") == nominal["parent"]
        assert [f"{value} mm" for value in origin.split(", ")] == nominal["xyz"]
        assert [f"{value} deg" for value in rotation.split(", ")] == nominal["rpy"]


def test_the_picture_is_there_and_small() -> None:
    assert 20_000 < (REPOSITORY / "docs" / "bench-block.png").stat().st_size < 300_000


def test_devices_page_states_what_each_robot_declares(tmp_path: Path) -> None:
    rows = _table(REPOSITORY / "docs" / "devices.md", "Robot")
    for driver, *cells in rows:
        name = driver.strip("`")
        folder = tmp_path / name
        folder.mkdir()
        robot = load_cell(copy_bench_block(folder, () if name == "canopen-402" else (name,))).robot
        able = abilities_as_words(abilities_of(robot))
        told = [str(able["stop"]), *(f"{able[key]:g}" for key in ("stop_delay_ms", "contact_delay_ms"))]
        told += [f"{able['joint_step_deg']:g}"]
        told += ["yes" if able[key] else "no" for key in ("linear_moves", "reports_pose")]
        assert cells == told, name
    assert len(rows) == 1 + sum("[robot]" in path.read_text() for path in VARIANTS)
