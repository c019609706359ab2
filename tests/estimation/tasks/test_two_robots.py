"""Two robots to one base: beside scipy on the same measurements, replicas, shared errors, refusals."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimation.covariance import adjoint
from estimation.model import values_of
from estimation.solver import predicted_belief
from estimation.statistics import chi_square_two_sided
from estimation.tasks.findings import Cause, Status
from estimation.tasks.two_chains import with_base
from estimation.tasks.two_robots import join
from estimation.transform import FloatArray, Transform
from tests.estimation.tasks.cells import (
    CAMERA_STD_M,
    POSE_STD,
    Cell,
    camera_eye_to_hand,
    camera_hand_eye,
    point_laser_plane,
    point_laser_planes,
)
from tests.estimation.tasks.test_tasks import causes, normalised_error
from tests.estimation.tasks.two_robot_cells import (
    base2,
    cameras,
    cameras_on_unknown_markers,
    known_mounts,
    laser_and_probe,
    together,
)
from tests.estimation.twin import pose

EPS = np.repeat(POSE_STD, 3)
EQUAL_STD_M = float(np.sqrt(np.mean(CAMERA_STD_M**2)))


def by_hand(cell: Cell, start: FloatArray, object: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Whitened residuals of two cameras of known mount, by twists of base2, object, mounts and every pose."""
    halves = (cell.problem.first, cell.problem.second)

    def residuals(x: FloatArray) -> FloatArray:
        bases, place = start @ pose(x[None, :6])[0], object @ pose(x[None, 6:12])[0]
        found, at = [], 24
        for number, half in enumerate(halves):
            own = x[12 + 6 * number : 18 + 6 * number]
            error = x[at : at + 6 * len(half.motion)].reshape(-1, 6)
            at += error.size
            flange = half.motion.base_T_flange @ pose(error)
            seen_from = flange @ half.mount.matrix @ pose(own[None])[0]
            if number:
                seen_from = bases @ seen_from
            to_sensor = np.linalg.inv(seen_from)[half.pose_index] @ place
            point = half.markers_m[half.marker_index]
            predicted = np.einsum("mij,mj->mi", to_sensor[:, :3, :3], point) + to_sensor[:, :3, 3]
            found.append(((half.points_m - predicted) / EQUAL_STD_M).ravel())
            found.append((error / EPS).ravel())
            found.append(np.linalg.solve(np.linalg.cholesky(half.mount_covariance), own))
        return np.concatenate(found)

    return residuals


@pytest.mark.parametrize("seed", range(4, 8))
def test_the_estimate_and_its_covariance_are_those_of_scipy(seed: int) -> None:
    """With equal noise along all axes: unequal noise turns with the camera; only scipy differentiates it."""
    cell = known_mounts(np.random.default_rng(seed), count=4)
    first, second = (
        replace(half, covariance=np.eye(3) * EQUAL_STD_M**2)
        for half in (cell.problem.first, cell.problem.second)
    )
    cell = replace(cell, problem=replace(cell.problem, first=first, second=second))
    result = join(cell.problem)
    assert result.status is Status.OK, result.findings
    # From where we ended, scipy must not go anywhere; its Jacobian there gives the covariance.
    start = result.belief.transform("base2").matrix, result.belief.transform("object").matrix
    unknowns = 24 + 6 * (len(cell.problem.first.motion) + len(cell.problem.second.motion))
    found = least_squares(by_hand(cell, *start), np.zeros(unknowns), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:6, :6]
    assert np.abs(found.x[:6] / np.sqrt(np.diag(covariance))).max() < 1e-3
    assert 2.0 * found.cost == pytest.approx(result.chi2, rel=1e-5)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert result.covariance("base2") / scale == pytest.approx(covariance / scale, abs=1e-3)


