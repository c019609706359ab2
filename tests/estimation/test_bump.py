import numpy as np
import pytest

from estimation.belief import Belief
from estimation.bump import BumpTest, bump_distance2, bump_test
from estimation.errors import EstimationError
from estimation.measurement import Chain, Observations
from estimation.solver import update
from tests.estimation import twin, twin_poses

ARM = twin.arm()
# The bar stands where a search has found it, so that the beam meets the caps of its spheres.
SIZES = twin.Sizes(mount_m=0.5e-3, mount_rad=0.2 * twin.DEG, placed_m=0.5e-3, placed_rad=0.1 * twin.DEG)
MM, DEG = 1e-3, twin.DEG
BUMPS = {
    "along its x": [0.5 * MM, 0, 0, 0, 0, 0],
    "along its -y": [0, -0.5 * MM, 0, 0, 0, 0],
    "along its z": [0, 0, 0.5 * MM, 0, 0, 0],
    "about its x": [0, 0, 0, 0.3 * DEG, 0, 0],
    "about its -y": [0, 0, 0, 0, -0.3 * DEG, 0],
}


def calibrated(rng: np.random.Generator) -> tuple[twin.Truth, Belief]:
    truth, q = twin.Truth.drawn(rng, SIZES), twin_poses.plate_poses(240)[:80]
    observed = twin.laser_observations("plate", *twin.noisy(rng, q, truth.plate_readings(q), SIZES), SIZES)
    belief = update(twin.with_plate(twin.laser_belief(SIZES), SIZES), Chain(ARM, [observed])).belief
    return truth, twin.with_bar(belief, SIZES)


def check(rng: np.random.Generator, truth: twin.Truth) -> list[Observations]:
    """Bar spheres from five orientations, and eight of the plate poses again."""
    bar, second = twin_poses.sphere_poses(aside_m=0.005)
    plate = twin_poses.plate_poses(240)[:8]
    joints, readings = twin.noisy(rng, bar, truth.bar_readings(bar, second), SIZES)
    again = twin.noisy(rng, plate, truth.plate_readings(plate), SIZES)
    return [
        twin.laser_observations("bar", joints, readings, SIZES, second),
        twin.laser_observations("plate", *again, SIZES),
    ]


def outcome(seed: int, bump: list[float] | None = None) -> tuple[twin.Truth, Belief, BumpTest]:
    rng = np.random.default_rng(seed)
    truth, belief = calibrated(rng)
    moved = truth if bump is None else truth.bumped(np.array(bump))
    return truth, belief, bump_test(belief, ARM, check(rng, moved), level=0.005)


@pytest.mark.parametrize("words", BUMPS)
def test_a_bump_of_half_a_millimetre_or_0_3_deg_is_caught_and_described(words: str) -> None:
    _, _, result = outcome(1, BUMPS[words])
    assert not result.passed and result.statistic > 2 * result.limit and result.p_value < 1e-6
    assert words in result.words
    assert result.consistent  # all of it is explained by the bump
    off = result.bump - np.array(BUMPS[words])[:5]
    assert off @ np.linalg.solve(result.covariance, off) < 20.5  # chi-square(5), 0.1 %
    assert result.detection_probability(np.array(BUMPS[words])[:5]) > 0.999


def test_honest_cells_pass_as_often_as_the_level_says() -> None:
    statistics, rest = [], []
    for seed in range(100, 140):
        _, _, result = outcome(seed)
        statistics.append(result.statistic)
        rest.append(result.chi2 / result.dof)
        assert result.passed
        assert "no movement" in result.words
    assert np.mean(statistics) == pytest.approx(5, abs=2.6 * np.sqrt(2 * 5 / 40))
    assert np.mean(rest) == pytest.approx(1, abs=2.6 * np.sqrt(2 / 35 / 40))
    assert result.limit == pytest.approx(16.7496, abs=1e-3)


def test_the_true_bump_is_as_far_from_the_best_as_chi_square_says() -> None:
    bump = np.array(BUMPS["along its x"][:5])
    distances2 = []
    for seed in range(200, 240):
        rng = np.random.default_rng(seed)
        truth, belief = calibrated(rng)
        moved = check(rng, truth.bumped(np.append(bump, 0.0)))
        distances2.append(bump_distance2(belief, ARM, moved, bump))
    assert np.mean(distances2) == pytest.approx(5, abs=2.6 * np.sqrt(2 * 5 / 40))


def test_a_check_leaves_the_belief_as_it_was() -> None:
    rng = np.random.default_rng(3)
    truth, belief = calibrated(rng)
    before = belief.digest()
    bump_test(belief, ARM, check(rng, truth))
    assert belief.digest() == before


def test_a_crash_of_5_mm_is_measured_too() -> None:
    rng = np.random.default_rng(4)
    truth, belief = calibrated(rng)
    bump = np.array([1e-3, 0, 5e-3, 0, 0, 0])
    plate = twin_poses.plate_poses(240)[:30]
    moved = truth.bumped(bump)
    observed = twin.laser_observations(
        "plate", *twin.noisy(rng, plate, moved.plate_readings(plate), SIZES), SIZES
    )
    result = bump_test(belief, ARM, [observed])
    assert not result.passed
    assert result.bump[2] == pytest.approx(5e-3, abs=0.5e-3)
    assert result.words.startswith("laser moved by 5.")


def test_a_fault_that_is_no_bump_is_not_called_one() -> None:
    rng = np.random.default_rng(5)
    truth, belief = calibrated(rng)
    bar, plate = check(rng, truth)
    wrong = bar.reading_m.copy()
    wrong[::5] += 1e-3 * (-1) ** np.arange(len(wrong[::5]))
    bar = twin.laser_observations("bar", bar.joints_rad, wrong, SIZES, bar.feature_index)
    assert not bump_test(belief, ARM, [bar, plate]).consistent


def test_five_measurements_are_too_few() -> None:
    rng = np.random.default_rng(6)
    truth, belief = calibrated(rng)
    few = check(rng, truth)[0].select(np.arange(5))
    with pytest.raises(EstimationError, match="5 measurements"):
        bump_test(belief, ARM, [few])
