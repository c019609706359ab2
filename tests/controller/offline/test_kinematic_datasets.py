"""Data sets that calibrate an arm: the example with its truth, the rest of the form, and what is refused."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from controller.console.exit_codes import ExitCode
from controller.offline.dataset import read_dataset
from estimation.tasks.kinematics import KinematicTask
from estimation.tasks.motion import Joints
from tests.controller.offline.answers import EXAMPLES, Run, inside

GENERATOR = runpy.run_path(str(EXAMPLES / "make_kinematics.py"))


@pytest.fixture
def content() -> dict[str, Any]:
    """The example, to be spoilt."""
    return json.loads((EXAMPLES / "kinematics-tracker.json").read_text())


def test_the_example_is_what_its_generator_writes() -> None:
    written = (EXAMPLES / "kinematics-tracker.json").read_text()
    assert written == GENERATOR["text"](GENERATOR["dataset"]())


def test_the_example_holds_the_truth_of_its_generator(run: Run) -> None:
    code, out, _ = run(EXAMPLES / "kinematics-tracker.json", "--json")
    answer = json.loads(out)
    assert (code, answer["task"], answer["status"]) == (ExitCode.OK, "kinematics-tracker", "usable")
    truth = GENERATOR["ERRORS"]
    labels = [name for name in answer["parameter_names"] if name.startswith("kinematics.")]
    assert labels == [f"kinematics.{name}" for name in truth]
    error = np.array(answer["parameters"]["kinematics"]["values"]) - list(truth.values())
    places = [answer["parameter_names"].index(label) for label in labels]
    covariance = np.array(answer["covariance"])[np.ix_(places, places)]
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, len(error))
    assert inside(answer, "tracker", GENERATOR["TRACKER_MM"])
    # The links that come out are those of the arm, ready to be pasted.
    assert float(answer["arm"][3]["d"].removesuffix(" mm")) == pytest.approx(420.51, abs=0.03)
    assert float(answer["arm"][0]["d"].removesuffix(" mm")) == 400.0
    held = [note for note in answer["notes"] if note.endswith("held at its nominal value.")]
    assert len(held) == 7
    assert "d2 of kinematics cannot be told apart from d3 of kinematics: held at its nominal value." in held


def test_priors_choice_and_gravity_reach_the_problem(content: dict[str, Any], tmp_path: Path) -> None:
    content["motion"]["arm"][1]["a_u"] = "0.1 mm"
    content["identify"] = ["theta2", "theta3"]
    content["gravity"] = {"payload": "6 kg", "payload_at": [0, 0, 120], "up": [0, 0, 1]}
    (tmp_path / "set.json").write_text(json.dumps(content))
    problem = read_dataset(tmp_path / "set.json").problem()  # type: ignore[attr-defined]
    assert isinstance(problem, KinematicTask)
    assert problem.motion.arm.parameter_labels == ("theta2", "a2", "theta3")
    assert np.asarray(problem.motion.kinematics_std) == pytest.approx([np.inf, 1e-4, np.inf])
    assert isinstance(problem.measured.motion, Joints) and problem.measured.motion.load is not None
    assert problem.motion.soft_joints.tolist() == [1, 2, 3, 4]  # not upright, not through the payload


def _poses(content: dict[str, Any]) -> None:
    eye, noise = np.eye(4).tolist(), {"position": "0.02 mm", "rotation": "0.002 deg"}
    content["motion"] = {"kind": "poses", "target": "base", "source": "flange", "noise": noise}
    content["motion"]["matrices"] = [eye] * 50


BAD: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "poses": (_poses, 'motion.kind = "poses": poses say nothing of single joints, write "joints"'),
    "parameter": (
        lambda c: c.update(identify=["thet2"]),
        "not a parameter of the arm, did you mean",
    ),
    "seventh": (lambda c: c.update(identify=["d7"]), 'identify[1] = "d7": not a parameter of the arm'),
    "mass": (
        lambda c: c.update(gravity={"payload": 6.0}),
        'unit missing, write "6.0 kg"',
    ),
    "links": (
        lambda c: c.update(gravity={"payload": "1 kg", "links": [{"mass": "1 kg", "at": [0, 0, 0]}]}),
        "1 values, write 6, one for each joint",
    ),
    "up": (lambda c: c.update(gravity={"payload": "1 kg", "up": [0, 0, 2]}), "a direction of length 2"),
    "offset": (lambda c: c.update(shared_errors={"offset": "1 um"}), "a tracker has no offset along its z"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_named_with_its_line(
    name: str, content: dict[str, Any], refused: Callable[[dict[str, Any]], str]
) -> None:
    spoil, sentence = BAD[name]
    spoil(content)
    assert sentence in refused(content)
