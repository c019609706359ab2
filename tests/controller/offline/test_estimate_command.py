"""`truecell estimate` as a user runs it: the example with its truth, a form for each task, and bad files."""

import json
import re
import runpy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.console.exit_codes import ExitCode
from controller.offline import dataset_parts, estimate_page
from controller.offline.dataset import DATASETS, read_dataset
from controller.offline.estimate_result import estimate
from controller.offline.refusal import BadFile
from estimation.tasks.registry import KINEMATIC_TASKS, POSITIONER_TASKS, TASKS
from estimation.tasks.solve import solve
from tests.controller.offline.answers import EXAMPLES, Run, inside
from tests.controller.offline.written import poses, written
from tests.estimation.tasks.cells import CELLS
from tests.estimation.tasks.pair_cells import PAIR_CELLS
from tests.estimation.tasks.two_robot_cells import TWO_ROBOT_CELLS

ALL_CELLS = {**CELLS, **PAIR_CELLS, **TWO_ROBOT_CELLS}
GENERATOR = runpy.run_path(str(EXAMPLES / "make_hand_eye.py"))


@pytest.fixture
def content() -> dict[str, Any]:
    """The example, to be spoilt."""
    return json.loads((EXAMPLES / "hand-eye.json").read_text())


def test_the_example_holds_the_truth_of_its_generator(run: Run) -> None:
    code, out, _ = run(EXAMPLES / "hand-eye.json", "--json")
    answer = json.loads(out)
    assert code == ExitCode.OK
    assert (answer["task"], answer["status"], answer["reason"]) == ("point-laser-plane", "usable", "")
    laser = answer["parameters"]["laser"]
    assert (laser["target"], laser["source"]) == ("flange", "laser")
    # The truth with the x axis that the rule gives: spin about the beam changes no reading.
    truth = GENERATOR["LASER_MM"].copy()
    truth[:3, :3] = _same_spin(truth[:3, :3], np.array(laser["matrix_mm"])[:3, :3])
    assert inside(answer, "laser", truth)
    truth[0, 3] += 3.0
    assert not inside(answer, "laser", truth)
    assert answer["dof"] == 40 - 8
    assert 0.02 < answer["rms_mm"] < 0.06
    budget = {
        name: sum(part[name] for part in answer["budget"].values()) for name in answer["parameter_names"]
    }
    assert list(budget.values()) == pytest.approx(np.diag(answer["covariance"]).tolist())


def _same_spin(rotation: np.ndarray, like: np.ndarray) -> np.ndarray:
    x, y = rotation[:, :2].T @ like[:, 0]
    return np.asarray(rotation @ Rotation.from_rotvec([0, 0, np.arctan2(y, x)]).as_matrix())


def test_the_example_is_what_its_generator_writes() -> None:
    assert (EXAMPLES / "hand-eye.json").read_text() == GENERATOR["text"](GENERATOR["dataset"]())


def test_a_table_for_people_names_value_uncertainty_unit_and_budget(run: Run) -> None:
    code, out, _ = run(EXAMPLES / "hand-eye.json")
    assert code == ExitCode.OK
    assert all(word in out for word in ("U (95 %)", "joint noise", "mm", "deg", "Status: usable"))


def test_the_report_is_one_page_with_table_residuals_and_budgets(run: Run, tmp_path: Path) -> None:
    code, _, _ = run(EXAMPLES / "hand-eye.json", "--report", tmp_path / "out.html")
    assert code == ExitCode.OK
    page = (tmp_path / "out.html").read_text()
    assert "point-laser-plane from hand-eye.json" in page
    assert "flange_T_laser origin" in page and "joint noise 49 %" in page
    assert page.count("<svg") == 1 + 4  # residuals, and the budget of origin and rotation of two poses
    linked = set(re.findall(r"https?://[^\s\"']+", page))
    assert linked <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}  # names, not links
    assert not re.search(r"<(script|link|iframe)|src=|@import", page)


def test_a_long_report_draws_the_largest_residuals_and_says_so(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate_page, "_MOST_ROWS", 20)
    run(EXAMPLES / "hand-eye.json", "--report", tmp_path / "out.html")
    assert re.search(
        r"(1[0-9]|20) of 40 rows are drawn, the largest among them", (tmp_path / "out.html").read_text()
    )