def replicas(cell: Cell, count: int) -> tuple[FloatArray, FloatArray]:
    """Errors (count, 6) of base1_T_base2, and the covariance claimed: new noise and new mounts each time.

    The measurements are simulated here; the estimator's step to them from the truth is the same linear map
    for all, so one factorisation serves every replica.
    """
    rng, problem = np.random.default_rng(77), cell.problem
    flat = {"object": ("base1", "object"), "object2": ("base2", "object")}
    truth = {name: Transform(*frames, cell.truth[name]) for name, frames in flat.items()}
    belief = problem.belief().started(truth)
    values = values_of(belief)
    for i in (1, 2):
        values[f"camera{i}"] = Transform(f"flange{i}", f"camera{i}", cell.truth[f"camera{i}"])
    weighed = problem.model().weighed_at(values)
    rows = weighed.rows(values)
    dense, weight = rows.dense(belief), 1.0 / rows.noise_variance
    residual, prior = [], np.zeros((count, belief.size))
    for i, half in enumerate((problem.first, problem.second)):
        base_T_object = cell.truth[problem.objects[i]]
        true_flange, mount = half.motion.base_T_flange, cell.truth[f"camera{i + 1}"]
        error = rng.normal(size=(count, len(half.motion), 6)) * EPS
        reported = true_flange @ pose(error.reshape(-1, 6)).reshape(count, -1, 4, 4)
        to_sensor = np.linalg.inv(true_flange @ mount)[half.pose_index] @ base_T_object
        marker = half.markers_m[half.marker_index]
        exact = np.einsum("mij,mj->mi", to_sensor[:, :3, :3], marker) + to_sensor[:, :3, 3]
        points = exact + rng.normal(size=(count, *exact.shape)) * CAMERA_STD_M
        back = np.linalg.inv(base_T_object) @ reported[:, half.pose_index] @ mount
        seen = np.einsum("rmij,rmj->rmi", back[..., :3, :3], points) + back[..., :3, 3]
        whitened = np.einsum("mij,rmj->rmi", weighed.models[i].whitener[0], seen - marker)
        residual.append(whitened.reshape(count, -1))
        drawn = rng.normal(size=(count, 6)) @ np.linalg.cholesky(half.mount_covariance).T
        prior[:, belief.index(f"camera{i + 1}")] = -drawn  # of the truth from the mean that was drawn
    known = ~belief.flat
    inverse = np.zeros((belief.size, belief.size))
    inverse[np.ix_(known, known)] = np.linalg.inv(belief.prior_covariance[np.ix_(known, known)])
    normal = dense.T @ (weight[:, None] * dense) + inverse
    gradient = np.concatenate(residual, axis=1) * weight @ dense + prior @ inverse
    moved = -np.linalg.solve(normal, gradient.T).T
    claimed = predicted_belief(belief, weighed)
    turned = adjoint(cell.truth["object2"])
    apart = moved[:, belief.index("object")] - moved[:, belief.index("object2")]
    return apart @ turned.T, with_base(claimed, "object", "object2").block_covariance("base2")


def test_replicas_are_as_far_off_as_the_covariance_says() -> None:
    errors, covariance = replicas(known_mounts(np.random.default_rng(9)), 600)
    squared = np.einsum("ri,ri->r", errors, np.linalg.solve(covariance, errors.T).T)
    assert chi_square_two_sided(float(squared.sum()), 6 * len(errors), 1e-3).passed
    assert 548 <= np.sum(squared < chi2.ppf(0.95, 6)) <= 588  # 99.9 % band of 570


@pytest.mark.campaign
@pytest.mark.parametrize("make", [known_mounts, cameras, laser_and_probe])
def test_random_cells_hold_their_truth(make: Callable[[np.random.Generator], Cell]) -> None:
    inside, squared, freedoms, refused = 0, 0.0, 0, 0
    for seed in range(400):
        cell = make(np.random.default_rng(10_000 + seed))
        result = join(cell.problem, explain=False)
        if result.estimate is None:
            refused += 1
            continue
        error, count = normalised_error(result, {"base2": base2(cell)})
        inside, squared, freedoms = (
            inside + (error < chi2.ppf(0.95, count)),
            squared + error,
            freedoms + count,
        )
    taken = 400 - refused
    print(f"{make.__name__}: {inside} of {taken} inside, NEES/m {squared / freedoms:.3f}, {refused} refused")
    assert refused <= 8
    assert 0.92 * taken <= inside <= 0.98 * taken
    assert chi_square_two_sided(squared, freedoms, 1e-3).passed


def test_errors_of_the_object_cancel_between_the_robots() -> None:
    problem = known_mounts(np.random.default_rng(5)).problem
    loose = {name: replace(getattr(problem, name), marker_std_m=3e-4) for name in ("first", "second")}
    result = join(replace(problem, **loose))
    by_source = result.budget("base2")
    assert by_source["markers"].sum() < 0.05 * sum(part.sum() for part in by_source.values())
    assert result.budget("object")["markers"][:3].sum() > 0.0
    assert result.shown == ("base2", "camera1", "object", "markers", "camera2")


