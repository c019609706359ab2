"""What the axes of a positioner are like, and what follows from both: how they stand to each other, zeros."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from estimation.belief import POSE_FREEDOMS, Belief, Value
from estimation.model import pose_of, values_of
from estimation.tasks.findings import Cause, Finding, Status
from estimation.tasks.positioner import PositionerTask
from estimation.tasks.solve import Result, refused, solve
from estimation.tasks.turning import AXES
from estimation.transform import FloatArray, Transform

_PARALLEL: Final = np.sin(np.radians(0.5))  # of the angle between axes without a common normal
_STEP: Final = 1e-6  # m and rad, of central differences


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """An axis where all angles are zero: the z axis of base_T_axis, right-handed for growing angles.

    Attributes
    ----------
    base_T_axis : its origin is the point of the axis next to the middle of the measured points.
    covariance : (4, 4) of shifts along and tilts about x and y of that frame; m and rad.
    """

    base_T_axis: Transform
    covariance: FloatArray

    @property
    def point_m(self) -> FloatArray:
        """(3,) on the axis, in the base."""
        return self.base_T_axis.origin_m

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector in the base."""
        return self.base_T_axis.rotation[:, 2]


@dataclass(frozen=True, slots=True)
class Derived:
    """A number that follows from an estimate, m or rad, with its variance by source."""

    name: str
    value: float
    unit: str
    variance: Mapping[str, float]

    @property
    def u(self) -> float:
        """Standard uncertainty, in the unit."""
        return math.sqrt(max(sum(self.variance.values()), 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Positioned(Result):
    """Axes of a positioner.

    Attributes
    ----------
    axes : of axis 1 and axis 2; None for one that did not turn, or when refused.
    derived : "axes apart" (distance of the common normal, or of parallel axes), "angle between axes", "zero
        of axis 1" (its angle where axis 2 is as nearly upright as it can be), "zero of axis 2" (its angle
        where x of the object is as nearly along axis 1 as it can be), as far as they have a meaning.
    """

    axes: tuple[Axis | None, Axis | None] = (None, None)
    derived: tuple[Derived, ...] = ()


def calibrate_axes(problem: PositionerTask, explain: bool = True) -> Positioned:
    """Estimate; never raises for bad data. An axis that stood still is left out, and said to be."""
    sight = tuple(problem.turning.check())
    if sight:
        return Positioned(**_parts(refused(problem.task, sight)))
    still = problem.turning.still
    words = tuple(_not_turned(axis) for axis in still)
    if len(still) == 2:
        return Positioned(**_parts(refused(problem.task, words)))
    moved = tuple(axis for axis in (0, 1) if axis not in still)
    problem = replace(problem, motion=replace(problem.turning, axes=moved))
    result = solve(problem, explain)
    parts = _parts(result)
    if result.estimate is None:
        return Positioned(**{**parts, "findings": (*words, *result.findings)})
    if words:
        parts |= {"findings": (*words, *result.findings), "status": Status.FLAGGED}
    belief = result.belief
    parts["shown"] = tuple(name for name in result.shown if belief.block(name).freedoms)
    axes = [
        Axis(belief.transform(name), belief.block_covariance(name)) if name in belief else None
        for name in AXES
    ]
    return Positioned(**parts, axes=(axes[0], axes[1]), derived=_derived(problem, belief))


def _parts(result: Result) -> dict[str, Any]:
    return {field.name: getattr(result, field.name) for field in fields(Result)}


def _not_turned(axis: int) -> Finding:
    return Finding(
        Cause.ONE_AXIS,
        f"Axis {axis + 1} stood still: where it is cannot be seen, and it gets no number",
        f"Turn axis {axis + 1} through 60 deg or more as well",
        refuses=False,
    )


def _derived(problem: PositionerTask, belief: Belief) -> tuple[Derived, ...]:
    if any(name not in belief for name in AXES):
        return ()
    up = np.asarray(problem.up, dtype=np.float64)
    up = up / max(float(np.linalg.norm(up)), _PARALLEL)
    found = [
        _of(belief, "axes apart", _apart, "m"),
        _of(belief, "angle between axes", _between, "rad"),
        _of(belief, "zero of axis 1", lambda values: _zero(values, up), "rad"),
    ]
    if problem.object in belief and set(POSE_FREEDOMS[3:]) <= set(belief.block(problem.object).freedoms):
        found.append(_of(belief, "zero of axis 2", lambda v: _object_zero(v, problem.object), "rad"))
    return tuple(each for each in found if each is not None)


def _of(
    belief: Belief, name: str, function: Callable[[Mapping[str, Value]], float], unit: str
) -> Derived | None:
    """A function of the values with its uncertainty; None where it has no value."""
    values = values_of(belief)
    value = function(values)
    if not np.isfinite(value):
        return None
    gradient = np.zeros(belief.size)
    for block, held in values.items():
        if isinstance(held, Transform):  # nothing here depends on what is no pose
            for place, step in enumerate(_STEP * np.eye(6)[belief.block(block).active]):
                ahead, behind = (function({**values, block: held.perturbed(xi)}) for xi in (step, -step))
                difference = math.remainder(ahead - behind, math.tau) if unit == "rad" else ahead - behind
                gradient[belief.index(block).start + place] = difference / (2.0 * _STEP)
    variance = {source: part.item() for source, part in belief.budget(gradient[None]).items()}
    return Derived(name, value, unit, variance)


def _lines(values: Mapping[str, Value]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Directions of both axes, and from a point of the first to one of the second."""
    first, second = (pose_of(values, name) for name in AXES)
    return first.rotation[:, 2], second.rotation[:, 2], second.origin_m - first.origin_m


def _apart(values: Mapping[str, Value]) -> float:
    first, second, gap = _lines(values)
    across = np.cross(first, second)
    sine = float(np.linalg.norm(across))
    if sine < _PARALLEL:
        return float(np.linalg.norm(gap - first * (first @ gap)))
    return float(gap @ across / sine)


def _between(values: Mapping[str, Value]) -> float:
    first, second, _ = _lines(values)
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))


def _zero(values: Mapping[str, Value], up: FloatArray) -> float:
    first, second, _ = _lines(values)
    return _nearest_angle(first, second, up)


def _object_zero(values: Mapping[str, Value], name: str) -> float:
    first, second, _ = _lines(values)
    return _nearest_angle(second, pose_of(values, name).rotation[:, 0], first)


def _nearest_angle(axis: FloatArray, turned: FloatArray, goal: FloatArray) -> float:
    """Angle about `axis` that takes `turned` nearest to `goal`; NaN where none does better than others."""
    sine = float(goal @ np.cross(axis, turned))
    cosine = float(goal @ turned - (goal @ axis) * (axis @ turned))
    return float(np.arctan2(sine, cosine)) if np.hypot(sine, cosine) > _PARALLEL else float("nan")
