"""Unknowns without a prior, and vector observations with a full covariance, against textbook formulas."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from estimation.belief import Belief, Value
from estimation.chart import prior_rows, square_root
from estimation.errors import DegenerateGeometry, EstimationError
from estimation.model import Rows, pose_of, vector_of
from estimation.observability import spectrum_of
from estimation.solver import predict, predicted_belief, update
from estimation.transform import FloatArray, Transform, skew

SIGMA_M = 1e-4


@dataclass(frozen=True)
class Line:
    """Heights a + b x + c x^2 with independent noise: the textbook."""

    x: FloatArray
    y: FloatArray

    def __len__(self) -> int:
        return len(self.x)

    def weighed_at(self, values: Mapping[str, Value]) -> "Line":
        return self

    def rows(self, values: Mapping[str, Value]) -> Rows:
        line, bend = vector_of(values, "line", 2), vector_of(values, "bend", 1)
        residual = self.y - line[0] - line[1] * self.x - bend[0] * self.x**2
        jacobian = {
            "line": -np.column_stack([np.ones_like(self.x), self.x]),
            "bend": -(self.x**2)[:, None],
        }
        return Rows(residual, jacobian, {"noise": np.full(len(self.x), SIGMA_M**2)})


def line_belief(bend_std: float = 1e-3) -> Belief:
    belief = Belief().with_block("line", [0.0, 0.0], std=np.inf, freedoms=("height", "slope"))
    return belief.with_block("bend", 0.0, std=bend_std)


def drawn_line(seed: int = 1, count: int = 12) -> Line:
    rng = np.random.default_rng(seed)
    x = np.linspace(-1, 1, count)
    return Line(x, 0.3 + 0.2 * x + rng.normal(size=count) * SIGMA_M)


def test_flat_unknowns_come_from_the_data_and_the_prior_of_the_others() -> None:
    line = drawn_line()
    result = update(line_belief(), line)
    design = np.column_stack([np.ones(12), line.x, line.x**2]) / SIGMA_M
    normal = design.T @ design + np.diag([0, 0, 1e6])
    expected = np.linalg.solve(normal, design.T @ line.y / SIGMA_M)
    assert result.belief.vector("line") == pytest.approx(expected[:2], abs=1e-9)
    assert result.belief.scalar("bend") == pytest.approx(expected[2], abs=1e-9)
    assert result.belief.covariance == pytest.approx(np.linalg.inv(normal), rel=1e-8)
    assert set(result.belief.contributions) == {"bend", "noise"}
    residual = line.y / SIGMA_M - design @ expected
    assert result.chi2 == pytest.approx(residual @ residual + 1e6 * expected[2] ** 2)
    assert result.dof == 10
    assert not result.belief.flat.any()
    assert result.rank is not None
    assert result.rank.complete
    assert result.consistency().passed


def test_the_result_does_not_depend_on_where_a_flat_unknown_starts() -> None:
    line = drawn_line()
    one = update(line_belief(), line).belief
    other = update(line_belief().started({"line": np.array([5.0, -7.0])}), line).belief
    assert one.vector("line") == pytest.approx(other.vector("line"), abs=1e-9)
    with pytest.raises(EstimationError, match="'bend' has a prior"):
        line_belief().started({"bend": np.zeros(1)})


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_outliers_are_found_from_a_flat_start_far_away(robust: str) -> None:
    line = drawn_line(count=30)
    spoiled = replace(line, y=line.y + np.where(np.isin(np.arange(30), [3, 17, 18]), 0.01, 0.0))
    belief = line_belief().started({"line": np.array([2.0, -1.0])})
    result = update(belief, spoiled, robust=robust, reject_level=0.01)  # type: ignore[arg-type]
    assert np.flatnonzero(result.rejected).tolist() == [3, 17, 18]
    assert result.dof == 25


def test_what_the_data_leave_open_is_refused_in_words() -> None:
    with pytest.raises(DegenerateGeometry, match="height of line and slope of line cannot be told apart"):
        update(line_belief(), Line(np.ones(5), np.ones(5)))
    with pytest.raises(DegenerateGeometry, match="Rank 1 of 2"):
        predicted_belief(line_belief(), Line(np.ones(1), np.ones(1)))


def test_a_flat_belief_has_no_covariance_and_predicts_nothing() -> None:
    with pytest.raises(EstimationError, match=r"Nothing is known yet of line\.height, line\.slope"):
        _ = line_belief().covariance
    with pytest.raises(EstimationError, match="Nothing is known yet"):
        predict(line_belief(), drawn_line())
    restored = Belief.from_dict(line_belief().to_dict())
    assert restored.flat.tolist() == [True, True, False]
    assert restored.digest() == line_belief().digest()


def test_without_redundancy_residuals_give_no_covariance() -> None:
    line = drawn_line(count=2)
    exact = update(line_belief(bend_std=0.0), line)
    assert exact.dof == 0
    assert exact.chi2 == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(EstimationError, match="residuals say nothing of the noise"):
        exact.residual_based()
    with pytest.raises(EstimationError, match="0 degrees of freedom"):
        exact.consistency()
    more = update(line_belief(bend_std=0.0), drawn_line(count=20))
    scaled = more.residual_based().covariance
    assert scaled == pytest.approx(more.variance_factor * more.belief.covariance)


@dataclass(frozen=True)
class Points:
    """Points of a body seen in space, each with the same full covariance."""

    body_p: FloatArray  # (k, 3)
    seen_p: FloatArray  # (k, 3)
    covariance: FloatArray  # (3, 3), in space

    def __len__(self) -> int:
        return self.body_p.size

    def weighed_at(self, values: Mapping[str, Value]) -> "Points":
        return self

    def rows(self, values: Mapping[str, Value]) -> Rows:
        pose = pose_of(values, "body")
        whitener = SIGMA_M * np.linalg.inv(np.linalg.cholesky(self.covariance))
        residual = (self.seen_p - pose.points(self.body_p)) @ whitener.T
        moved = pose.rotation @ np.concatenate(
            [np.broadcast_to(np.eye(3), (len(self.body_p), 3, 3)), -skew(self.body_p)], axis=2
        )
        jacobian = -(whitener @ moved).reshape(-1, 6)
        variance = np.full(residual.size, SIGMA_M**2)
        return Rows(residual.reshape(-1), {"body": jacobian}, {"camera": variance}, group=3)


def drawn_points(seed: int, count: int = 20) -> tuple[Transform, Points]:
    rng = np.random.default_rng(seed)
    truth = Transform("space", "body", np.eye(4)).perturbed(rng.normal(size=6))
    root = np.diag([1e-4, 2e-4, 1e-3]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    body_p = rng.uniform(-0.2, 0.2, size=(count, 3))
    seen_p = truth.points(body_p) + rng.normal(size=(count, 3)) @ root
    return truth, Points(body_p, seen_p, root.T @ root)


def test_poses_from_points_with_full_noise_have_the_error_that_they_claim() -> None:
    nees = []
    for seed in range(200):
        truth, points = drawn_points(seed)
        start = Belief().with_block("body", Transform("space", "body", np.eye(4)), std=np.inf)
        result = update(start, points)
        gap = np.linalg.inv(result.belief.transform("body").matrix) @ truth.matrix
        xi = np.concatenate([gap[:3, 3], [gap[2, 1], gap[0, 2], gap[1, 0]]])
        nees.append(xi @ np.linalg.solve(result.belief.covariance, xi))
        assert result.dof == 54
    assert 5.4 < np.mean(nees) < 6.6  # 2.5 standard deviations of the mean of 200 chi-square(6)


def test_a_point_is_rejected_as_a_whole() -> None:
    truth, points = drawn_points(1)
    seen_p = points.seen_p.copy()
    seen_p[7] += 20 * truth.rotation[:, 0] * 1e-3
    start = Belief().with_block("body", Transform("space", "body", np.eye(4)), std=np.inf)
    result = update(start, replace(points, seen_p=seen_p), robust="cauchy", reject_level=0.01)
    assert np.flatnonzero(result.rejected).tolist() == [21, 22, 23]


def test_a_flat_block_may_come_after_blocks_with_a_prior() -> None:
    belief = (
        Belief().with_block("known", np.zeros(3), std=[1.0, 2.0, 3.0]).with_block("free", 0.0, std=np.inf)
    )
    root = square_root(belief.prior_covariance)
    weight = prior_rows(belief, root)
    assert weight.tolist() == [1, 1, 1, 0]
    assert root @ np.diag(weight) @ root.T == pytest.approx(np.diag([1.0, 4.0, 9.0, 0.0]))
    assert root[:3, 3] == pytest.approx(np.zeros(3)) and root[3] == pytest.approx([0, 0, 0, 1])


@dataclass(frozen=True)
class Known:
    """Residuals of what holds no unknown."""

    residual_m: FloatArray

    def __len__(self) -> int:
        return len(self.residual_m)

    def weighed_at(self, values: Mapping[str, Value]) -> "Known":
        return self

    def rows(self, values: Mapping[str, Value]) -> Rows:
        return Rows(self.residual_m, {}, {"noise": np.full(len(self.residual_m), SIGMA_M**2)})


def test_without_unknowns_there_is_still_a_chi_square() -> None:
    residual = SIGMA_M * np.array([1.0, -2.0, 0.5])
    result = update(Belief(), Known(residual))
    assert (result.chi2, result.dof) == (pytest.approx(5.25), 3)
    assert result.standardised == pytest.approx([1.0, -2.0, 0.5])
    assert result.leverage == pytest.approx(0.0)
    assert (dict(result.belief.contributions), result.rank) == ({}, None)


def test_any_unit_has_a_scale_of_its_own() -> None:
    belief = Belief().with_block("force", [0.0], std=np.inf, units=["N"])
    belief = belief.with_block("heat", [0.0], std=np.inf, units=["K"])
    columns = belief.columns(["heat"])
    assert spectrum_of(belief, np.eye(2), np.ones(2), columns).rank == 1