def test_a_sensor_that_was_carried_over_has_one_scale_and_two_have_two() -> None:
    cell = together(np.random.default_rng(6), point_laser_planes, point_laser_planes)
    halves = {
        name: replace(getattr(cell.problem, name), scale_std=2e-4, offset_std_m=5e-5)
        for name in ("first", "second")
    }
    one = join(replace(cell.problem, **halves, same_sensor=True))
    two = join(replace(cell.problem, **halves))
    assert {"laser.scale", "laser.offset"} <= set(one.belief.names)
    assert {"laser1.scale", "laser2.scale", "laser1.offset", "laser2.offset"} <= set(two.belief.names)
    truth = {"laser1": cell.truth["laser1"], "laser2": cell.truth["laser2"], "base2": base2(cell)}
    error, freedoms = normalised_error(one, truth)
    assert error < freedoms + 5.0 * np.sqrt(2.0 * freedoms)
    cause = causes(join(replace(cell.problem, first=halves["first"], same_sensor=True)))
    assert cause == {Cause.WRONG_SHAPE}


def swapped(cell: Cell) -> Any:
    markers = cell.problem.second.markers_m[::-1]
    return replace(cell.problem, second=replace(cell.problem.second, markers_m=markers))


def on_a_plane(rng: np.random.Generator) -> Any:
    problem = laser_and_probe(rng).problem
    return replace(problem, first=point_laser_plane(rng).problem)


def carried(rng: np.random.Generator) -> Any:
    return replace(cameras(rng).problem, second=camera_eye_to_hand(rng).problem)


def two_markers(rng: np.random.Generator) -> Any:
    problem = cameras_on_unknown_markers(rng).problem
    halves = {}
    for name in ("first", "second"):
        half = getattr(problem, name)
        rows = half.marker_index < 2
        taken = {each: getattr(half, each)[rows] for each in ("points_m", "pose_index", "marker_index")}
        halves[name] = replace(half, **taken)
    return replace(problem, **halves)


def skewed_mount(rng: np.random.Generator) -> Any:
    problem = known_mounts(rng).problem
    root = np.linalg.cholesky(problem.second.mount_covariance)
    return replace(problem, second=replace(problem.second, mount_covariance=root))


def inverted(rng: np.random.Generator) -> Any:
    problem = known_mounts(rng).problem
    motion = problem.second.motion
    turned = replace(motion, base_T_flange=np.linalg.inv(motion.base_T_flange))
    return replace(problem, second=replace(problem.second, motion=turned))


REFUSED: dict[str, tuple[Callable[[np.random.Generator], Any], Cause, str]] = {
    "another order": (lambda rng: swapped(cameras(rng)), Cause.WRONG_SURFACE, "not measured the same object"),
    "plane": (on_a_plane, Cause.SYMMETRIC, "leaves freedoms of the other base open"),
    "carried": (carried, Cause.WRONG_SHAPE, "Robot 2 carries the object"),
    "two markers": (two_markers, Cause.SYMMETRIC, "three markers"),
    "root": (skewed_mount, Cause.NOISE, "Robot 2: mount_covariance is not symmetric"),
    "inverted": (inverted, Cause.INVERTED, "Robot 2: The poses fit when each is inverted"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_gives_no_common_base_is_refused_with_its_cause(name: str) -> None:
    make, cause, words = REFUSED[name]
    result = join(make(np.random.default_rng(8)))
    assert result.status is Status.REFUSED
    assert result.values == {}
    assert cause in causes(result)
    assert any(words in str(finding) for finding in result.findings), result.findings


def test_an_outlier_of_the_second_robot_is_left_out() -> None:
    cell = known_mounts(np.random.default_rng(3))
    points = cell.problem.second.points_m.copy()
    points[2] += 5e-3
    result = join(replace(cell.problem, second=replace(cell.problem.second, points_m=points)))
    assert causes(result) == {Cause.OUTLIER}
    row = 3 * (len(cell.problem.first.points_m) + 2)
    assert np.flatnonzero(result.rejected).tolist() == [row, row + 1, row + 2]
    error, freedoms = normalised_error(result, {"base2": base2(cell)})
    assert error < freedoms + 5.0 * np.sqrt(2.0 * freedoms)


def test_a_far_base_is_found_without_a_guess() -> None:
    cell = together(np.random.default_rng(12), camera_hand_eye, camera_hand_eye, far_m=15.0)
    result = join(cell.problem)
    gap = np.linalg.inv(result.belief.transform("base2").matrix) @ base2(cell)
    assert np.linalg.norm(Rotation.from_matrix(gap[:3, :3]).as_rotvec()) < 2e-3
