"""A plan as a program in the language of the robot, for a dry run at the teach pendant.

It drives through the postures in the order of the plan and waits at each; it measures nothing. The arm that
truecell drives needs none.

Sources: URScript manual (movej, sleep); ABB RAPID reference (MoveAbsJ, jointtarget); Mitsubishi MELFA-BASIC V
(Mov, Dly, Spd in per cent by JOvrd).
"""

from collections.abc import Iterator, Sequence
from math import degrees

from controller.cellfile import Cell
from controller.cellfile.robots import AbbRobot, MelfaSerialRobot, MelfaTcpRobot, UrRobot
from controller.planning import Step
from controller.planning.steps import Joints


def program_of(cell: Cell, steps: Sequence[Step]) -> tuple[str, str] | None:
    """File name and text; None for a robot without a language of its own."""
    postures = list(_postures(steps))
    match cell.robot:
        case UrRobot():
            return "plan.script", _urscript(cell, postures)
        case AbbRobot():
            return "plan.mod", _rapid(cell, postures)
        case MelfaTcpRobot() | MelfaSerialRobot():
            percent = 100.0 * cell.robot.speed_rad_s / cell.robot.max_speed_rad_s
            return "plan.prg", _melfa_basic(cell, percent, postures)
        case _:
            return None


def _postures(steps: Sequence[Step]) -> Iterator[tuple[Joints, str]]:
    """Joints and the step that is measured there, or "" on the way."""
    for step in steps:
        yield from ((posture, "") for posture in step.via)
        yield step.joints_rad, step.id
        yield from ((posture, "") for posture in step.retreat)


def _urscript(cell: Cell, postures: Sequence[tuple[Joints, str]]) -> str:
    speed, acceleration = cell.robot.speed_rad_s, cell.robot.acceleration_rad_s2
    lines = ["def truecell_plan():"]
    for joints, step in postures:
        values = ", ".join(f"{angle:.6f}" for angle in joints)
        lines.append(f"  movej([{values}], a={acceleration:.4f}, v={speed:.4f})")
        if step:
            lines.append(f"  sleep({cell.robot.settle_time_s:.3f})  # {step}")
    return "\n".join([*lines, "end", ""])


def _rapid(cell: Cell, postures: Sequence[tuple[Joints, str]]) -> str:
    turn = degrees(cell.robot.speed_rad_s)
    lines = [
        "MODULE TruecellPlan",
        f"  CONST speeddata slow := [100, {turn:.3f}, 100, {turn:.3f}];",
        "  PROC main()",
    ]
    for joints, step in postures:
        values = ", ".join(f"{degrees(angle):.4f}" for angle in joints)
        lines.append(
            f"    MoveAbsJ [[{values}], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]] \\NoEOffs, slow, fine, tool0;"
        )
        if step:
            lines.append(f"    WaitTime {cell.robot.settle_time_s:.3f};  ! {step}")
    return "\n".join([*lines, "  ENDPROC", "ENDMODULE", ""])


def _melfa_basic(cell: Cell, percent: float, postures: Sequence[tuple[Joints, str]]) -> str:
    lines = ["Servo On", f"JOvrd {max(1.0, min(100.0, percent)):.0f}"]
    for joints, step in postures:
        values = ",".join(f"{degrees(angle):.3f}" for angle in joints)
        lines += [f"J1=({values})", "Mov J1"]
        if step:
            lines.append(f"Dly {cell.robot.settle_time_s:.2f} '{step}")
    return "\n".join([f"{number} {line}" for number, line in enumerate([*lines, "End"], start=1)] + [""])
