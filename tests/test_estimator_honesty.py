"""300 cells at estimator level: planned poses, simulated truth, the real estimator, no wires."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from controller.cellfile import Cell, LocalizePhase, load_cell
from controller.knowledge import first_belief, joint_variance, observations, with_part, with_plate
from controller.planning import plan_coarse_localize, plan_hand_eye
from controller.planning.steps import Step
from controller.samples import Sample
from estimation.measurement import Chain
from estimation.solver import update
from estimation.transform import FloatArray
from simulators.world.truth import Truth, draw_truth, stream
from simulators.world.world import World
from simulators.world.world_file import WorldFile, read_world_file
from tests.support.honesty import Honesty, laser_error, nees, part_error

CELL = Path("cells/bench-block")
SEEDS = range(1001, 1301)
POINTS = 30


class _Standing:
    """The world wants a moving arm; here nothing moves."""

    def joints_at(self, time_s: float) -> FloatArray:
        raise NotImplementedError

    def standstill(self, time_s: float) -> tuple[int, ...] | None:
        return None


def _measure(
    cell: Cell, file: WorldFile, truth: Truth, steps: tuple[Step, ...], name: str
) -> Iterator[Sample]:
    """Samples as the declared noise makes them, of the true surfaces."""
    random = stream(truth.seed, f"test.{name}")
    world = World(file, truth, _Standing())
    joint_std = np.sqrt(joint_variance(cell, cell.robot.readings))
    for step in steps:
        joints = np.array(step.joints_rad)
        true_m = world.beam_length_m(joints, random.standard_normal(2))
        reading_m = (true_m - truth.laser_offset_m) / (1.0 + truth.laser_scale)
        seen = joints + joint_std * random.standard_normal(len(joints))
        good = np.isfinite(true_m)
        yield Sample(
            step=step.id,
            kind=step.kind,
            object=step.object,
            feature=step.feature,
            joints_rad=tuple(seen.tolist()),
            joint_scatter_rad=(0.0,) * len(joints),
            joint_readings=cell.robot.readings,
            reading_m=float(reading_m) if good else 0.0,
            reading_scatter_m=0.0,
            readings=100,
            quality="good" if good else "bad",
            why="",
            source_time_s=0.0,
            utc_s=0.0,
        )


@pytest.fixture(scope="module")
def campaign() -> tuple[Honesty, Honesty]:
    cell, file = load_cell(CELL / "cell.toml"), read_world_file(CELL)
    arm = cell.robot.arm_model()
    start = with_plate(first_belief(cell), cell)
    plate_plan = plan_hand_eye(cell, start, arm, 80, 1)
    plate_steps, predicted = plate_plan.steps, plate_plan.belief
    assert predicted is not None
    (spec,) = (phase for phase in cell.job.phases if isinstance(phase, LocalizePhase))
    part_steps = plan_coarse_localize(cell, with_part(predicted, cell), arm, spec, 1, count=POINTS).steps
    hand_eye, part = [], []
    for seed in SEEDS:
        truth = draw_truth(file, seed)
        samples = [s for s in _measure(cell, file, truth, plate_steps, "plate") if s.good]
        belief = update(start, Chain(arm, observations(cell, samples)), phase="hand-eye").belief
        hand_eye.append(nees(laser_error(belief, truth), belief.block_covariance("laser")))
        samples = [s for s in _measure(cell, file, truth, part_steps, "part") if s.good]
        belief = update(
            with_part(belief, cell), Chain(arm, observations(cell, samples)), phase="localize"
        ).belief
        part.append(nees(part_error(belief, truth), belief.block_covariance("part")))
    return Honesty(5, np.array(hand_eye)), Honesty(6, np.array(part))


@pytest.mark.parametrize("which", [0, 1], ids=["hand-eye", "part"])
def test_the_95_percent_region_holds_the_truth_as_often_as_it_says(
    campaign: tuple[Honesty, Honesty], which: int, record_property: Callable[[str, object], None]
) -> None:
    honesty = campaign[which]
    low, high = honesty.band(0.99)
    record_property(f"estimator alone, {('hand-eye', 'part')[which]}", str(honesty))
    assert 273 <= honesty.inside <= 294
    assert low <= honesty.mean_over_dimension <= high
