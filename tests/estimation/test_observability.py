import numpy as np
import pytest

from estimation.belief import Belief
from estimation.errors import DegenerateGeometry
from estimation.measurement import Chain
from estimation.observability import RankReport, rank_report, spectrum_of
from estimation.solver import update
from estimation.transform import FloatArray, Transform
from tests.estimation import twin, twin_poses

ARM = twin.arm()
SIZES = twin.Sizes()
HAND_EYE = ("laser", "plate")


def laser_plane(q: FloatArray, belief: Belief | None = None) -> RankReport:
    prior = twin.with_plate(twin.laser_belief(SIZES), SIZES) if belief is None else belief
    readings = twin.Truth.drawn(np.random.default_rng(0), SIZES.times(0.0)).plate_readings(q)
    observed = twin.laser_observations("plate", q, readings, SIZES)
    report = update(prior, Chain(ARM, [observed]), targets=HAND_EYE).rank
    assert report is not None
    return report


def same_orientation(count: int) -> FloatArray:
    """Joints with the tool tilted by 15 deg, always in the same direction, all over the plate."""
    rng = np.random.default_rng(1)
    more = 4 * count
    point = np.column_stack([rng.uniform(-0.1, 0.1, (more, 2)), np.zeros(more)]) + twin.PLATE_M
    up, still = np.tile([0.0, 0.0, 1.0], (more, 1)), np.zeros(more)
    q, good = twin_poses.joints_for(
        twin_poses.aimed(point, up, rng.uniform(0.06, 0.11, more), still + 15 * twin.DEG, still, still)
    )
    return q[good][:count]


def test_row_13_rank_8_of_8_parameters_with_varied_poses() -> None:
    report = laser_plane(twin_poses.plate_poses(240)[:20])
    assert (report.rank, report.unknowns) == (8, 8)
    assert report.complete and not report.missing and not report.held_by_prior
    report.require()


def test_row_13_rank_8_of_9_parameters_because_the_beam_may_turn_unseen() -> None:
    belief = twin.laser_belief(SIZES)
    mount = belief.transform("laser")
    belief = twin.with_plate(belief.without(["laser"]).with_block("laser", mount, std=1e-3), SIZES)
    report = laser_plane(twin_poses.plate_poses(240)[:20], belief)
    assert (report.rank, report.unknowns) == (8, 9)
    assert [direction.words for direction in report.missing] == [
        "rotation of the laser about z is not seen by the measurements"
    ]


@pytest.mark.parametrize("settling_rad", [0.0, 5e-6, 5e-5])
def test_row_13_rank_4_of_8_at_constant_orientation_and_the_remedy(settling_rad: float) -> None:
    q = same_orientation(20)
    q = q + np.random.default_rng(2).normal(size=q.shape) * settling_rad
    report = laser_plane(q)
    assert report.rank == 4
    words = " | ".join(direction.words for direction in report.missing)
    assert "translation of the plate along z" in words and "cannot be told apart" in words
    with pytest.raises(DegenerateGeometry, match="Rank 4 of 8") as refused:
        report.require()
    assert refused.value.remedy.startswith("Tilt the tool by 20 deg or more")
    assert report.held_by_prior  # they have a variance, but it is the prior's


def test_a_part_seen_from_above_only_names_the_faces_that_are_missing() -> None:
    q, face = twin_poses.part_poses(60)
    q, face = q[face == 0], face[face == 0]
    readings = twin.Truth.drawn(np.random.default_rng(0), SIZES.times(0.0)).part_readings(q, face)
    prior = twin.with_part(twin.laser_belief(SIZES), SIZES)
    observed = twin.laser_observations("part", q, readings, SIZES, face)
    report = update(prior, Chain(ARM, [observed]), targets=("part",)).rank
    assert report is not None and (report.rank, report.unknowns) == (3, 6)
    words = [direction.words for direction in report.missing]
    assert "translation of the part along x is not seen by the measurements" in words
    assert "Measure a surface of the part whose normal points along its x" in [
        d.remedy for d in report.missing
    ]
    assert {d.components[0][0] for d in report.missing} == {"part.tx", "part.ty", "part.rz"}


def test_the_rank_does_not_depend_on_units() -> None:
    """Millimetres or metres: a laser 1000 times smaller and nearer has the same singular values."""
    belief = Belief().with_block("laser", Transform("flange", "laser", np.eye(4)), std=1e-3)
    belief = belief.with_block("plate", Transform("base", "plate", np.eye(4)), std=1e-3)
    columns = belief.columns(HAND_EYE)
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(20, 12))
    jacobian[:, 11] = jacobian[:, 10] * 2
    small = jacobian * np.where(np.arange(12) % 6 < 3, 1.0, 1e-6)
    one = rank_report(belief, belief, spectrum_of(belief, jacobian, np.ones(20), columns))
    other = rank_report(belief, belief, spectrum_of(belief, small, np.full(20, 1e-12), columns))
    assert one.rank == other.rank == 11
    assert one.singular_values == pytest.approx(other.singular_values, rel=1e-9, abs=1e-12)
    assert one.missing[0].words == other.missing[0].words


def test_fewer_measurements_than_unknowns_are_missing_directions_too() -> None:
    report = laser_plane(twin_poses.plate_poses(240)[:5])
    assert report.rank <= 5 and len(report.missing) == 8 - report.rank
