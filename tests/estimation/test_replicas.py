"""Monte Carlo of a hand-eye, all replicas at once: each ends where a general solver ends."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimation.errors import EstimationError
from estimation.replicas import plane_hand_eye
from estimation.transform import FloatArray
from tests.estimation.laser_plans import LaserPlan, laser_plan


def _residual(plan: LaserPlan, ranges_m: FloatArray, x: FloatArray) -> FloatArray:
    """Of origin, two tilts of the beam, two of the normal, offset: general vectors for axes near z."""
    beam = plan.beam + np.array([*x[3:5], 0.0])
    normal = plan.normal + np.array([*x[5:7], 0.0])
    hits = np.einsum("nij,nj->ni", plan.rotations, x[:3] + ranges_m[:, None] * beam / np.linalg.norm(beam))
    return np.asarray(
        np.sqrt(plan.weights) * ((hits + plan.positions_m) @ (normal / np.linalg.norm(normal)) - x[7])
    )


def _start(plan: LaserPlan) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    turned = plan.beam + np.array([0.02, 0.01, 0.0])
    return plan.origin_m + 2e-3, turned / np.linalg.norm(turned), plan.normal, plan.offset_m + 1e-3


def test_replicas_end_where_a_general_solver_ends() -> None:
    plan = laser_plan(100)
    found = plane_hand_eye(plan.rotations, plan.positions_m, plan.ranges_m, plan.weights, _start(plan))
    deviations = np.sqrt(np.diag(found.covariance))
    for k, ranges in enumerate(plan.ranges_m):
        exact = least_squares(
            lambda x, ranges=ranges: _residual(plan, ranges, x),
            np.array([*plan.origin_m, 0, 0, 0, 0, plan.offset_m]),
            method="lm",
            x_scale=deviations,
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        ).x
        assert np.max(np.abs(found.origin_m[k] - exact[:3]) / deviations[:3]) < 1e-3
        assert abs(found.offset_m[k] - exact[7]) / deviations[7] < 1e-3


def test_scatter_of_replicas_is_the_predicted_one() -> None:
    plan = laser_plan(4000)
    found = plane_hand_eye(plan.rotations, plan.positions_m, plan.ranges_m, plan.weights, _start(plan))
    predicted = np.sqrt(np.diag(found.covariance))[:3]
    assert found.origin_m.std(axis=0) / predicted == pytest.approx(np.ones(3), abs=0.05)


def test_a_plan_without_tilts_is_refused() -> None:
    plan = laser_plan(10)
    same = np.repeat(plan.rotations[:1], 28, axis=0)
    with pytest.raises(EstimationError, match="freedom"):
        plane_hand_eye(same, plan.positions_m, plan.ranges_m, plan.weights, _start(plan))
