"""An inspection that cannot decide takes more touches where they help, and none where they do not."""

from collections.abc import Iterator

import pytest

from controller.cellfile import Cell
from controller.cellfile.job import InspectPhase as InspectSpec
from controller.gates import Verdict
from controller.phases.base import Finding, PhaseContext
from controller.phases.inspect import InspectPhase
from controller.planning.steps import Step
from tests.support.deterministic import DeterministicCell

PHASE = "inspect"
C4 = 3  # position of the boss


@pytest.fixture(scope="module")
def inspected() -> Iterator[DeterministicCell]:
    """A whole job of seed 1, all of it decided."""
    cell = DeterministicCell(1)
    cell.run()
    yield cell
    cell.close()


def further(inspected: DeterministicCell, tolerance_m: float, most_measurements: int = 200) -> list[Step]:
    """What the phase would add if the boss had this tolerance."""
    run = inspected.store.runs(1)[0].id
    plan = inspected.store.plan(run, PHASE, 1)
    assert plan is not None
    steps = [Step.from_dict(step) for step in plan.plan["steps"]]
    cell = with_tolerance(inspected.cell, tolerance_m)
    spec = cell.job.phases[-1]
    assert isinstance(spec, InspectSpec)
    spec = spec.model_copy(update={"most_measurements": most_measurements})
    belief = inspected.belief(PHASE)
    context = PhaseContext(cell, spec, cell.robot.arm_model(), belief)
    return list(InspectPhase().extend(context, steps, (), Finding(Verdict((), ""), belief, {})))


def with_tolerance(cell: Cell, tolerance_m: float) -> Cell:
    items = list(cell.part.characteristics)
    items[C4] = items[C4].model_copy(update={"tolerance_m": tolerance_m})
    part = cell.part.model_copy(update={"characteristics": tuple(items)})
    return cell.model_copy(update={"part": part})


def boss(inspected: DeterministicCell) -> tuple[float, float]:
    """Position of the boss as found, and its standard uncertainty, metres."""
    row = inspected.results()[PHASE].result["estimate"]["characteristics"][C4]
    return row["value_m"], row["u_m"]


def test_an_open_characteristic_gets_touches_on_its_feature_and_its_datums(
    inspected: DeterministicCell,
) -> None:
    value_m, u_m = boss(inspected)
    added = further(inspected, value_m + 1.55 * u_m)  # 1.645 would prove it
    assert {step.feature for step in added} == {"boss", "top", "left", "front"}
    run = inspected.store.runs(1)[0].id
    plan = inspected.store.plan(run, PHASE, 1)
    assert plan is not None
    before = {tuple(step["object_p_m"]) for step in plan.plan["steps"]}
    assert not before & {step.object_p_m for step in added}


def test_nothing_is_added_when_all_is_decided_or_nothing_can_decide(inspected: DeterministicCell) -> None:
    value_m, u_m = boss(inspected)
    assert further(inspected, value_m + 3.0 * u_m) == []
    assert further(inspected, value_m) == []  # on its limit: no number of touches tells
    assert further(inspected, value_m + 1.55 * u_m, most_measurements=45) == []