def test_a_refusal_has_its_page_too_and_names_are_no_markup(
    run: Run, content: dict[str, Any], tmp_path: Path
) -> None:
    content["motion"]["angles"], content["readings"] = (
        content["motion"]["angles"][:5],
        content["readings"][:5],
    )
    (tmp_path / "<b>few.json").write_text(json.dumps(content))
    code, _, _ = run(tmp_path / "<b>few.json", "--report", tmp_path / "out.html")
    assert code == ExitCode.NOT_DECIDABLE
    page = (tmp_path / "out.html").read_text()
    assert "5 measured numbers for 8 unknowns" in page
    assert "&lt;b&gt;few.json" in page and "<b>" not in page
    code, _, err = run(tmp_path / "<b>few.json", "--report", tmp_path / "no" / "out.html")
    assert code == ExitCode.BAD_INPUT and "--report: " in err


def test_json_has_the_names_that_scripts_rely_on(run: Run) -> None:
    answer = json.loads(run(EXAMPLES / "hand-eye.json", "--json")[1])
    assert answer.keys() >= {
        *("task", "status", "reason", "parameters", "parameter_names", "covariance", "covariance_units"),
        *("covariance_form", "covariance_order", "rms_mm", "dof", "diagnostics"),
    }
    for pose in answer["parameters"].values():
        assert pose.keys() == {"target", "source", "matrix_mm"}
        assert np.shape(pose["matrix_mm"]) == (4, 4)
    count = len(answer["parameter_names"])
    assert np.shape(answer["covariance"]) == (count, count)
    assert len(answer["covariance_units"]) == count
    assert set(answer["covariance_units"]) == {"mm", "deg"}


