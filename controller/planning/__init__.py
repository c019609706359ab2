"""Planning: which measurements to take, so that the gated quantity becomes known well enough."""

from controller.planning.checks import plan_bar_check, plan_noise
from controller.planning.estimated import (
    plan_coarse_localize,
    plan_hand_eye,
    plan_localize,
    plan_part_check,
)
from controller.planning.inspection import more_inspect, plan_inspect
from controller.planning.online import Prospect
from controller.planning.plan import Plan
from controller.planning.steps import Step

__all__ = [
    "Plan",
    "Prospect",
    "Step",
    "more_inspect",
    "plan_bar_check",
    "plan_coarse_localize",
    "plan_hand_eye",
    "plan_inspect",
    "plan_localize",
    "plan_noise",
    "plan_part_check",
]
