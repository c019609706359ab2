"""The estimate of a data set for people and for scripts: millimetres, degrees and covariance."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from controller.offline.dataset_parts import Dataset
from controller.quantities import format_angle, format_length
from estimation.belief import Belief
from estimation.kinematics import PARAMETER_NAMES, ArmModel
from estimation.solver import Update
from estimation.statistics import expanded_uncertainty
from estimation.tasks.findings import Cause
from estimation.tasks.kinematics import Calibrated
from estimation.tasks.positioner_result import Derived, Positioned
from estimation.tasks.solve import CONSISTENCY_LEVEL, Result
from estimation.transform import FloatArray, Transform

USABLE, NOT_USABLE, REFUSED = "usable", "not_usable", "refused"
_OUTSIDE: Final = {"m": ("mm", 1e3), "rad": ("deg", 180.0 / np.pi)}


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What a data set says.

    Attributes
    ----------
    status : usable; not_usable (values with uncertainties that do not hold); refused (no values).
    reason : why it is not usable; empty otherwise. `notes` are other things to look at, `causes` their kinds.
    update : posterior and diagnostics, None when refused.
    parameters : posterior of the blocks that a user asked for, or that the data made better known.
    second_cost : cost of the next best solution over that of the best, None if there is none.
    arm : with its parameters as they were found, where these were to be calibrated.
    derived : numbers that follow from the parameters.
    """

    task: str
    status: str
    reason: str
    notes: tuple[str, ...] = ()
    causes: frozenset[Cause] = frozenset()
    update: Update | None = None
    parameters: Belief | None = None
    second_cost: float | None = None
    arm: ArmModel | None = None
    derived: tuple[Derived, ...] = ()


def estimate(dataset: Dataset, units_at: str = "") -> Estimate:
    """Solve it; never raises for bad data, which come back refused with their cause.

    units_at : where the units stand, "set.json:5", for a refusal that has to do with them.
    """
    found = of_result(dataset.solved())
    if Cause.WRONG_UNITS not in found.causes or not units_at:
        return found
    return replace(found, reason=f"{found.reason} The units stand in {units_at}.")


def of_result(result: Result) -> Estimate:
    """A result of the estimator, judged by what a user may do with it."""
    causes = frozenset(finding.cause for finding in result.findings)
    if result.estimate is None:
        return Estimate(result.task, REFUSED, " ".join(result.notes), causes=causes)
    copies = [str(finding) for finding in result.findings if finding.cause is Cause.DUPLICATED]
    reason = " ".join([*copies, _unexplained(result.estimate)]).strip()
    second = None if result.ambiguity is None else result.ambiguity.ratio
    shown = result.belief.marginal(result.shown)
    status = NOT_USABLE if reason else USABLE
    return Estimate(
        result.task,
        status,
        reason,
        result.notes,
        causes,
        result.estimate,
        shown,
        second,
        arm=result.arm if isinstance(result, Calibrated) else None,
        derived=result.derived if isinstance(result, Positioned) else (),
    )


def _unexplained(update: Update) -> str:
    """Why the stated uncertainty does not hold, or nothing. Too small residuals are on the safe side."""
    if update.dof < 1:
        return "As many measurements as unknowns: nothing checks them. Measure more."
    test = update.consistency(CONSISTENCY_LEVEL)
    if update.chi2 > test.upper:
        return (
            f"Residuals are larger than declared: chi-square {update.chi2:.4g}, honest data stay below "
            f"{test.upper:.4g}. Check the declared noise, and that every reading belongs to its pose."
        )
    return ""


def document(found: Estimate) -> dict[str, Any]:
    """For `--json`. The covariance is of `parameter_names`, in the units given with it."""
    head: dict[str, Any] = {"task": found.task, "status": found.status, "reason": found.reason}
    if found.update is None or found.parameters is None:
        return head
    belief, update = found.parameters, found.update
    units = [_outside(unit)[0] for block in belief.blocks for unit in block.units]
    scale = np.array([_outside(unit)[1] for block in belief.blocks for unit in block.units])
    std = scale * np.sqrt(np.diag(belief.covariance))
    labels = list(belief.labels)
    own: dict[str, Any] = {}
    if found.arm is not None:
        own["arm"] = _links(found.arm)
    if found.derived:
        own["derived"] = {each.name: _number(each) for each in found.derived}
    return {
        **head,
        **own,
        "notes": list(found.notes),
        "parameters": {block.name: _value(block.value, block.units) for block in belief.blocks},
        "parameter_names": labels,
        "covariance": (belief.covariance * np.outer(scale, scale)).tolist(),
        "covariance_units": units,
        "covariance_form": "A",
        "covariance_order": "as parameter_names; of a pose tx, ty, tz along, rx, ry, rz about its own axes",
        "standard_uncertainty": dict(zip(labels, std.tolist(), strict=True)),
        "budget": {
            source: dict(zip(labels, (np.diag(matrix) * scale**2).tolist(), strict=True))
            for source, matrix in belief.contributions.items()
        },
        "rms_mm": 1e3 * _rms_m(update),
        "dof": update.dof,
        "diagnostics": {
            "chi2": update.chi2,
            "variance_factor": update.variance_factor,
            "p_value": update.p_value,
            "rows": len(update.residual_m),
            "rejected_rows": np.flatnonzero(update.rejected).tolist(),
            "largest_leverage": float(update.leverage.max()),
            "rank": None if update.rank is None else update.rank.rank,
            "unknowns": None if update.rank is None else update.rank.unknowns,
            "iterations": update.iterations,
            "stop_reason": update.stop_reason,
            "second_solution_cost_ratio": found.second_cost,
        },
    }


