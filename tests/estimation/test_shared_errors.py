"""Errors that all measurements of a phase share do not average out, whichever way they are treated."""

import numpy as np
import pytest

from estimation.belief import Belief
from estimation.measurement import Chain, Observations, object_point_jacobian
from estimation.solver import predicted_belief, update
from estimation.transform import FloatArray, Transform
from tests.estimation import twin, twin_poses

ARM = twin.arm()
CORNERS = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.15) for z in (0, 0.1)])
# The hand-eye error is far above the noise of a row.
SIZES = twin.Sizes(
    joint_rad=1e-9, range_m=1e-6, mount_m=1e-4, mount_rad=1e-4, scale=0.0, offset_m=0.0, form_m=0.0
)
HAND_EYE = ("laser",)


def prior() -> Belief:
    return twin.with_part(twin.laser_belief(SIZES, kinematics=False), SIZES, form=False)


def repeated(times: int, readings: FloatArray | None = None) -> Observations:
    q, face = twin_poses.part_poses(30)
    q, face = np.tile(q[:26], (times, 1)), np.tile(face[:26], times)
    nominal = twin.Truth.drawn(np.random.default_rng(0), SIZES.times(0.0))
    values = nominal.part_readings(q, face) if readings is None else readings
    return twin.laser_observations("part", q, values, SIZES, face, twin.face_features(form=False))


def largest_std(belief: Belief) -> float:
    covariance = object_point_jacobian(belief, "part", CORNERS).covariance(belief)
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1].max()))


def test_row_14_repeating_26_points_does_not_beat_a_shared_hand_eye_error() -> None:
    stds = [
        largest_std(update(prior(), Chain(ARM, [repeated(times)]), consider=HAND_EYE).belief)
        for times in (1, 10, 100)
    ]
    assert stds == pytest.approx([stds[0]] * 3, rel=0.01)
    assert stds[0] > 50e-6  # of the size of the hand-eye error, not of the noise


def test_row_14_estimated_jointly_the_floor_is_that_of_what_the_poses_cannot_see() -> None:
    """At one orientation of the tool, a shift of the laser is a shift of the part: estimating cannot help."""
    q = np.tile(twin.START_RAD, (26, 1))
    q[:, 0] = np.linspace(0, 1e-4, 26)
    shift = twin.Sizes(**{**vars(SIZES), "mount_rad": 0.0})
    stds = []
    for times in (1, 10, 100):
        belief = twin.laser_belief(shift, kinematics=False)
        place = Transform("base", "part", twin.pose(np.array([0.0, 0, 0.05, 0, 0, 0])))
        belief = belief.with_block("part", place, std=1.0, freedoms=("tz",))
        top = twin.face_features(form=False)[:1]
        observed = twin.laser_observations(
            "part", np.tile(q, (times, 1)), np.full(26 * times, 0.08), shift, None, top
        )
        stds.append(float(predicted_belief(belief, Chain(ARM, [observed])).std("part")[0]))
    assert stds == pytest.approx([1e-4] * 3, rel=0.01)


def test_row_15_consider_covariance_is_that_of_monte_carlo_with_one_hand_eye_draw_a_run() -> None:
    rng = np.random.default_rng(3)
    q, face = twin_poses.part_poses(30)
    q, face = q[:26], face[:26]
    noisy = twin.Sizes(**{**vars(SIZES), "joint_rad": 0.0015 * twin.DEG, "range_m": 0.03e-3})
    truths = twin.Truth.drawn(rng, noisy, 600)
    truths = twin.Truth(**{**vars(truths), "kinematics": np.zeros((600, 18))})
    joints, readings = twin.noisy(rng, q, truths.part_readings(q, face), noisy)
    belief = twin.with_part(twin.laser_belief(noisy, kinematics=False), noisy, form=False)
    features = twin.face_features(form=False)
    misses, variances, chi2 = [], [], []
    for run in range(600):
        observed = twin.laser_observations("part", joints[run], readings[run], noisy, face, features)
        result = update(belief, Chain(ARM, [observed]), consider=HAND_EYE)
        actual = twin.pose(np.array([*twin.PART_M, 0, 0, 0])) @ twin.pose(truths.part[run])
        points = object_point_jacobian(result.belief, "part", CORNERS)
        misses.append(points.points_m - (CORNERS @ actual[:3, :3].T + actual[:3, 3]))
        variances.append(np.diagonal(points.covariance(result.belief), axis1=1, axis2=2))
        chi2.append(result.chi2)
        assert np.array_equal(result.belief.transform("laser").matrix, belief.transform("laser").matrix)
    claimed = np.sqrt(np.mean(variances, axis=0))
    assert np.sqrt(np.mean(np.square(misses), axis=0)) == pytest.approx(claimed, rel=0.08)
    # The test of the residuals knows the shared error too: tested against Q alone most runs would fail.
    assert np.mean(chi2) == pytest.approx(26, abs=2.576 * np.sqrt(2 * 26 / 600))


def test_joint_treatment_is_never_worse_than_consider() -> None:
    joint = largest_std(update(prior(), Chain(ARM, [repeated(1)])).belief)
    considered = largest_std(update(prior(), Chain(ARM, [repeated(1)]), consider=HAND_EYE).belief)
    assert joint <= considered * (1 + 1e-9)