def test_readings_that_scatter_farther_than_stated_are_not_usable(
    run: Run, content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without the search for common mistakes, which takes long and has tests of its own.
    monkeypatch.setattr(dataset_parts, "solve", partial(solve, explain=False))
    content["readings"] = [r + 0.07 * (-1) ** i for i, r in enumerate(content["readings"])]
    (tmp_path / "noisy.json").write_text(json.dumps(content))
    code, out, _ = run(tmp_path / "noisy.json", "--json")
    assert code == ExitCode.NOT_DECIDABLE
    assert json.loads(out)["status"] == "not_usable"
    assert "larger than declared" in json.loads(out)["reason"]


def test_data_that_determine_nothing_are_refused_with_the_cause(
    run: Run, content: dict[str, Any], tmp_path: Path
) -> None:
    content["motion"]["angles"], content["readings"] = (
        content["motion"]["angles"][:5],
        content["readings"][:5],
    )
    (tmp_path / "few.json").write_text(json.dumps(content))
    code, out, _ = run(tmp_path / "few.json", "--json")
    assert code == ExitCode.NOT_DECIDABLE
    assert json.loads(out) == {
        "task": "point-laser-plane",
        "status": "refused",
        "reason": "5 measured numbers for 8 unknowns. Measure more.",
    }


def _set(*steps: Any) -> Callable[[dict[str, Any]], None]:
    def spoil(content: dict[str, Any]) -> None:
        here: Any = content
        for step in steps[:-2]:
            here = here[step]
        here[steps[-2]] = steps[-1]

    return spoil


def _skewed(content: dict[str, Any]) -> None:
    content["motion"] = poses()
    content["motion"]["matrices"][2] = [*(np.eye(4) + 0.01).tolist()[:3], [0, 0, 0, 1]]


def _without_source(content: dict[str, Any]) -> None:
    content["motion"] = poses()
    del content["motion"]["source"]


BAD: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "unit word": (
        _set("units", "length", "mn"),
        'units.length = "mn": not allowed, did you mean "m"? choose from "mm", "m", "inch"',
    ),
    "quantity": (
        _set("noise", "0.03 deg"),
        'noise = "0.03 deg": an angle, expected a length, write "0.03 mm"',
    ),
    "bare number": (_set("noise", 0.03), "noise = 0.03: unit missing"),
    "frame": (_without_source, "motion.source: key is missing, add it"),
    "rotation": (_skewed, "not a rotation: R^T R differs from the identity by 0.02"),
    "task": (_set("task", "point-laser-plan"), 'unknown task, did you mean "point-laser-plane"?'),
    "key": (_set("reading", [1.0]), 'unknown key, did you mean "readings"?'),
    "count": (_set("readings", [200.0] * 39), "39 values, write 40, one for each pose"),
    "word": (_set("readings", 3, "x"), 'readings[4] = "x"'),
    "row": (
        _set("motion", "angles", 5, [1.0, 2.0]),
        "motion.angles[6] = [1.0, 2.0]: 2 angles, the arm has 6 joints",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_one_sentence_with_line_and_key(
    name: str, content: dict[str, Any], refused: Callable[[dict[str, Any]], str]
) -> None:
    spoil, sentence = BAD[name]
    spoil(content)
    assert sentence in refused(content)


def test_the_line_is_that_of_the_mistake(content: dict[str, Any], tmp_path: Path) -> None:
    text = (EXAMPLES / "hand-eye.json").read_text().replace('"theta": "-90 deg"', '"theta": "-90 mm"', 1)
    (tmp_path / "bad.json").write_text(text)
    line = next(n for n, row in enumerate(text.splitlines(), 1) if "-90 mm" in row)
    with pytest.raises(BadFile, match=rf"bad\.json:{line}: motion\.arm\[2\]\.theta = "):
        read_dataset(tmp_path / "bad.json")


def test_the_line_of_a_number_that_is_none_is_told(tmp_path: Path) -> None:
    path = tmp_path / "data.json"
    path.write_text('{"about": "no NaN here",\n "readings": [1.5,\n NaN, 2.5]}')
    with pytest.raises(BadFile, match=r"data\.json:3: NaN is not a finite number"):
        read_dataset(path)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"task": NaN}', '{"task": "a", "task": "b"}'])
def test_a_file_that_is_no_data_set_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(BadFile, match=r"bad\.json"):
        read_dataset(tmp_path / "bad.json")


def _table(content: dict[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """The example as CSV, and what is left of it."""
    rows = zip(content["readings"], content["motion"].pop("angles"), strict=True)
    lines = ["range [mm];" + ";".join(f"j{i + 1} [deg]" for i in range(6))]
    lines += [";".join(map(str, [reading, *joints])) for reading, joints in rows]
    del content["readings"]
    return lines, content


def test_joints_and_ranges_of_a_csv_give_the_same_result(
    run: Run, content: dict[str, Any], tmp_path: Path
) -> None:
    lines, rest = _table(content)
    (tmp_path / "rest.json").write_text(json.dumps(rest))
    (tmp_path / "table.csv").write_text("\n".join(["# of the cell", *lines]))
    code, out, _ = run(tmp_path / "rest.json", "--csv", tmp_path / "table.csv", "--json")
    assert code == ExitCode.OK
    assert out == run(EXAMPLES / "hand-eye.json", "--json")[1]


@pytest.mark.parametrize(
    ("line", "bad", "sentence"),
    [
        (0, "range;j1;j2", "does not say name and unit"),
        (0, "range [deg];" + ";".join(f"j{i + 1} [deg]" for i in range(6)), "is in 'deg'"),
        (0, "range [m];" + ";".join(f"j{i + 1} [deg]" for i in range(6)), "in the table it is"),
        (3, "1;2;3", "table.csv:4: 3 columns, the header has 7"),
        (3, "1;2;3;4;5;6;7,5", "table.csv:4: '7,5' in column j6 is not a number. Write decimal points"),
        (3, "1;2;3;4;5;6;nan", "table.csv:4: 'nan' in column j6 is not finite"),
    ],
)
def test_a_bad_csv_is_refused(
    run: Run, content: dict[str, Any], tmp_path: Path, line: int, bad: str, sentence: str
) -> None:
    lines, rest = _table(content)
    lines[line] = bad
    (tmp_path / "rest.json").write_text(json.dumps(rest))
    (tmp_path / "table.csv").write_text("\n".join(lines))
    code, _, err = run(tmp_path / "rest.json", "--csv", tmp_path / "table.csv")
    assert code == ExitCode.BAD_INPUT
    assert sentence in err


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "table.csv: no measurements"),
        ("# nothing\n\n", "table.csv: no measurements"),
        ("j1 [deg];range [mm]\n", "table.csv: no measurements"),
        ("j1 [deg];range [mm]\n1;2\n3,4\n", "table.csv:3: 1 columns, the header has 2"),
        ("j1 [deg],range [mm]\n1,5,2,5\n", "table.csv:2: 4 columns, the header has 2; decimal commas need"),
        ("j1 [deg],range [mm]\n1,2\n3,inf\n", "table.csv:3: 'inf' in column range is not finite"),
        ("j1 [deg],range [mm]\n1,2\n\n# x\n3,\n", "table.csv:5: '' in column range is not a number"),
    ],
)
def test_a_csv_without_numbers_is_refused(
    run: Run, content: dict[str, Any], tmp_path: Path, text: str, sentence: str
) -> None:
    (tmp_path / "rest.json").write_text(json.dumps(_table(content)[1]))
    (tmp_path / "table.csv").write_text(text)
    code, out, err = run(tmp_path / "rest.json", "--csv", tmp_path / "table.csv")
    assert (code, out) == (ExitCode.BAD_INPUT, "")
    assert sentence in err
    assert err.count("\n") == 1