def _links(arm: ArmModel) -> list[dict[str, str]]:
    """Links as data sets and cell files have them."""
    form = {name: format_length if name in ("a", "d") else format_angle for name in PARAMETER_NAMES}
    return [
        {name: form[name](float(getattr(arm, name)[joint]), 6) for name in PARAMETER_NAMES}
        for joint in range(arm.joint_count)
    ]


def _number(derived: Derived) -> dict[str, Any]:
    unit, factor = _outside(derived.unit)
    return {"value": factor * derived.value, "unit": unit, "standard_uncertainty": factor * derived.u}


COLUMNS: Final = ("parameter", "value", "u", "U (95 %)", "unit", "budget")


def table_rows(found: Estimate) -> list[tuple[str, str, str, str, str, str]]:
    """Name, value, standard and expanded uncertainty, unit, budget; of points in the worst direction."""
    return [_row(*quantity) for quantity in _quantities(found)]


def budget_shares(found: Estimate) -> dict[str, dict[str, float]]:
    """Of the origin and the rotation of each pose, the share of each source in the variance."""
    shares = {name: _shares(parts) for name, value, _, parts in _quantities(found) if len(value) > 1}
    return {name: parts for name, parts in shares.items() if parts}


def summary(found: Estimate) -> str:
    """Rows, scatter and redundancy in one line."""
    if found.update is None:
        return ""
    update = found.update
    rms_mm = 1e3 * _rms_m(update)
    return (
        f"{found.task}: {len(update.residual_m)} rows, {int(update.rejected.sum())} left out, rms "
        f"{rms_mm:.4g} mm, {update.dof} degrees of freedom, variance factor {update.variance_factor:.3g}"
    )


def _rms_m(update: Update) -> float:
    return float(np.sqrt(np.mean(update.residual_m[~update.rejected] ** 2)))


_Quantity = tuple[str, FloatArray, str, dict[str, FloatArray]]


def _quantities(found: Estimate) -> Iterator[_Quantity]:
    """Name, value, unit inside, and covariance by source: of origin and rotation of poses, and of numbers."""
    belief = found.parameters or Belief()
    for block in belief.blocks:
        place = belief.index(block.name)
        parts = {name: matrix[place, place] for name, matrix in belief.contributions.items()}
        if isinstance(block.value, Transform):
            shifts = np.flatnonzero([name.startswith("t") for name in block.freedoms])
            tilts = np.flatnonzero([name.startswith("r") for name in block.freedoms])
            pose = f"{block.value.target}_T_{block.value.source}"
            rpy = Rotation.from_matrix(block.value.rotation).as_euler("xyz")
            if len(shifts):
                yield f"{pose} origin", block.value.origin_m, "m", _of(parts, shifts)
            if len(tilts):
                yield f"{pose} roll pitch yaw", rpy, "rad", _of(parts, tilts)
            continue
        for i, (name, unit) in enumerate(zip(block.freedoms, block.units, strict=True)):
            label = block.name if len(block.freedoms) == 1 else f"{block.name} {name}"
            yield label, block.value[i : i + 1], unit, _of(parts, np.array([i]))
    for each in found.derived:
        parts = {source: np.array([[variance]]) for source, variance in each.variance.items()}
        yield each.name, np.array([each.value]), each.unit, parts


def _of(parts: Mapping[str, FloatArray], place: Any) -> dict[str, FloatArray]:
    return {name: matrix[np.ix_(place, place)] for name, matrix in parts.items()}


def _row(
    name: str, value: FloatArray, unit: str, parts: Mapping[str, FloatArray]
) -> tuple[str, str, str, str, str, str]:
    word, factor = _outside(unit)
    covariance = np.sum(list(parts.values()), axis=0) * factor**2
    u = float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
    digits = int(np.clip(1 - np.floor(np.log10(u)) if u > 0.0 else 4, 0, 9))
    budget = [
        f"{source} {100 * share:.0f} %"
        for source, share in sorted(_shares(parts).items(), key=lambda item: -item[1])
        if share > 0.005
    ]
    numbers = " ".join(f"{number:.{digits}f}" for number in factor * value)
    expanded = f"{float(expanded_uncertainty(covariance)):.3g}"
    return name, numbers, f"{u:.3g}", expanded, word, ", ".join(budget)


def _shares(parts: Mapping[str, FloatArray]) -> dict[str, float]:
    shares = {source: float(np.trace(matrix)) for source, matrix in parts.items()}
    whole = sum(shares.values()) or 1.0
    return {source: share / whole for source, share in shares.items() if share > 0.0}


def _value(value: Transform | FloatArray, units: tuple[str, ...]) -> dict[str, Any]:
    if isinstance(value, Transform):
        matrix = value.matrix.copy()
        matrix[:3, 3] *= 1e3
        return {"target": value.target, "source": value.source, "matrix_mm": matrix.tolist()}
    outside = [_outside(unit) for unit in units]
    numbers = [float(number * factor) for number, (_, factor) in zip(value, outside, strict=True)]
    words = [word for word, _ in outside]
    return {"value": numbers[0], "unit": words[0]} if len(words) == 1 else {"values": numbers, "units": words}


def _outside(unit: str) -> tuple[str, float]:
    """The unit of files and screens, and how many of it are one inside."""
    if unit == "rad/Nm":
        return "deg/Nm", 180.0 / np.pi
    return _OUTSIDE.get(unit, (unit, 1.0))
