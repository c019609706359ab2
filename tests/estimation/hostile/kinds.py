"""Twenty kinds of data that support no estimate, or not the one that they are given for.

Where the geometry is at fault, the cell is laid out so and the devices report honestly; where a number is,
a sound cell is spoilt as people and devices spoil it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.tasks.findings import Cause
from estimation.tasks.laser import (
    PointLaserOnPlane,
    PointLaserOnSphere,
    ProfileLaserOnPlane,
    ProfileLaserOnSphere,
)
from tests.estimation.hostile import edits, places
from tests.estimation.tasks.cells import CELLS
from tests.estimation.tasks.layout import DEG, MM, FloatArray, Setting
from tests.estimation.tasks.pair_cells import PAIR_CELLS

Rng = np.random.Generator
ALL = {**CELLS, **PAIR_CELLS}
SENSORS, PAIRS = tuple(CELLS), tuple(PAIR_CELLS)
# With a sensor on the arm that sees from a distance, so that the flange can be drawn back into a plane.
CARRIED = tuple(
    name for name in CELLS if not name.startswith("touch") and name not in ("camera-eye-to-hand", "tracker")
)
FACES = ("point-laser-planes", "touch-planes")
# Tasks whose poses come from joints in the cell with an arm.
ARMED = (
    "point-laser-plane",
    "point-laser-sphere",
    "profile-laser-plane",
    "profile-laser-sphere",
    "camera-hand-eye",
    "pose-pairs",
)


@dataclass(frozen=True)
class Kind:
    """One kind: the tasks in which it can happen, and what it makes of a seed."""

    cause: Cause
    tasks: tuple[str, ...]
    draw: Callable[[str, Rng], Any]  # name of the task -> problem


def _laid_out(task: str, rng: Rng, *, of: Callable[[Rng], Setting]) -> Any:
    return ALL[task](rng, setting=of(rng)).problem


def _spoilt(task: str, rng: Rng, *, how: Callable[[Any, Rng], Any], **setting: Any) -> Any:
    count = {"count": 60} if setting.get("arm") else {}
    return how(ALL[task](rng, setting=Setting(**setting), **count).problem, rng)


def _shifted(task: str, rng: Rng, *, by: Callable[[Rng, int], FloatArray]) -> Any:
    cell = ALL[task](rng)
    return edits.shifted(cell, by(rng, edits.count(cell.problem)), edits.direction(rng))


# Orientations of the sensor, as seen from the object.


def _about(rng: Rng, first: FloatArray, turn: FloatArray) -> FloatArray:
    return np.asarray(first @ Rotation.from_rotvec(turn).as_matrix())


def one_axis(rng: Rng, first: FloatArray, count: int) -> FloatArray:
    axis = rng.normal(size=3)
    return _about(rng, first, np.outer(rng.uniform(-9, 9, count) * DEG, axis / np.linalg.norm(axis)))


def small(rng: Rng, first: FloatArray, count: int) -> FloatArray:
    """Turns of less than 2 deg between any two; more than a reported pose is uncertain."""
    axis = rng.normal(size=(count, 3))
    size = rng.uniform(0.3, 0.95) * DEG * rng.random(count) ** (1 / 3)
    size[:2], axis[1] = size.max(), -axis[0]
    return _about(rng, first, axis * (size / np.linalg.norm(axis, axis=1))[:, None])


def constant(rng: Rng, first: FloatArray, count: int) -> FloatArray:
    return np.tile(first, (count, 1, 1))


def half_turns(rng: Rng, first: FloatArray, count: int) -> FloatArray:
    """Each upright or turned by half about the beam, but for 4 deg."""
    wobble = rng.uniform(-1.0, 1.0, (count, 3)) * 2.3 * DEG
    turned = _about(rng, first, np.outer(rng.permutation(np.arange(count) % 2), [0.0, 0.0, np.pi]))
    return np.asarray(turned @ Rotation.from_rotvec(wobble).as_matrix())


# Numbers that people and devices get wrong.


def too_few(problem: Any, rng: Rng) -> Any:
    """As many rows as unknowns, or less."""
    unknowns, rows = int(problem.belief().flat.sum()), problem.model()
    each = len(rows) // edits.count(problem)
    most = unknowns // each
    return edits.taken(problem, rng.permutation(edits.count(problem))[: rng.integers(1, most + 1)])


def duplicated(problem: Any, rng: Rng) -> Any:
    """Few measurements many times, or some of them twice."""
    count = edits.count(problem)
    if rng.random() < 0.5:
        return edits.taken(problem, rng.integers(0, rng.integers(2, 6), count))
    twice = rng.choice(count, rng.integers(1, count // 2), replace=False)
    return edits.taken(problem, np.concatenate([np.arange(count), twice]))


def one_outlier(rng: Rng, count: int) -> FloatArray:
    shift = np.zeros(count)
    shift[rng.integers(count)] = rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 20.0) * MM
    return shift


def clustered(rng: Rng, count: int) -> FloatArray:
    """A fifth of the measurements, in succession, all off by the same."""
    shift, first = np.zeros(count), rng.integers(count)
    shift[(first + np.arange(-(-count // 5))) % count] = rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 10.0) * MM
    return shift


def wrong_units(problem: Any, rng: Rng) -> Any:
    factor = rng.choice([1e3, 1e-3, 25.4, 1 / 25.4])
    arrays = edits.lengths(problem)
    return edits.scaled(problem, arrays[rng.integers(len(arrays))], factor)


def inverted(problem: Any, rng: Rng) -> Any:
    arrays = edits.pose_arrays(problem)
    name = arrays[rng.integers(len(arrays))]
    return edits.with_array(problem, name, np.linalg.inv(edits.array(problem, name)))


def left_handed(problem: Any, rng: Rng) -> Any:
    """One axis mirrored, or two exchanged; in one pose or in all."""
    poses, name = _poses(problem, rng)
    rows = slice(None) if rng.random() < 0.5 else rng.integers(len(poses), size=1)
    mirrored = poses[rows]
    if rng.random() < 0.5:
        mirrored[:, :3, rng.integers(3)] *= -1.0
    else:
        mirrored[:, :3, :3] = mirrored[:, :3, [1, 0, 2]]
    poses[rows] = mirrored
    return edits.with_array(problem, name, poses)


def not_a_rotation(problem: Any, rng: Rng) -> Any:
    """Scaled, sheared, or written with two decimals."""
    poses, name = _poses(problem, rng)
    how = rng.integers(3)
    if how == 0:
        poses[:, :3, :3] *= 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(1e-3, 0.1)
    elif how == 1:
        poses[rng.integers(len(poses)), rng.integers(3), rng.integers(3)] += rng.uniform(0.01, 0.1)
    else:
        poses[:, :3, :3] = np.round(poses[:, :3, :3], 2)
    return edits.with_array(problem, name, poses)


def _poses(problem: Any, rng: Rng) -> tuple[FloatArray, str]:
    arrays = edits.pose_arrays(problem)
    name = arrays[rng.integers(len(arrays))]
    return edits.array(problem, name).copy(), name


def not_finite(problem: Any, rng: Rng) -> Any:
    arrays = edits.float_arrays(problem)
    name = arrays[rng.integers(len(arrays))]
    spoilt = edits.array(problem, name).astype(np.float64)
    spoilt.reshape(-1)[rng.integers(spoilt.size)] = rng.choice([np.nan, np.inf, -np.inf])
    return edits.with_array(problem, name, spoilt)


def wrong_shape(problem: Any, rng: Rng) -> Any:
    """A row, a column or an axis that is missing or too much; words instead of numbers."""
    arrays = edits.measured_arrays(problem)
    name = arrays[rng.integers(len(arrays))]
    given = edits.array(problem, name)
    wrong: list[Any] = [given[None], given[..., None], given.astype(str), given[:0], given.tolist()[0]]
    if given.ndim > 1:
        wrong += [given[..., :-1], given.reshape(len(given), -1).T]
    if given.ndim == 3:
        wrong.append(given[:, :3])
    if len(arrays) > 1 and not (name.startswith("motion.") and edits.indexed(problem)):
        wrong += [given[:-1], np.concatenate([given, given[:1]])]
    return edits.with_array(problem, name, wrong[rng.integers(len(wrong))])


def swapped_joints(problem: Any, rng: Rng) -> Any:
    joints = problem.motion.joints_rad.copy()
    first, second = rng.choice(6, 2, replace=False)
    joints[:, [first, second]] = joints[:, [second, first]]
    return replace(problem, motion=replace(problem.motion, joints_rad=joints))


def wrong_surface(problem: Any, rng: Rng) -> Any:
    """Faces or markers exchanged; a sphere for a plane or the other way round; a sphere of another size."""
    if hasattr(problem, "face_index"):
        return replace(problem, face_index=_exchanged(problem.face_index, rng))
    if hasattr(problem, "marker_index"):
        return replace(problem, marker_index=_exchanged(problem.marker_index, rng))
    if isinstance(problem, tuple(OTHER_SURFACE)):
        known = getattr(problem, "radius_m", None)
        if known is None or rng.random() < 0.5:
            return edits.as_kind(OTHER_SURFACE[type(problem)], problem)
    return replace(problem, radius_m=problem.radius_m * rng.choice([0.5, 2.0, 2.54]))


OTHER_SURFACE: Mapping[type, type] = {
    PointLaserOnPlane: PointLaserOnSphere,
    PointLaserOnSphere: PointLaserOnPlane,
    ProfileLaserOnPlane: ProfileLaserOnSphere,
    ProfileLaserOnSphere: ProfileLaserOnPlane,
}


def _exchanged(index: Any, rng: Rng) -> Any:
    first, second = rng.choice(np.unique(index), 2, replace=False)
    other = index.copy()
    other[index == first], other[index == second] = second, first
    return other


# Two parallel faces and one across them leave the part to slide along a line.
_SLIDING = ((0, 1), (0, 2), (1, 2), (2, 4, 0), (1, 2, 4), (0, 3))


def _setting(**fixed: Any) -> Callable[[str, Rng], Any]:
    return partial(_laid_out, of=lambda rng: Setting(**fixed))


def _numbers(how: Callable[[Any, Rng], Any], **setting: Any) -> Callable[[str, Rng], Any]:
    return partial(_spoilt, how=how, **setting)


KINDS = (
    Kind(Cause.ONE_AXIS, SENSORS + PAIRS, _setting(turn=one_axis)),
    Kind(Cause.SMALL_ROTATIONS, SENSORS + PAIRS, _setting(turn=small)),
    Kind(
        Cause.HALF_TURNS,
        tuple(name for name in SENSORS + PAIRS if name not in FACES),
        _setting(turn=half_turns),
    ),
    Kind(Cause.COPLANAR_POSES, (*CARRIED, "pose-pairs"), _setting(flat=True)),
    Kind(Cause.CONSTANT_ORIENTATION, SENSORS + PAIRS, _setting(turn=constant)),
    Kind(
        Cause.ONE_FACE,
        FACES,
        partial(_laid_out, of=lambda rng: Setting(faces=[(0,), (1,), (2,), (3,), (2, 4)][rng.integers(5)])),
    ),
    Kind(
        Cause.COLLINEAR,
        ("point-laser-plane", "camera-hand-eye", "camera-eye-to-hand"),
        _setting(line=True),
    ),
    Kind(
        Cause.SYMMETRIC,
        FACES,
        partial(_laid_out, of=lambda rng: Setting(faces=_SLIDING[rng.integers(len(_SLIDING))])),
    ),
    Kind(Cause.TOO_FEW, SENSORS + PAIRS, _numbers(too_few)),
    Kind(Cause.DUPLICATED, SENSORS + PAIRS, _numbers(duplicated)),
    Kind(Cause.OUTLIER, SENSORS + PAIRS, partial(_shifted, by=one_outlier)),
    Kind(Cause.CLUSTERED_OUTLIERS, SENSORS + PAIRS, partial(_shifted, by=clustered)),
    Kind(Cause.WRONG_UNITS, SENSORS + PAIRS, _numbers(wrong_units)),
    # Touches of a sphere fit inverted poses as well: the ball and the centre of the sphere change places.
    Kind(
        Cause.INVERTED,
        tuple(name for name in SENSORS + PAIRS if name != "touch-sphere"),
        _numbers(inverted),
    ),
    Kind(Cause.LEFT_HANDED, SENSORS + PAIRS, _numbers(left_handed)),
    Kind(Cause.NOT_A_ROTATION, SENSORS + PAIRS, _numbers(not_a_rotation)),
    Kind(Cause.NOT_FINITE, SENSORS + PAIRS, _numbers(not_finite)),
    Kind(Cause.WRONG_SHAPE, SENSORS + PAIRS, _numbers(wrong_shape)),
    Kind(Cause.SWAPPED_JOINTS, ARMED, _numbers(swapped_joints, arm=True)),
    Kind(
        Cause.WRONG_SURFACE,
        # Where radius or markers are unknown, another radius or other names are no mistake.
        tuple(name for name in SENSORS if "unknown" not in name and name != "tracker"),
        _numbers(wrong_surface),
    ),
)


def _of_place(cause: Cause, draw: Callable[[Rng], Any]) -> Kind:
    return Kind(cause, (LOCALIZATION,), lambda task, rng: draw(rng))


def _of_sound_place(cause: Cause, how: Callable[[Any, Rng], Any]) -> Kind:
    return _of_place(cause, lambda rng: how(places.located(rng).problem, rng))


LOCALIZATION = "localization"
# What of the twenty can happen to a localization; after them, so that their draws stay the same.
OF_PLACES = (
    _of_place(Cause.ONE_FACE, places.on_one_face),
    _of_place(Cause.COLLINEAR, places.on_a_line),
    _of_place(Cause.SYMMETRIC, places.symmetric),
    _of_sound_place(Cause.TOO_FEW, too_few),
    _of_sound_place(Cause.DUPLICATED, duplicated),
    _of_place(Cause.OUTLIER, lambda rng: places.off(rng, one_outlier)),
    _of_place(Cause.CLUSTERED_OUTLIERS, lambda rng: places.off(rng, clustered)),
    _of_sound_place(Cause.WRONG_UNITS, wrong_units),
    _of_sound_place(Cause.NOT_FINITE, not_finite),
    _of_sound_place(Cause.WRONG_SHAPE, wrong_shape),
    _of_place(Cause.WRONG_SURFACE, places.exchanged),
)
