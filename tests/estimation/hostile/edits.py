"""The arrays of a problem, whatever its task: taken in part, shifted, scaled, or replaced by others."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.tasks.pairs import PairTask
from tests.estimation.tasks.cells import Cell
from tests.estimation.tasks.layout import FloatArray

_MEASURED = (
    "reading_m",
    "profile_m",
    "points_m",
    "sensor_T_object",
    "first_T_second",
    "base_p",
    "toward_sensor",
)
_NAMED = ("pose_index", "marker_index", "face_index", "first", "second", "index")


def array(problem: Any, name: str) -> NDArray[Any]:
    """By its name; those of the motion are "motion.<name>"."""
    owner, _, own = name.rpartition(".")
    return np.asarray(getattr(problem.motion if owner else problem, own))


def with_array(problem: Any, name: str, value: Any) -> Any:
    """The problem with another array."""
    owner, _, own = name.rpartition(".")
    if owner:
        return replace(problem, motion=replace(problem.motion, **{own: value}))
    return replace(problem, **{own: value})


def _motion(problem: Any) -> list[str]:
    if not hasattr(problem, "motion"):
        return []
    return ["motion.joints_rad" if hasattr(problem.motion, "joints_rad") else "motion.base_T_flange"]


def _own(problem: Any, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if getattr(problem, name, None) is not None]


def measured_arrays(problem: Any) -> list[str]:
    """Everything with a row for each pose or reading."""
    return [*_motion(problem), *_own(problem, _MEASURED), *_own(problem, _NAMED)]


def float_arrays(problem: Any) -> list[str]:
    """Of numbers that are measured or certified."""
    return [*_motion(problem), *_own(problem, _MEASURED), *_own(problem, ("markers_m",))]


def pose_arrays(problem: Any) -> list[str]:
    """Of 4 x 4 matrices."""
    return [name for name in float_arrays(problem) if array(problem, name).ndim == 3]


def lengths(problem: Any) -> list[str]:
    """With lengths in them; together "everything measured"."""
    return [name for name in float_arrays(problem) if name != "toward_sensor"]


def count(problem: Any) -> int:
    """Number of measurements."""
    return len(array(problem, [*_own(problem, _MEASURED), *_motion(problem)][0]))


def indexed(problem: Any) -> bool:
    """Whether measurements say by an index at which pose they were taken."""
    return hasattr(problem, "pose_index") or hasattr(problem, "first")


def taken(problem: Any, rows: NDArray[np.intp]) -> Any:
    """The measurements of these rows; poses that are left without one stay."""
    names = _own(problem, _MEASURED) + _own(problem, _NAMED)
    if not indexed(problem):
        names += _motion(problem)
    for name in names:
        problem = with_array(problem, name, array(problem, name)[rows])
    return problem


def direction(rng: np.random.Generator) -> FloatArray:
    """A unit vector (3,)."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def shifted(cell: Cell, shift_m: FloatArray, along: FloatArray) -> Any:
    """Measurements off by shifts (n,), m: along the beam, or for whole points and poses along a vector."""
    problem = cell.problem
    if isinstance(problem, PairTask):
        name = problem.reported
        moved = array(problem, name).copy()
        moved[:, :3, 3] += shift_m[:, None] * along
        return with_array(problem, name, moved)
    if hasattr(problem, "ball_radius_m"):  # a touch is off where the controller says that the arm was
        poses = problem.motion.base_T_flange.copy()
        poses[:, :3, 3] += shift_m[:, None] * _outward(cell)
        return with_array(problem, "motion.base_T_flange", poses)
    if hasattr(problem, "reading_m"):
        return with_array(problem, "reading_m", problem.reading_m + shift_m)
    if hasattr(problem, "profile_m"):
        return with_array(problem, "profile_m", problem.profile_m + shift_m[:, None] * [0.0, 1.0])
    return with_array(problem, "points_m", problem.points_m + shift_m[:, None] * along)


def _outward(cell: Cell) -> FloatArray:
    """(n, 3) in the base, out of the material where each touch was."""
    problem, truth = cell.problem, cell.truth
    if hasattr(problem, "face_index"):
        normals = np.array([face.axis for face in problem.faces])[problem.face_index]
        return np.asarray(normals @ truth["part"][:3, :3].T)
    ball = problem.motion.base_T_flange @ truth["probe"][:, 3]
    away = ball[:, :3] - truth["sphere"][:3, 3]
    return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def scaled(problem: Any, name: str, factor: float) -> Any:
    """An array in another unit: of poses only their origins."""
    given = array(problem, name) * 1.0
    if given.ndim == 3:
        given[:, :3, 3] *= factor
    else:
        given *= factor
    return with_array(problem, name, given)


def as_kind(kind: type, problem: Any) -> Any:
    """The same readings, taken for those of another task."""
    shared = {field.name for field in fields(kind)} & {field.name for field in fields(problem)}
    return kind(**{name: getattr(problem, name) for name in shared})
