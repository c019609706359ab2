"""Coverage over random cells: they are drawn by a process of the simulators, and estimated here.

What this module reads of a drawn cell is what a real cell would have, its declared uncertainties and its
measurements. The truth is used only to judge the estimates.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from controller.verify.executor import Executor
from estimation.belief import Belief
from estimation.bump import FREEDOMS, bump_distance2
from estimation.errors import CellError, EstimationError
from estimation.kinematics import PARAMETER_NAMES, ArmModel
from estimation.measurement import Chain, Observations
from estimation.proof.coverage import Coverage, normalised_error_squared
from estimation.solver import update
from estimation.surfaces import Feature, bar_features, plane, plate_features
from estimation.transform import FloatArray, Transform, log_pose

DIMENSIONS: Final = {"hand-eye": 5, "bar check": 5, "localization": 6}
TASKS: Final = tuple(DIMENSIONS)
CHUNK: Final = 20  # cells of one work item: a few seconds


@dataclass(frozen=True, slots=True)
class Chunk:
    """Cells of consecutive seeds."""

    first: int
    count: int


def cover(
    executor: Executor, first: int, cells: int, progress: Callable[[int], None] | None = None
) -> dict[str, Coverage]:
    """Coverage of each task over cells of consecutive seeds; `progress` is told the cells so far.

    Raises CellError when the simulators cannot be run.
    """
    stop = first + cells
    chunks = [Chunk(start, min(CHUNK, stop - start)) for start in range(first, stop, CHUNK)]
    total = {task: Coverage(dimension, np.zeros(0)) for task, dimension in DIMENSIONS.items()}
    for found in executor.map(run_chunk, chunks):
        total = {task: total[task].merged(found[task]) for task in TASKS}
        if progress is not None:
            progress(total[TASKS[0]].cells)
    return total


def run_chunk(chunk: Chunk) -> dict[str, Coverage]:
    """Draw and estimate the cells of a chunk: coverage of each task.

    Raises CellError when the simulators cannot be run.
    """
    found: dict[str, list[float]] = {task: [] for task in TASKS}
    refused = dict.fromkeys(TASKS, 0)
    for cell in _drawn(chunk):
        for task, value in estimate_cell(cell).items():
            if value is None:
                refused[task] += 1
            else:
                found[task].append(value)
    return {task: Coverage(DIMENSIONS[task], np.array(found[task]), refused[task]) for task in TASKS}


def _drawn(chunk: Chunk) -> list[dict[str, Any]]:
    command = [sys.executable, "-m", "simulators.world.random_cells"]
    command += ["--first", str(chunk.first), "--count", str(chunk.count)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise CellError(f"The simulators could not draw cells: {last}", "Is truecell installed completely?")
    return [json.loads(line) for line in done.stdout.splitlines()]


def estimate_cell(cell: Mapping[str, Any]) -> dict[str, float | None]:
    """NEES of each task in one drawn cell, None where the estimator refused."""
    arm, truth = _arm(cell["declared"]), cell["truth"]
    found: dict[str, float | None] = dict.fromkeys(TASKS)
    try:
        plate = [_observations(cell, "plate")]
        calibrated = update(_with_plate(_first_belief(cell["declared"]), cell), Chain(arm, plate)).belief
    except EstimationError:
        return found
    laser = _beam_error(calibrated.transform("laser"), np.array(truth["laser"]))
    found["hand-eye"] = normalised_error_squared(laser, calibrated.block_covariance("laser"))
    try:
        again = [_observations(cell, "plate_again"), _observations(cell, "bar")]
        known, bump = _with_bar(calibrated, cell["declared"]), np.array(truth["bump"])
        found["bar check"] = bump_distance2(known, arm, again, bump)
    except EstimationError:
        pass
    try:
        part = [_observations(cell, "part")]
        localized = update(_with_part(calibrated, cell["declared"]), Chain(arm, part)).belief
        missed = log_pose(localized.transform("part").inverse().matrix @ np.array(truth["part"]))
        found["localization"] = normalised_error_squared(missed, localized.block_covariance("part"))
    except EstimationError:
        pass
    return found


def _beam_error(estimated: Transform, true: FloatArray) -> FloatArray:
    """(5,) from the estimated to the true mount; turning about the beam does not count."""
    between = estimated.inverse().matrix @ true
    beam = between[:3, 2]
    return np.concatenate([between[:3, 3], [np.arctan2(-beam[1], beam[2]), np.arctan2(beam[0], beam[2])]])


def _arm(declared: Mapping[str, Any]) -> ArmModel:
    theta, d, a, alpha, beta = np.array(declared["table"]).T
    free = [(int(label[-1]) - 1, label[:-1]) for label in declared["free"]]
    if unknown := {name for _, name in free} - set(PARAMETER_NAMES):
        raise CellError(f"Kinematic parameters {', '.join(sorted(unknown))}", "Draw the cells again")
    return ArmModel.from_dh(theta, d, a, alpha, beta, free=free)


def _first_belief(declared: Mapping[str, Any]) -> Belief:
    shift, turn = declared["laser_std"]
    mount = Transform("flange", "laser", np.array(declared["laser"]))
    return (
        Belief()
        .with_block(
            "kinematics",
            np.zeros(len(declared["free"])),
            std=declared["kinematics_std"],
            freedoms=declared["free"],
        )
        .with_block("laser", mount, std=[shift] * 3 + [turn] * 2, freedoms=FREEDOMS)
        .with_block("laser.scale", 0.0, std=declared["scale_std"])
        .with_block("laser.offset", 0.0, std=declared["offset_std"])
    )


def _with_plate(belief: Belief, cell: Mapping[str, Any]) -> Belief:
    shift, turn = cell["declared"]["plate_std"]
    place = Transform("base", "plate", np.array(cell["declared"]["plate"]))
    return belief.with_block("plate", place, std=[shift, turn, turn], freedoms=("tz", "rx", "ry"))


def _with_bar(belief: Belief, declared: Mapping[str, Any]) -> Belief:
    shift, turn = declared["bar_std"]
    place = Transform("base", "bar", np.array(declared["bar"]))
    return (
        belief.with_block("bar", place, std=[shift] * 3 + [turn] * 2, freedoms=FREEDOMS)
        .with_block("bar.length", declared["bar_length"], std=declared["bar_length_std"])
        .with_block("bar.radius", declared["bar_radius"], std=declared["bar_radius_std"])
    )


def _with_part(belief: Belief, declared: Mapping[str, Any]) -> Belief:
    shift, turn = declared["part_std"]
    place = Transform("base", "part", np.array(declared["part"]))
    belief = belief.with_block("part", place, std=[shift] * 3 + [turn] * 3)
    for name in declared["faces"]:
        belief = belief.with_block(
            f"part.{name}", 0.0, std=declared["form_std"], freedoms=("offset",), source="form"
        )
    return belief


def _observations(cell: Mapping[str, Any], name: str) -> Observations:
    """A batch as the engine would make it."""
    declared, measured = cell["declared"], cell[name]
    joints = np.array(measured["joints"])
    count = len(joints)
    return Observations(
        sensor="laser",
        object=name.removesuffix("_again"),
        joints_rad=joints,
        joint_variance=np.full(joints.shape, declared["joint_std"] ** 2),
        reading_m=np.array(measured["readings"]),
        reading_variance=np.full(count, declared["range_std"] ** 2),
        surface_variance=np.zeros(count),
        features=_features(declared, name),
        feature_index=np.array(measured.get("index", [0] * count), dtype=np.intp),
    )


def _features(declared: Mapping[str, Any], name: str) -> tuple[Feature, ...]:
    match name:
        case "bar":
            return bar_features()
        case "part":
            return tuple(
                plane(face, np.array(point), np.array(normal), f"part.{face}")
                for face, (point, normal) in declared["faces"].items()
            )
        case _:
            return plate_features()