def test_every_task_has_its_form_and_schema(run: Run) -> None:
    assert set(DATASETS) == {*TASKS, *KINEMATIC_TASKS, "localization"}
    made = {ALL_CELLS[name](np.random.default_rng(1)).problem.task for name in ALL_CELLS}
    assert made | set(POSITIONER_TASKS) == set(TASKS)
    for task in DATASETS:
        code, out, _ = run("--schema", task)
        assert code == ExitCode.OK
        assert "task" in json.loads(out)["required"]


@pytest.mark.parametrize("name", ALL_CELLS)
def test_a_problem_comes_back_from_its_file(name: str, tmp_path: Path) -> None:
    problem = ALL_CELLS[name](np.random.default_rng(5)).problem
    (tmp_path / "set.json").write_text(json.dumps(written(problem)))
    again = read_dataset(tmp_path / "set.json").problem()
    assert type(again) is type(problem)
    values = {block.name: block.value for block in problem.belief().blocks}
    one, other = problem.model().rows(values), again.model().rows(values)
    np.testing.assert_allclose(other.residual_m, one.residual_m, rtol=1e-9, atol=1e-12)
    for source, variance in one.noise.items():
        np.testing.assert_allclose(other.noise[source], variance, rtol=1e-9, atol=1e-18)


def test_a_localization_finds_the_part_with_the_error_of_the_mount_in_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    places = {
        "top": ([50, 75, 100], [0, 0, 1]),
        "front": ([50, 0, 50], [0, -1, 0]),
        "right": ([100, 75, 50], [1, 0, 0]),
    }
    truth = np.eye(4)
    truth[:3, :3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    truth[:3, 3] = [400.0, -50.0, 100.0]
    points, feature, toward = [], [], []
    for name, (at, normal) in places.items():
        inside_face = rng.uniform(-40, 40, (8, 3)) * (1 - np.abs(normal))
        points += list(
            (np.array(at) + inside_face) @ truth[:3, :3].T + truth[:3, 3] + rng.normal(size=(8, 3)) * 0.02
        )
        feature += [name] * 8
        toward += [truth[:3, :3] @ normal] * 8
    content = {
        "truecell_dataset": 1,
        "task": "localization",
        "units": {"length": "mm", "angle": "deg"},
        "frame": "base",
        "points": np.array(points).tolist(),
        "noise": "0.02 mm",
        "features": [{"name": n, "kind": "plane", "point": p, "axis": a} for n, (p, a) in places.items()],
        "feature": feature,
        "toward_sensor": np.array(toward).tolist(),
        "hand_eye": {
            "std": {"position": "0.1 mm", "rotation": "0 deg"},
            "target": "base",
            "source": "sensor",
            "matrices": [np.eye(4).tolist()] * 24,
        },
    }
    (tmp_path / "part.json").write_text(json.dumps(content))
    found = estimate(read_dataset(tmp_path / "part.json"))
    assert found.status == "usable"
    assert found.parameters is not None
    # All points share the error of the mount, so the position cannot be known better than that.
    assert np.all(found.parameters.std("object")[:3] > 0.09e-3)
    gap = 1e3 * found.parameters.transform("object").origin_m - truth[:3, 3]
    assert np.abs(gap).max() < 0.1


def test_every_example_in_the_docs_keeps_the_form(tmp_path: Path) -> None:
    blocks = re.findall(r"```json\n(.*?)```", (EXAMPLES.parent / "datasets.md").read_text(), re.DOTALL)
    assert len(blocks) == 6
    for block in blocks:
        (tmp_path / "example.json").write_text(block)
        read_dataset(tmp_path / "example.json").problem()
