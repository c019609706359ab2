"""`truecell plan`: every phase of the job as it would be planned, without a device and without motion."""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from math import degrees
from typing import Any

from controller.cellfile import Cell, CheckPhase, HandEyePhase, LocalizePhase, NoisePhase
from controller.knowledge import first_belief, with_bar, with_inspected, with_part, with_plate, with_probe
from controller.planning import (
    Plan,
    Step,
    plan_bar_check,
    plan_coarse_localize,
    plan_hand_eye,
    plan_inspect,
    plan_localize,
    plan_noise,
    plan_part_check,
)
from controller.planning.duration import duration_s
from controller.planning.feasibility import Reachable, feasibility
from estimation.belief import Belief
from estimation.errors import CellFileError
from estimation.kinematics import ArmModel


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPhase:
    """One phase as it would be planned, with what is known before anything moves."""

    name: str
    limit_m: float | None
    plan: Plan
    reachable: Reachable | None  # with all measurements that the phase may take
    duration_s: float

    @property
    def needed(self) -> int | None:
        """The fewest chosen measurements that meet the limit; None without limit, or if all do not."""
        curve = enumerate(self.plan.curve_U_m)
        return next((count for count, U_m in curve if self.limit_m is not None and U_m <= self.limit_m), None)

    def to_dict(self) -> dict[str, Any]:
        """For export; lengths in metres, angles in radians."""
        return {
            "phase": self.name,
            "limit_m": self.limit_m,
            "best_reachable_U_m": None if self.reachable is None else self.reachable.best.U_m,
            "needed": self.needed,
            "duration_s": round(self.duration_s, 1),
            **self.plan.to_dict(),
        }


def plan_job(cell: Cell, phase: str | None = None) -> tuple[PlannedPhase, ...]:
    """Every phase, or the one of a name, as it would be planned.

    Poses of later phases follow from what earlier ones will find; here all is where the cell file says.

    Raises CellFileError for a phase that the job has not, CellError for what cannot be measured.
    """
    names = [spec.name for spec in cell.job.phases]
    if phase is not None and phase not in names:
        near = get_close_matches(phase, names, n=1, cutoff=0.0)
        raise CellFileError(f"The job of {cell.name} has no phase {phase!r}", f"The nearest is {near[0]!r}")
    reachable = {item.phase: item for item in feasibility(cell)}
    return tuple(
        PlannedPhase(name, limit_m, plan, reachable.get(name), duration_s(cell, plan.steps))
        for name, limit_m, plan in _plans(cell, {name: item.takes for name, item in reachable.items()})
        if phase in (None, name)
    )


def rows_of(phases: tuple[PlannedPhase, ...]) -> list[Mapping[str, Any]]:
    """One row for each phase: steps by kind, predicted U against the limit, dominating source, time."""
    rows: list[Mapping[str, Any]] = []
    for phase in phases:
        plan, best = phase.plan, phase.reachable
        U_m = None if plan.worst is None or phase.limit_m is None else plan.worst.U_m
        dominating = None if best is None else "{} {:.0%}".format(*best.best.dominating)
        rows.append(
            {
                "phase": phase.name,
                "measures": ", ".join(f"{count} {what}" for what, count in _counts(plan.steps).items()),
                "limit_mm": None if phase.limit_m is None else f"{phase.limit_m * 1e3:.2f}",
                "U_mm": None if U_m is None else f"{U_m * 1e3:.3f}",
                "needs": phase.needed,
                "dominated_by": dominating,
                "about_s": f"{phase.duration_s:.0f}",
            }
        )
    return rows


def step_rows(phases: tuple[PlannedPhase, ...]) -> list[Mapping[str, Any]]:
    """Every step of every phase, in order: what is measured where, from which joint angles."""
    return [
        {
            "step": step.id,
            "kind": step.kind,
            "on": step.feature if step.feature.startswith(step.object) else f"{step.object} {step.feature}",
            "joints_deg": " ".join(f"{degrees(angle):.1f}" for angle in step.joints_rad),
            "expected_mm": f"{step.expected_m * 1e3:.1f}" if step.kind == "laser" else None,
            "note": step.note,
        }
        for phase in phases
        for step in phase.plan.steps
    ]


def _counts(steps: tuple[Step, ...]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for step in steps:
        what = f"{step.kind} on {step.object}"
        counts[what] = counts.get(what, 0) + 1
    return counts


def _plans(cell: Cell, takes: Mapping[str, int]) -> list[tuple[str, float | None, Plan]]:
    arm, belief, steps = cell.robot.arm_model(), first_belief(cell), dict[str, tuple[Step, ...]]()
    found: list[tuple[str, float | None, Plan]] = []
    for spec in cell.job.phases:
        plan, belief = _plan(cell, arm, belief, spec, steps, takes.get(spec.name, 0))
        steps[spec.name] = plan.steps
        limit_m = spec.limit_m if isinstance(spec, HandEyePhase | LocalizePhase) else None
        found.append((spec.name, limit_m, plan))
    return found


def _plan(
    cell: Cell, arm: ArmModel, belief: Belief, spec: Any, steps: dict[str, tuple[Step, ...]], takes: int
) -> tuple[Plan, Belief]:
    """The plan of one phase with what it is likely to take, and what the next one starts from."""
    match spec:
        case NoisePhase():
            return plan_noise(cell, with_plate(belief, cell), arm, spec), belief
        case HandEyePhase():
            plan = plan_hand_eye(cell, with_plate(belief, cell), arm, takes, 0)
            return plan, plan.belief or belief
        case LocalizePhase():
            coarse = plan_coarse_localize(cell, with_part(belief, cell), arm, spec, 0)
            plan = plan_localize(cell, coarse.belief or belief, arm, spec, 0, takes)
            steps_of, curve_U_m = (*coarse.steps, *plan.steps), (*coarse.curve_U_m, *plan.curve_U_m[1:])
            return Plan(steps_of, plan.gated, plan.belief, curve_U_m), plan.belief or belief
        case CheckPhase() if spec.points_per_sphere:
            return plan_bar_check(cell, with_bar(belief, cell), arm, spec, steps[spec.of], 0), belief
        case CheckPhase():
            return plan_part_check(cell, belief, arm, spec, steps[spec.of], 0), belief
        case _:
            return plan_inspect(cell, with_inspected(with_probe(belief, cell), cell), arm, spec, 0), belief
