"""Joint noise at poses never measured: does the predicted interval hold what is found there?"""

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.errors import EstimationError
from estimation.noise.prediction import PoseNoiseModel

FloatArray = NDArray[np.float64]
DOF, POSES = 29, 60


def true_std(joints: FloatArray) -> FloatArray:
    """Joint 1 is alike everywhere; joint 2 is noisier the farther the arm reaches out; rad."""
    reach = np.abs(np.cos(joints[:, 1]) + np.cos(joints[:, 1] + joints[:, 2]))
    return 2.6e-5 * np.column_stack([np.ones(len(joints)), 0.6 + 0.9 * reach])


def draw(seed: int, count: int = POSES) -> tuple[FloatArray, FloatArray]:
    """Poses and sample variances."""
    random = np.random.default_rng(seed)
    joints = np.column_stack(
        [
            random.uniform(-0.3, 0.3, count),
            random.uniform(-1.5, 1.5, (count, 2)).T[0],
            random.uniform(-1.5, 1.5, count),
        ]
    )
    return joints, true_std(joints) ** 2 * random.chisquare(DOF, (count, 2)) / DOF


def test_the_interval_holds_the_noise_of_poses_never_measured() -> None:
    inside, relative = [], []
    for seed in range(20):
        model = PoseNoiseModel.fit(*draw(seed), np.full(POSES, float(DOF)))
        joints, _ = draw(1000 + seed, 200)
        low, high = model.predict(joints).interval()
        truth = true_std(joints)
        inside.append((low <= truth) & (truth <= high))
        relative.append(np.log(model.predict(joints).variance / truth**2))
    share = np.mean(inside, axis=(0, 1))
    assert share[0] > 0.9 and 0.9 < share[1] < 0.995
    assert np.std(np.array(relative)[..., 1]) < 0.5 * np.std(np.log(true_std(draw(1, 2000)[0])[:, 1] ** 2))


def test_a_joint_that_is_alike_everywhere_is_known_better_than_from_any_single_pose() -> None:
    model = PoseNoiseModel.fit(*draw(3), np.full(POSES, float(DOF)))
    assert model.predict(draw(4, 50)[0]).dof[:, 0].min() > 3 * DOF


def test_far_from_all_poses_the_model_says_that_it_does_not_know() -> None:
    model = PoseNoiseModel.fit(*draw(3), np.full(POSES, float(DOF)))
    near = model.predict(draw(4, 50)[0]).log_std[:, 1]
    far = model.predict(np.array([[30.0, 30.0, 30.0]])).log_std[0, 1]
    assert far > 2 * near.mean()
    assert far >= model.amplitude[1]


def test_degrees_of_freedom_are_those_of_an_equally_uncertain_sample_variance() -> None:
    model = PoseNoiseModel.fit(*draw(3), np.full(POSES, float(DOF)))
    prediction = model.predict(draw(4, 5)[0])
    random = np.random.default_rng(0)
    drawn = np.log(random.chisquare(prediction.dof[0, 1], 200_000) / prediction.dof[0, 1])
    assert drawn.std() == pytest.approx(prediction.log_std[0, 1], rel=0.02)


@pytest.mark.parametrize(
    ("joints", "variance", "dof", "message"),
    [
        (np.zeros((5, 2)), np.ones((5, 2)), np.full(5, 9.0), "8 poses"),
        (np.zeros((9, 2)), np.ones((9, 2)), np.full(9, 2.0), "at least 4 times"),
        (np.zeros((9, 2)), np.zeros((9, 2)), np.full(9, 9.0), "does not scatter"),
        (np.full((9, 2), np.nan), np.ones((9, 2)), np.full(9, 9.0), "not finite"),
    ],
)
def test_too_little_is_refused(
    joints: FloatArray, variance: FloatArray, dof: FloatArray, message: str
) -> None:
    with pytest.raises(EstimationError, match=message):
        PoseNoiseModel.fit(joints, variance, dof)
