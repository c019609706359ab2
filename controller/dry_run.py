"""`truecell plan`: every phase of the job as it would be planned, without a device and without motion."""

from math import degrees
from pathlib import Path
from typing import Any

from controller.cellfile import Cell, CheckPhase, HandEyePhase, LocalizePhase, NoisePhase, load_cell
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
from controller.planning.feasibility import feasibility
from estimation.belief import Belief
from estimation.kinematics import ArmModel

SECONDS_A_STEP = {"laser": 1.8, "noise": 2.5, "touch": 3.0}  # mean of simulated jobs, moves included


def plan_job(cell_path: Path) -> list[dict[str, Any]]:
    """One row for each phase: steps by kind, predicted U against the limit, dominating source, time.

    Poses of later phases follow from what earlier ones will find; here all is where the cell file says.
    """
    cell = load_cell(cell_path)
    reachable = {item.phase: item for item in feasibility(cell)}
    rows = []
    for name, limit_m, plan in _plans(cell):
        best = reachable.get(name)
        seconds = sum(SECONDS_A_STEP.get(step.kind, 2.0) for step in plan.steps)
        rows.append(
            {
                "phase": name,
                "measures": ", ".join(f"{count} {what}" for what, count in _counts(plan.steps).items()),
                "limit_mm": None if limit_m is None else f"{limit_m * 1e3:.2f}",
                "U_mm": None if plan.worst is None or limit_m is None else f"{plan.worst.U_m * 1e3:.3f}",
                "dominated_by": None
                if best is None
                else f"{best.best.dominating[0]} {best.best.dominating[1]:.0%}",
                "about_s": f"{seconds:.0f}",
            }
        )
    return rows


def list_steps(cell_path: Path) -> list[dict[str, Any]]:
    """Every step of every phase, in order: what is measured where, from which joint angles."""
    cell = load_cell(cell_path)
    return [
        {
            "step": step.id,
            "kind": step.kind,
            "on": step.feature if step.feature.startswith(step.object) else f"{step.object} {step.feature}",
            "joints_deg": " ".join(f"{degrees(angle):.1f}" for angle in step.joints_rad),
            "expected_mm": f"{step.expected_m * 1e3:.1f}" if step.kind == "laser" else None,
            "note": step.note,
        }
        for _, _, plan in _plans(cell)
        for step in plan.steps
    ]


def _counts(steps: tuple[Step, ...]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for step in steps:
        what = f"{step.kind} on {step.object}"
        counts[what] = counts.get(what, 0) + 1
    return counts


def _plans(cell: Cell) -> list[tuple[str, float | None, Plan]]:
    arm, belief, steps = cell.robot.arm_model(), first_belief(cell), dict[str, tuple[Step, ...]]()
    found: list[tuple[str, float | None, Plan]] = []
    for spec in cell.job.phases:
        plan, belief = _plan(cell, arm, belief, spec, steps)
        steps[spec.name] = plan.steps
        limit_m = spec.limit_m if isinstance(spec, HandEyePhase | LocalizePhase) else None
        found.append((spec.name, limit_m, plan))
    return found


def _plan(
    cell: Cell, arm: ArmModel, belief: Belief, spec: Any, steps: dict[str, tuple[Step, ...]]
) -> tuple[Plan, Belief]:
    """The plan of one phase, and what the next one starts from."""
    match spec:
        case NoisePhase():
            return plan_noise(cell, with_plate(belief, cell), arm, spec), belief
        case HandEyePhase():
            plan = plan_hand_eye(cell, with_plate(belief, cell), arm, spec.measurements, 0)
            return plan, plan.belief or belief
        case LocalizePhase():
            coarse = plan_coarse_localize(cell, with_part(belief, cell), arm, spec, 0)
            plan = plan_localize(cell, coarse.belief or belief, arm, spec, 0)
            return Plan((*coarse.steps, *plan.steps), plan.gated, plan.belief), plan.belief or belief
        case CheckPhase() if spec.points_per_sphere:
            return plan_bar_check(cell, with_bar(belief, cell), arm, spec, steps[spec.of], 0), belief
        case CheckPhase():
            return plan_part_check(cell, belief, arm, spec, steps[spec.of], 0), belief
        case _:
            return plan_inspect(cell, with_inspected(with_probe(belief, cell), cell), arm, spec, 0), belief
