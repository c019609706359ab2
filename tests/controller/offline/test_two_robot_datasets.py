"""Data sets of two robots, and of mounts that are known from earlier calibrations."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.console.exit_codes import ExitCode
from controller.offline.dataset import read_dataset
from tests.controller.offline.answers import EXAMPLES, Run, inside

GENERATOR = runpy.run_path(str(EXAMPLES / "make_pairs.py"))
EXAMPLE = EXAMPLES / "two-robots.json"


def test_the_example_holds_the_truth_of_its_generator(run: Run) -> None:
    assert EXAMPLE.read_text() == GENERATOR["text"](GENERATOR["dataset"]("two-robots"))
    code, out, _ = run(EXAMPLE, "--json")
    answer = json.loads(out)
    assert (code, answer["task"], answer["status"]) == (ExitCode.OK, "two-robots", "usable")
    base = answer["parameters"]["base2"]
    assert (base["target"], base["source"]) == ("base1", "base2")
    truth = {
        "base2": GENERATOR["OTHER_BASE_MM"],
        "sensor1": GENERATOR["SENSOR_MM"]["pose-pairs"],
        "sensor2": GENERATOR["OTHER_SENSOR_MM"],
        "object": GENERATOR["OBJECT_MM"]["pose-pairs"],
    }
    assert set(answer["parameters"]) == set(truth)
    for name, matrix in truth.items():
        assert inside(answer, name, matrix)
        assert not inside(answer, name, matrix + np.outer([1, 0, 0, 0], [0, 0, 0, 2.0]))


def _unknown_task(said: dict[str, Any]) -> None:
    said["first"]["task"] = "point-laser-plane"


def _no_task(said: dict[str, Any]) -> None:
    del said["second"]["task"]


def _short(said: dict[str, Any]) -> None:
    said["second"]["seen"]["matrices"].pop()


def _unit(said: dict[str, Any]) -> None:
    said["first"]["units"]["length"] = "cm"


def _one_robot(said: dict[str, Any]) -> None:
    del said["second"]


BAD: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "task that leaves freedoms": (_unknown_task, 'first.task = "point-laser-plane": not allowed'),
    "no task": (_no_task, "second.task: key is missing"),
    "short": (_short, "14 values, write 15, one for each pose"),
    "unit": (_unit, 'first.units.length = "cm": not allowed'),
    "one robot": (_one_robot, "second: key is missing"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_named_with_its_robot(name: str, refused: Callable[[dict[str, Any]], str]) -> None:
    spoil, sentence = BAD[name]
    said = json.loads(EXAMPLE.read_text())
    spoil(said)
    problem = refused(said)
    assert sentence in problem
    assert problem.startswith("bad.json:")
    assert "\n" not in problem


def hand_eye() -> dict[str, Any]:
    return dict(json.loads((EXAMPLES / "hand-eye.json").read_text()))


def calibrated(run: Run) -> dict[str, Any]:
    """A prior as the JSON of an earlier calibration gives it: matrix and covariance as they stand there."""
    answer = json.loads(run(EXAMPLES / "hand-eye.json", "--json")[1])
    laser = answer["parameters"]["laser"]
    places = [i for i, name in enumerate(answer["parameter_names"]) if name.startswith("laser.")]
    covariance = np.array(answer["covariance"])[np.ix_(places, places)]
    return {
        "target": laser["target"],
        "source": laser["source"],
        "matrix": laser["matrix_mm"],
        "covariance": covariance.tolist(),
    }


def test_a_result_is_the_prior_of_the_next_estimate(run: Run, tmp_path: Path) -> None:
    said = hand_eye() | {"prior": calibrated(run)}
    (tmp_path / "again.json").write_text(json.dumps(said))
    problem = read_dataset(tmp_path / "again.json").problem()  # type: ignore[attr-defined]
    scale = np.array([1e-3] * 3 + [np.pi / 180] * 2)
    expected = np.array(said["prior"]["covariance"]) * np.outer(scale, scale)
    assert problem.belief().marginal(["laser"]).covariance == pytest.approx(expected)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"std": {"position": "1 mm", "rotation": "1 deg"}}, "prior: needs one of std and covariance"),
        ({"covariance": None}, "prior: needs one of std and covariance"),
        ({"covariance": (1e6 * np.eye(5)).tolist()}, "tx has a standard deviation of 1000, write mm and deg"),
        ({"covariance": [[1.0]]}, "prior.covariance = [[1.0]]: 1 rows of 1 numbers, write 5 x 5 numbers"),
    ],
)
def test_a_prior_says_once_how_well_the_mount_is_known(
    change: dict[str, Any], sentence: str, run: Run, refused: Callable[[dict[str, Any]], str]
) -> None:
    prior = calibrated(run) | change
    assert sentence in refused(hand_eye() | {"prior": {k: v for k, v in prior.items() if v is not None}})
