"""Variance components: are the sources of scatter found, and is their uncertainty honest?"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from estimation.errors import DegenerateGeometry, EstimationError
from estimation.noise.components import Scatter, VarianceComponents, variance_components
from tests.estimation import twin

FloatArray = NDArray[np.float64]
NAMES = tuple(f"joint {j + 1}" for j in range(6))
TRUE_RAD = np.array([1.5, 1.5, 1.5, 1.5, 1.5, 1.5]) * 1e-3 * twin.DEG
REPEATS = 12


def poses(count: int, seed: int = 1) -> FloatArray:
    """Joint angles all over the range of the arm."""
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (count, 6))


def cofactors(joints: FloatArray, tool_m: float = 0.1) -> FloatArray:
    """What unit variance of each joint does to the place of a tool 100 mm off the flange: (n, 6, 3, 3)."""
    twists = twin.arm().jacobians(joints)[1]
    lever = twists[:, :3] + np.cross(twists[:, 3:].swapaxes(1, 2), [tool_m, 0.0, tool_m]).swapaxes(1, 2)
    return np.einsum("nij,nkj->njik", lever, lever)


def draw(std: FloatArray, seed: int, joints: FloatArray, repeats: int = REPEATS) -> Scatter:
    """Repeated places of the tool, with independent joint noise."""
    random = np.random.default_rng(seed)
    twists = twin.arm().jacobians(joints)[1]
    lever = twists[:, :3] + np.cross(twists[:, 3:].swapaxes(1, 2), [0.1, 0.0, 0.1]).swapaxes(1, 2)
    noise = std * random.standard_normal((len(joints), repeats, 6))
    return Scatter.of_repeats(list(np.einsum("nij,nrj->nri", lever, noise)))


@pytest.fixture(scope="module")
def fits() -> list[VarianceComponents]:
    joints = poses(40)
    return [
        variance_components(draw(TRUE_RAD, seed, joints), cofactors(joints), NAMES) for seed in range(200)
    ]


def test_estimates_are_unbiased_and_as_uncertain_as_they_say(fits: list[VarianceComponents]) -> None:
    variance, u = (np.array([getattr(fit, name) for fit in fits]) for name in ("variance", "u"))
    well_seen = u.mean(axis=0) < 0.3 * TRUE_RAD**2  # the others are bounded by zero, hence skew
    assert well_seen.sum() >= 4
    error = ((variance - TRUE_RAD**2) / u.mean(axis=0))[:, well_seen]
    assert np.abs(error.mean(axis=0)).max() < 0.25  # 3.5 standard deviations of a mean of 200
    assert np.abs(error.std(axis=0) - 1.0).max() < 0.15


def test_an_honest_arm_has_no_noisy_joint(fits: list[VarianceComponents]) -> None:
    named = sum(bool(fit.noisier_than(TRUE_RAD, level=0.01)) for fit in fits)
    assert named <= 8  # 2 of 200 on average


def test_the_noisy_joint_is_named() -> None:
    joints, noisy = poses(40), TRUE_RAD * np.array([1, 1, 1, 3, 1, 1])
    for seed in range(20):
        fit = variance_components(draw(noisy, seed, joints), cofactors(joints), NAMES)
        assert fit.noisier_than(TRUE_RAD)[0] == "joint 4"


def test_the_likelihood_is_that_of_scipy_and_its_maximum_is_found() -> None:
    """One range per pose: the density of the repeats about their mean is known to scipy as well."""
    joints = poses(30)
    random = np.random.default_rng(5)
    k = np.linalg.norm(twin.arm().jacobians(joints)[1][:, :3], axis=1)[:, :2]
    q = np.concatenate([k**2, np.ones((30, 1))], axis=1)
    true = np.array([1.0, 4.0, 0.5])
    residuals = np.sqrt(q @ true)[:, None] * random.standard_normal((30, 8))
    scatter = Scatter.of_repeats(list(residuals))
    fit = variance_components(scatter, q[:, :, None, None], ("a", "b", "range"))

    def minus(logs: FloatArray) -> float:
        variance = q @ np.exp(logs)
        basis = np.linalg.qr(np.eye(8) - 1 / 8)[0][:, :7]  # contrasts: the mean is taken off
        return -sum(
            float(multivariate_normal.logpdf(r @ basis, cov=v * np.eye(7)))
            for r, v in zip(residuals, variance, strict=True)
        )

    found = minimize(minus, np.log(true), method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-10})
    assert fit.variance == pytest.approx(np.exp(found.x), rel=1e-4)


def test_a_source_that_is_not_there_is_held_at_zero_and_says_so() -> None:
    joints = poses(40)
    silent = TRUE_RAD * np.array([1, 1, 0, 1, 1, 1])
    fits = [variance_components(draw(silent, seed, joints), cofactors(joints), NAMES) for seed in range(10)]
    assert any(fit.clamped[2] for fit in fits)
    for fit in fits:
        assert (fit.variance >= 0.0).all() and (fit.u > 0.0).all()
        assert fit.variance[2] < 3.0 * fit.u[2]
        assert fit.clamped[2] == (fit.variance[2] == 0.0)


def test_units_do_not_matter() -> None:
    joints = poses(40)
    scatter, q = draw(TRUE_RAD, 3, joints), cofactors(joints)
    in_mm = Scatter(scatter.covariance * 1e6, scatter.dof)
    metres, mm = variance_components(scatter, q, NAMES), variance_components(in_mm, q * 1e6, NAMES)
    assert metres.variance == pytest.approx(mm.variance, rel=1e-6)


def test_sources_that_act_alike_are_refused_by_name() -> None:
    joints = poses(40)
    q = cofactors(joints)
    q[:, 1] = 2.0 * q[:, 0]
    with pytest.raises(DegenerateGeometry, match=r"joint 1 and joint 2|joint 2 and joint 1"):
        variance_components(draw(TRUE_RAD, 1, joints), q, NAMES)


def test_a_source_that_nothing_feels_is_refused() -> None:
    joints = poses(10)
    q = cofactors(joints)
    q[:, 5] = 0.0
    with pytest.raises(DegenerateGeometry, match="feels joint 6"):
        variance_components(draw(TRUE_RAD, 1, joints), q, NAMES)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([np.zeros((5, 3)), np.zeros((1, 3))], "Pose 2 was measured once"),
        ([], "No repeated measurements"),
        ([np.full((5, 3), np.nan)], "not finite"),
    ],
)
def test_what_is_no_repetition_is_refused(values: list[FloatArray], message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        Scatter.of_repeats(values)


def test_a_frozen_device_is_refused() -> None:
    joints = poses(10)
    with pytest.raises(EstimationError, match="do not scatter at all"):
        variance_components(Scatter(np.zeros((10, 3, 3)), np.full(10, 5.0)), cofactors(joints), NAMES)
