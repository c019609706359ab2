"""Random localizations on named features: where the object is, and what honest devices report of it.

The geometry here is of its own: corners, circles and matrices, nothing of the estimator under test.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from estimation.localization.task import Localization
from estimation.surfaces import Feature, cylinder, plane
from tests.estimation.tasks.cells import Cell
from tests.estimation.tasks.layout import MM, FloatArray, anywhere, block_faces

Rng = np.random.Generator
STD_M: Final = 0.03 * MM
_UP: Final = np.array([0.0, 0.0, 1.0])
# A block with one corner cut; and a plate with two sides, a bore and a ball.
BLOCK: Final = block_faces()
PLATE: Final = (
    plane("top", 50 * MM * _UP, _UP),
    plane("side", np.array([80 * MM, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])),
    plane("slope", np.array([0.0, 60 * MM, 20 * MM]), np.array([0.0, 0.8, 0.6])),
    cylinder("bore", np.array([20 * MM, 10 * MM, 0.0]), _UP, 15 * MM, False),
    Feature("ball", "sphere", (-50 * MM, 20 * MM, 60 * MM), radius_m=10 * MM),
)
_PART: Final = {"block": BLOCK, "plate": PLATE}


def located(rng: Rng) -> Cell:
    """Either part, all of its features measured; the plate in half of the draws without directions."""
    part = ("block", "plate")[rng.integers(2)]
    cell = measured(part, range(5), rng)
    if part == "plate" and rng.random() < 0.5:
        cell = Cell(replace(cell.problem, toward_sensor=None), cell.truth)
    return cell


def measured(part: str, used: Sequence[int], rng: Rng) -> Cell:
    """Points on some features of a part, none before the next, seen from outside the material."""
    index = rng.permutation(np.repeat(used, -(-rng.integers(36, 60) // len(used))))
    features = _PART[part]
    sides = [_on(features[k], rng) for k in index]
    return _reported(features, index, np.array([p for p, _ in sides]), np.array([n for _, n in sides]), rng)


def symmetric(rng: Rng) -> Any:
    """Faces along one line, or features about one axis or centre."""
    part, used = (
        ("block", (0, 1)),
        ("block", (0, 2, 4)),
        ("block", (1, 2, 4)),
        ("plate", (0, 3)),
        ("plate", (3,)),
        ("plate", (4,)),
        ("plate", (0, 4)),
    )[rng.integers(7)]
    return measured(part, used, rng).problem


def on_one_face(rng: Rng) -> Any:
    """One face, or two parallel ones."""
    return measured("block", ((0,), (1,), (2,), (3,), (2, 4))[rng.integers(5)], rng).problem


def on_a_line(rng: Rng) -> Any:
    """Along the edge of two faces, named in turn; or along a bore."""
    count, along = int(rng.integers(20, 50)), rng.uniform(-1.0, 1.0, 50)[:, None]
    if rng.random() < 0.5:
        edge_p, edge = np.array([50 * MM, 0.0, 100 * MM]), np.array([1.0, 0.0, 0.0])
        features, index = BLOCK, np.arange(count) % 2
        outward = np.array([BLOCK[k].axis for k in index])
    else:
        edge_p, edge = np.array([35 * MM, 10 * MM, 20 * MM]), _UP
        features, index = PLATE, np.full(count, 3)
        outward = np.tile([-1.0, 0.0, 0.0], (count, 1))
    return _reported(features, index, edge_p + 40 * MM * along[:count] * edge, outward, rng).problem


def exchanged(rng: Rng) -> Any:
    """Two names of features exchanged."""
    problem = located(rng).problem
    first, second = rng.choice(5, 2, replace=False)
    other = problem.index.copy()
    other[problem.index == first], other[problem.index == second] = second, first
    return replace(problem, index=other)


def off(rng: Rng, by: Callable[[Rng, int], FloatArray]) -> Any:
    """Points off along the normals of their surfaces, by shifts (n,), m."""
    problem = measured(("block", "plate")[rng.integers(2)], range(5), rng).problem
    shift_m = by(rng, len(problem.base_p))
    return replace(problem, base_p=problem.base_p + shift_m[:, None] * problem.toward_sensor)


def _on(feature: Feature, rng: Rng) -> tuple[FloatArray, FloatArray]:
    """A point of a feature, and the direction out of the material there."""
    point, axis = np.array(feature.point_m), np.array(feature.axis)
    away = rng.normal(size=3)
    if feature.kind == "sphere":
        away /= np.linalg.norm(away)
        return point + feature.radius_m * away, away
    away -= axis * (away @ axis)
    away /= np.linalg.norm(away)
    if feature.kind == "plane":
        return point + rng.uniform(0.0, 40 * MM) * away, axis
    return point + feature.radius_m * away + rng.uniform(0.0, 40 * MM) * axis, -away  # a bore


def _reported(
    features: tuple[Feature, ...], index: Any, object_p: FloatArray, outward: FloatArray, rng: Rng
) -> Cell:
    pose = anywhere(rng)
    base_p = object_p @ pose[:3, :3].T + pose[:3, 3]
    problem = Localization(
        base_p=base_p + rng.normal(size=base_p.shape) * STD_M,
        covariance=STD_M**2 * np.eye(3),
        surface=features,
        index=index,
        toward_sensor=outward @ pose[:3, :3].T,
    )
    return Cell(problem, {"object": pose})
