"""Data sets of a positioner: the example with its truth, problems that come back, and what is refused."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.console.exit_codes import ExitCode
from controller.offline.dataset import read_dataset
from estimation.model import values_of
from tests.controller.offline.answers import EXAMPLES, Run
from tests.estimation.tasks.positioner_cells import positioner_cell

GENERATOR = runpy.run_path(str(EXAMPLES / "make_positioner.py"))


@pytest.fixture
def content() -> dict[str, Any]:
    """The example, to be spoilt."""
    return json.loads((EXAMPLES / "positioner.json").read_text())


def test_the_example_holds_the_truth_of_its_generator(run: Run) -> None:
    assert (EXAMPLES / "positioner.json").read_text() == GENERATOR["text"](GENERATOR["dataset"]())
    code, out, _ = run(EXAMPLES / "positioner.json", "--json")
    answer = json.loads(out)
    assert (code, answer["task"], answer["status"]) == (ExitCode.OK, "positioner", "usable")
    assert answer["notes"] == []
    assert set(answer["parameters"]) == {"axis 1", "axis 2", "markers"}
    for name, (point, direction) in (("axis 1", GENERATOR["AXIS_1"]), ("axis 2", GENERATOR["AXIS_2"])):
        frame = np.array(answer["parameters"][name]["matrix_mm"])
        u = answer["standard_uncertainty"]
        off = np.cross(direction, point - frame[:3, 3])
        tilt = np.degrees(np.linalg.norm(np.cross(direction, frame[:3, 2])))
        assert np.linalg.norm(off) < 4 * np.hypot(u[f"{name}.tx"], u[f"{name}.ty"]) < 0.05
        assert tilt < 4 * np.hypot(u[f"{name}.rx"], u[f"{name}.ry"]) < 0.01
    assert set(answer["derived"]) == {"axes apart", "angle between axes", "zero of axis 1"}
    zero = answer["derived"]["zero of axis 1"]
    assert zero["unit"] == "deg"
    assert abs(zero["value"] + 0.4) < 4 * zero["standard_uncertainty"] < 0.01
    code, out, _ = run(EXAMPLES / "positioner.json")
    assert code == ExitCode.OK
    assert "axes apart" in out and "zero of axis 1" in out


def test_an_axis_that_stood_still_is_left_out_with_a_note(
    run: Run, content: dict[str, Any], tmp_path: Path
) -> None:
    rng, turns = np.random.default_rng(1), [turn for _, turn in content["motion"]["angles"]]
    content["motion"]["angles"] = [[0.0, turn] for turn in turns]
    points = [GENERATOR["turned"](GENERATOR["REFLECTORS_MM"], GENERATOR["AXIS_2"], turn) for turn in turns]
    content["points"] = (np.concatenate(points) + rng.normal(size=(45, 3)) * 0.01).tolist()
    (tmp_path / "still.json").write_text(json.dumps(content))
    code, out, _ = run(tmp_path / "still.json", "--json")
    answer = json.loads(out)
    assert (code, answer["status"]) == (ExitCode.OK, "usable")
    assert set(answer["parameters"]) == {"axis 2", "markers"}
    assert answer["notes"][0].startswith("Axis 1 stood still: where it is cannot be seen")


@pytest.mark.parametrize("kind", ["points", "sphere", "planes"])
def test_a_problem_comes_back_from_its_file(kind: str, tmp_path: Path) -> None:
    problem = positioner_cell(np.random.default_rng(2), kind, count=6, each=8, known=True).problem
    said: dict[str, Any] = {
        "truecell_dataset": 1,
        "task": problem.task,
        "units": {"length": "m", "angle": "rad"},
        "motion": {
            "kind": "positioner",
            "angles": problem.motion.angles_rad.tolist(),
            "noise": f"{problem.motion.std_rad} rad",
        },
        "points": problem.points_m.tolist(),
        "pose": problem.pose_index.tolist(),
        "noise": f"{np.sqrt(problem.covariance[0, 0])} m",
    }
    if kind == "points":
        said |= {"marker": problem.marker_index.tolist(), "markers": problem.markers_m.tolist()}
    else:
        said["ball_radius"] = f"{problem.ball_radius_m} m"
    if kind == "sphere":
        said["radius"] = f"{problem.radius_m} m"
    if kind == "planes":
        said["faces"] = [{"name": f.name, "point": f.point_m, "normal": f.axis} for f in problem.faces]
        said["face"] = [problem.faces[i].name for i in problem.face_index]
    (tmp_path / "set.json").write_text(json.dumps(said))
    again = read_dataset(tmp_path / "set.json").problem()  # type: ignore[attr-defined]
    assert type(again) is type(problem)
    values = values_of(problem.belief())
    one, other = problem.model().rows(values), again.model().rows(values)
    np.testing.assert_allclose(other.residual_m, one.residual_m, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(other.noise_variance, one.noise_variance, rtol=1e-9)


BAD: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "kind": (lambda c: c["motion"].update(kind="joints"), 'motion.kind = "joints": not allowed'),
    "three angles": (lambda c: c["motion"]["angles"][2].append(1.0), "motion.angles[3]"),
    "pose": (lambda c: c["pose"].__setitem__(4, 15), "there are 15 poses, counted from 0"),
    "marker": (lambda c: c["marker"].pop(), "44 values, write 45, one for each point"),
    "noise": (lambda c: c.pop("noise"), "noise: key is missing"),
    "up": (lambda c: c.update(up=[0, 0, 9.81]), "a direction of length 9.81"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_named_with_its_line(
    name: str, content: dict[str, Any], refused: Callable[[dict[str, Any]], str]
) -> None:
    spoil, sentence = BAD[name]
    spoil(content)
    assert sentence in refused(content)


def test_an_uncertainty_of_a_ball_that_is_not_there_is_refused(
    content: dict[str, Any], refused: Callable[[dict[str, Any]], str]
) -> None:
    """It would be left out of the budget without a word."""
    touched = {key: value for key, value in content.items() if key not in ("markers", "marker", "marker_u")}
    touched |= {"task": "positioner-sphere", "radius": "12.5 mm", "ball_radius_u": "0.05 mm"}
    assert 'ball_radius_u = "0.05 mm": there is no ball_radius, write ball_radius' in refused(touched)
