import numpy as np
import pytest

from estimation.errors import EstimationError
from estimation.fitting import Robust
from estimation.measurement import Chain, Observations, object_point_jacobian
from estimation.solver import update
from estimation.transform import FloatArray
from tests.estimation import twin, twin_poses

ARM = twin.arm()
CORNERS = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.15) for z in (0, 0.1)])
KNOWN = twin.Sizes(mount_m=0.0, mount_rad=0.0, scale=0.0, offset_m=0.0, form_m=0.0)
ROWS = 26


def localization(seed: int, outliers: dict[int, float]) -> tuple[Observations, FloatArray]:
    """26 points on a part, some of them wrong by metres, and the true corners."""
    rng = np.random.default_rng(seed)
    truth, (q, face) = twin.Truth.drawn(rng, KNOWN), twin_poses.part_poses(30)
    q, face = q[:ROWS], face[:ROWS]
    truth = twin.Truth(**{**vars(truth), "kinematics": np.zeros(18)})
    joints, readings = twin.noisy(rng, q, truth.part_readings(q, face), KNOWN)
    for row, error_m in outliers.items():
        readings[row] += error_m
    pose = twin.pose(np.array([*twin.PART_M, 0, 0, 0])) @ twin.pose(truth.part)
    features = twin.face_features(form=False)
    observed = twin.laser_observations("part", joints, readings, KNOWN, face, features)
    return observed, CORNERS @ pose[:3, :3].T + pose[:3, 3]


def corner_error(observed: Observations, corners: FloatArray, **options: object) -> float:
    prior = twin.with_part(twin.laser_belief(KNOWN, kinematics=False), KNOWN, form=False)
    result = update(prior, Chain(ARM, [observed]), **options)  # type: ignore[arg-type]
    points = object_point_jacobian(result.belief, "part", CORNERS).points_m
    return float(np.linalg.norm(points - corners, axis=1).max())


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_row_19_one_outlier_of_5_mm_among_26_costs_next_to_nothing(robust: Robust) -> None:
    ratios, without = [], []
    for seed in range(200):
        clean = corner_error(*localization(seed, {}))
        spoilt = localization(seed, {seed % ROWS: 5e-3 * (-1) ** seed})
        ratios.append(corner_error(*spoilt, robust=robust, reject_level=0.01) / clean)
        if seed < 20:
            without.append(corner_error(*spoilt) / clean)
    assert np.median(ratios) < 1.2
    assert np.median(without) > 5


def test_two_outliers_that_hide_each_other_are_found_and_named_by_row() -> None:
    observed, _ = localization(3, {4: 5e-3, 9: 5e-3})
    prior = twin.with_part(twin.laser_belief(KNOWN, kinematics=False), KNOWN, form=False)
    result = update(prior, Chain(ARM, [observed]), robust="cauchy", reject_level=0.01)
    assert np.flatnonzero(result.rejected).tolist() == [4, 9]
    assert (np.abs(result.standardised[[4, 9]]) > 20).all()
    assert (np.abs(result.standardised[~result.rejected]) < 4).all()
    assert (result.leverage[[4, 9]] == 0).all() and result.dof == ROWS - 2
    assert result.p_value > 0.001


def test_honest_data_lose_no_row() -> None:
    prior = twin.with_part(twin.laser_belief(KNOWN, kinematics=False), KNOWN, form=False)
    rejected = 0
    for seed in range(50):
        observed, _ = localization(seed, {})
        gated = update(prior, Chain(ARM, [observed]), robust="huber", reject_level=0.01)
        rejected += int(gated.rejected.any())
        if not gated.rejected.any():
            plain = update(prior, Chain(ARM, [observed]))
            assert gated.chi2 == pytest.approx(plain.chi2, rel=1e-9)
    assert rejected <= 3


def test_more_than_a_tenth_of_contradictions_is_no_result() -> None:
    observed, _ = localization(5, {1: 5e-3, 5: -4e-3, 8: 6e-3, 20: -5e-3})
    prior = twin.with_part(twin.laser_belief(KNOWN, kinematics=False), KNOWN, form=False)
    for robust in ("none", "cauchy"):
        with pytest.raises(EstimationError, match="More than 2 of 26"):
            update(prior, Chain(ARM, [observed]), robust=robust, reject_level=0.01)
