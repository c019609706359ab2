"""Two robots that measure one object: cells of single robots, their bases moved so that the object is one."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from estimation.tasks.two_robots import TwoRobots
from estimation.transform import Transform
from tests.estimation.tasks.cells import (
    MM,
    Cell,
    FloatArray,
    anywhere,
    camera_hand_eye,
    point_laser_planes,
    touch_planes,
)
from tests.estimation.tasks.layout import DEG
from tests.estimation.tasks.pair_cells import pose_pairs
from tests.estimation.twin import pose

Make = Callable[[np.random.Generator], Cell]
MOUNT_STD = np.array([0.1, 0.1, 0.2, 0.02, 0.02, 0.03]) * np.repeat([MM, DEG], 3)


def placed(cell: Cell, base_T_object: FloatArray) -> Any:
    """The problem of a cell with its base where the object is at `base_T_object` in it."""
    holder = next(value for name, value in cell.truth.items() if name in ("object", "part"))
    motion = cell.problem.motion
    flange = base_T_object @ np.linalg.inv(holder) @ motion.base_T_flange
    return replace(cell.problem, motion=replace(motion, base_T_flange=flange))


def together(rng: np.random.Generator, first: Make, second: Make, far_m: float = 2.0) -> Cell:
    """Two robots, each with a sensor of its own at an unknown mount."""
    base1_T_base2, base1_T_object = anywhere(rng, far_m), anywhere(rng)
    cells = first(rng), second(rng)
    problem = TwoRobots(
        first=placed(cells[0], base1_T_object),
        second=placed(cells[1], np.linalg.inv(base1_T_base2) @ base1_T_object),
    )
    sensors = {
        f"{cell.problem.sensor}{i}": cell.truth[cell.problem.sensor] for i, cell in enumerate(cells, 1)
    }
    places = {
        problem.objects[0]: base1_T_object,
        problem.objects[1]: np.linalg.inv(base1_T_base2) @ base1_T_object,
    }
    return Cell(problem, {**sensors, **places})


def base2(cell: Cell) -> FloatArray:
    """base1_T_base2."""
    here, there = (cell.truth.get(name, np.eye(4)) for name in cell.problem.objects)
    return np.asarray(here @ np.linalg.inv(there))


def cameras(rng: np.random.Generator, count: int = 10) -> Cell:
    return together(rng, lambda r: camera_hand_eye(r, count), lambda r: camera_hand_eye(r, count))


def cameras_on_unknown_markers(rng: np.random.Generator) -> Cell:
    cell = cameras(rng)
    markers, place = cell.problem.first.markers_m, cell.truth.pop("object")
    cell.truth["object2"] = cell.truth["object2"] @ np.linalg.inv(place)
    halves = {name: replace(getattr(cell.problem, name), markers_m=None) for name in ("first", "second")}
    truth = (markers @ place[:3, :3].T + place[:3, 3]).reshape(-1)
    return Cell(replace(cell.problem, **halves), {**cell.truth, "markers": truth})


def laser_and_probe(rng: np.random.Generator) -> Cell:
    return together(rng, point_laser_planes, touch_planes)


def posed(rng: np.random.Generator) -> Cell:
    return together(rng, pose_pairs, pose_pairs)


def known_mounts(rng: np.random.Generator, count: int = 5) -> Cell:
    """Cameras whose mounts are known from earlier calibrations, with correlated errors."""
    cell = cameras(rng, count)
    mixed = np.eye(6) + 0.4 * np.eye(6)[::-1]
    covariance = np.diag(MOUNT_STD) @ mixed @ mixed.T @ np.diag(MOUNT_STD)
    halves = {}
    for number, name in enumerate(("first", "second"), 1):
        error = np.linalg.cholesky(covariance) @ rng.normal(size=6)
        mount = cell.truth[f"camera{number}"] @ np.linalg.inv(pose(error[None])[0])
        known = Transform("flange", "camera", mount)
        halves[name] = replace(getattr(cell.problem, name), mount=known, mount_covariance=covariance)
    return Cell(replace(cell.problem, **halves), cell.truth)


TWO_ROBOT_CELLS: dict[str, Make] = {
    "cameras": cameras,
    "cameras, markers unknown": cameras_on_unknown_markers,
    "laser and probe": laser_and_probe,
    "poses": posed,
    "known mounts": known_mounts,
}
