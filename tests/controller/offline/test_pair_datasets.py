"""Data sets of pairs: the examples with their truth, and what is refused."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.console.exit_codes import ExitCode
from tests.controller.offline.answers import EXAMPLES, Run, inside

GENERATOR = runpy.run_path(str(EXAMPLES / "make_pairs.py"))
TASKS = list(GENERATOR["SENSOR_MM"])


def content(task: str) -> dict[str, Any]:
    """The example of a task, to be spoilt."""
    return json.loads((EXAMPLES / f"{task}.json").read_text())


@pytest.mark.parametrize("task", TASKS)
def test_an_example_holds_the_truth_of_its_generator(task: str, run: Run) -> None:
    assert (EXAMPLES / f"{task}.json").read_text() == GENERATOR["text"](GENERATOR["dataset"](task))
    code, out, _ = run(EXAMPLES / f"{task}.json", "--json")
    answer = json.loads(out)
    assert (code, answer["task"], answer["status"]) == (ExitCode.OK, task, "usable")
    sensor = answer["parameters"]["sensor"]
    assert (sensor["target"], sensor["source"]) == ("base" if "beside" in task else "flange", "sensor")
    truth = {"sensor": GENERATOR["SENSOR_MM"][task]}
    if task != "move-pairs":
        truth["object"] = GENERATOR["OBJECT_MM"][task]
    assert set(answer["parameters"]) == set(truth)
    for name, matrix in truth.items():
        assert inside(answer, name, matrix)
        assert not inside(answer, name, matrix + np.outer([1, 0, 0, 0], [0, 0, 0, 0.5]))


def _few_moves(said: dict[str, Any]) -> None:
    del said["moves"]["matrices"][3]


def _high_index(said: dict[str, Any]) -> None:
    said["moves"]["second"][2] = 15


def _other_way(said: dict[str, Any]) -> None:
    said["seen"]["target"], said["seen"]["source"] = "object", "sensor"


def _no_noise(said: dict[str, Any]) -> None:
    del said["seen"]["noise"]


def _zero_noise(said: dict[str, Any]) -> None:
    said["seen"]["noise"]["rotation"] = "0 deg"


def _short(said: dict[str, Any]) -> None:
    said["seen"]["matrices"].pop()


def _left_handed(said: dict[str, Any]) -> None:
    said["seen"]["matrices"][4] = (np.array(said["seen"]["matrices"][4]) * [1, 1, -1, 1]).tolist()


BAD: dict[str, tuple[str, Callable[[dict[str, Any]], None], str]] = {
    "few moves": ("move-pairs", _few_moves, "moves.matrices"),
    "high index": ("move-pairs", _high_index, "there are 15 poses, counted from 0"),
    "the other way": ("pose-pairs", _other_way, 'seen.target = "object": not allowed, choose from "sensor"'),
    "no noise": ("pose-pairs", _no_noise, "seen.noise: key is missing"),
    "zero noise": ("pose-pairs", _zero_noise, 'seen.noise.rotation = "0 deg": out of bounds'),
    "short": ("pose-pairs-beside", _short, "14 values, write 15, one for each pose"),
    "left-handed": ("pose-pairs-beside", _left_handed, "the rotation is left-handed"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_named_with_its_line(name: str, refused: Callable[[dict[str, Any]], str]) -> None:
    task, spoil, sentence = BAD[name]
    said = content(task)
    spoil(said)
    problem = refused(said)
    assert sentence in problem
    assert problem.startswith("bad.json:")


def test_poses_the_wrong_way_round_are_refused_with_the_cause(run: Run, tmp_path: Path) -> None:
    said = content("pose-pairs")
    said["seen"]["matrices"] = np.linalg.inv(np.array(said["seen"]["matrices"])).tolist()
    (tmp_path / "set.json").write_text(json.dumps(said))
    code, out, _ = run(tmp_path / "set.json", "--json")
    assert code == ExitCode.NOT_DECIDABLE
    assert json.loads(out)["status"] == "refused"
    assert "fit when base_T_flange or sensor_T_object are inverted" in json.loads(out)["reason"]


@pytest.mark.parametrize(
    ("factor", "words"),
    [(25.4, "mm for inches"), (1e-3, "m for mm"), (10.0, "mm for cm"), (1e3, "millimetres")],
)
def test_a_wrong_unit_is_named_with_the_line_of_the_units(
    factor: float, words: str, run: Run, tmp_path: Path
) -> None:
    said = content("move-pairs")
    matrices = np.array(said["moves"]["matrices"])
    matrices[:, :3, 3] *= factor
    said["moves"]["matrices"] = matrices.tolist()
    (tmp_path / "set.json").write_text(json.dumps(said, indent=1))
    code, out, _ = run(tmp_path / "set.json")
    assert code == ExitCode.NOT_DECIDABLE
    assert words in out
    assert "The units stand in set.json:6." in out
