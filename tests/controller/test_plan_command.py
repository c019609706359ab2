"""`truecell plan`: what it writes, and what it refuses before anything moves."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import Cell, load_cell
from controller.console.app import main
from controller.console.exit_codes import ExitCode
from controller.console.plan_files import write_plan
from controller.dry_run import PlannedPhase, plan_job, rows_of
from controller.planning.feasibility import feasibility
from controller.robot_programs import program_of
from estimation.errors import CellFileError
from tests.controller.planning.random_cells import write_cell


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_cell(tmp_path_factory.mktemp("cell"), seed=1, limit_mm=0.2, quiet=False)


@pytest.fixture(scope="module")
def cell(folder: Path) -> Cell:
    return load_cell(folder)


@pytest.fixture(scope="module")
def phases(cell: Cell) -> tuple[PlannedPhase, ...]:
    return plan_job(cell)


def with_robot(folder: Path, tmp_path: Path, table: str) -> Cell:
    """The same cell with another robot."""
    text = (folder / "cell.toml").read_text(encoding="utf-8")
    keys = r"driver|port|interface|bitrate|nodes|sync_period|cruise_sync_period"
    head, robot, rest = re.split(
        r"(?<=\[robot\]\n)((?:.*\n)*?)(?=\n# Link i|\[\[robot.joints\]\])", text, maxsplit=1
    )
    robot = re.sub(rf"^({keys}) = .*\n", "", robot, flags=re.MULTILINE)
    (tmp_path / "part.stl").write_bytes((folder / "part.stl").read_bytes())
    (tmp_path / "cell.toml").write_text(head + table + robot + rest, encoding="utf-8")
    return load_cell(tmp_path)


def test_the_files_hold_the_plan(cell: Cell, phases: tuple[PlannedPhase, ...], tmp_path: Path) -> None:
    written = write_plan(tmp_path / "out", cell, phases)
    assert [path.name for path in written] == ["plan.json", "plan.html"]
    document = json.loads(written[0].read_text())
    assert document["cell_digest"] == cell.digest
    localize = document["phases"][1]
    takes = feasibility(cell)[-1].takes  # more than the 24 that are planned at first: they miss the limit
    assert 24 < takes <= 60
    assert len(localize["steps"]) == 10 + takes
    assert len(localize["curve_U_m"]) == 1 + 10 + takes
    assert localize["duration_s"] > 0.5 * len(localize["steps"])
    worst = max(point["U_m"] for point in localize["gated"])
    assert localize["best_reachable_U_m"] <= worst * 1.02
    page = written[1].read_text()
    assert "uncertainty against the number of measurements" in page
    assert not re.search(r'<(script|link)[^>]*(src|href)="http', page)  # opens without a network


def test_needed_measurements_are_where_the_curve_meets_the_limit(phases: tuple[PlannedPhase, ...]) -> None:
    for phase, row in zip(phases, rows_of(phases), strict=True):
        assert phase.limit_m is not None
        assert phase.needed == row["needs"]
        curve = np.array(phase.plan.curve_U_m)
        if phase.needed is not None:
            assert curve[phase.needed] <= phase.limit_m < curve[phase.needed - 1]


def test_one_phase_by_name_and_a_wrong_name(cell: Cell, phases: tuple[PlannedPhase, ...]) -> None:
    (only,) = plan_job(cell, "localize")
    assert only.to_dict() == phases[1].to_dict()  # and the same plan each time
    with pytest.raises(CellFileError, match=r"no phase 'lokalize'\. The nearest is 'localize'"):
        plan_job(cell, "lokalize")


def test_a_folder_that_cannot_be_written_is_named(
    cell: Cell, phases: tuple[PlannedPhase, ...], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CellFileError, match="cannot be written to"):
        write_plan(tmp_path / "file", cell, phases[:0])


ROBOTS = {
    "plan.script": 'driver = "ur"\nhost = "127.0.0.1"\n',
    "plan.prg": 'driver = "melfa-tcp"\nhost = "127.0.0.1"\nmax_speed = "200 deg/s"\n',
    "plan.mod": 'driver = "abb-open"\nhost = "127.0.0.1"\nreach = "0.8 m"\n',
}


@pytest.mark.parametrize("name", ROBOTS)
def test_programs_drive_through_every_posture(
    folder: Path, phases: tuple[PlannedPhase, ...], tmp_path: Path, name: str
) -> None:
    steps = phases[1].plan.steps
    program = program_of(with_robot(folder, tmp_path, ROBOTS[name]), steps)
    assert program is not None and program[0] == name
    number = r"-?\d+\.\d+"
    found = np.array(
        [
            [float(v) for v in row.split(",")]
            for row in re.findall(rf"((?:{number},\s?){{5}}{number})", program[1])
        ]
    )
    postures = [posture for step in steps for posture in (*step.via, step.joints_rad, *step.retreat)]
    expected = np.array(postures) if name == "plan.script" else np.degrees(postures)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert all(program[1].count(step.id) == 1 for step in steps)


def test_a_bus_arm_has_no_program(cell: Cell) -> None:
    assert program_of(cell, []) is None


def test_a_limit_beyond_reach_is_refused_with_figure_and_source(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "part.stl").write_bytes((folder / "part.stl").read_bytes())
    text = (folder / "cell.toml").read_text(encoding="utf-8")
    tight = text.replace('limit = "0.200000 mm"', 'limit = "0.02 mm"')
    assert tight != text
    (tmp_path / "cell.toml").write_text(tight, encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        main(["plan", str(tmp_path), "localize"])
    assert ended.value.code == ExitCode.BAD_INPUT
    said = capsys.readouterr().err
    assert re.search(r"best reachable 0\.\d\d mm, limit 0\.02 mm, .* dominated by .*% of the variance", said)
