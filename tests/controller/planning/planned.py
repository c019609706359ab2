"""The plans of the example cell's job, for tests."""

from dataclasses import dataclass
from pathlib import Path

from controller.cellfile import Cell
from controller.planning import Plan
from estimation.belief import Belief
from estimation.kinematics import ArmModel

CELL = Path(__file__).parents[3] / "cells" / "bench-block"
SEED = 11


@dataclass(frozen=True, slots=True)
class Planned:
    """Plans of the whole job, each on the belief that the ones before are predicted to leave."""

    cell: Cell
    arm: ArmModel
    plate_prior: Belief
    part_prior: Belief
    plans: dict[str, Plan]


def belief_of(plan: Plan) -> Belief:
    assert plan.belief is not None
    return plan.belief
