"""Axes of a positioner: truth within the covariance, an independent solver, laws, and what cannot be told."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimation.tasks.findings import Cause, Status
from estimation.tasks.positioner import PositionerPoints
from estimation.tasks.positioner_result import Axis, Positioned, calibrate_axes
from estimation.tasks.turning import ANGLE_ERRORS, AXES, Turning
from estimation.transform import FloatArray, Transform
from tests.estimation.tasks.positioner_cells import (
    ANGLE_RAD,
    POINT_M,
    PositionerCell,
    direction,
    positioner_cell,
    turned,
)
from tests.estimation.twin import pose as exp


def error_of(axis: Axis, truth: tuple[FloatArray, FloatArray]) -> FloatArray:
    """[tx, ty, rx, ry] by which the true line lies off, in the frame of the estimate."""
    point, along = truth
    local_d = along @ axis.base_T_axis.rotation
    local_p = axis.base_T_axis.inverse().points(point)
    crossing = local_p - local_d * local_p[2] / local_d[2]
    return np.array([crossing[0], crossing[1], -local_d[1], local_d[0]])


def nees(found: Positioned, cell: PositionerCell) -> float:
    """Squared error of both lines by their joint covariance, 8 freedoms."""
    error = np.concatenate([error_of(axis, truth) for axis, truth in zip(found.axes, cell.axes, strict=True)])  # type: ignore[arg-type]
    covariance = found.belief.marginal(AXES).covariance
    return float(error @ np.linalg.solve(covariance, error))


CASES = {
    "one point": {},
    "three points": {"each": 3, "count": 10},
    "known points": {"each": 4, "count": 10, "known": True},
    "sphere": {"kind": "sphere", "each": 6, "count": 10},
    "planes": {"kind": "planes", "each": 8, "count": 10},
}


@pytest.mark.parametrize("name", CASES)
def test_no_guess_is_needed_and_the_truth_is_within_the_covariance(name: str) -> None:
    cell = positioner_cell(np.random.default_rng(11), **CASES[name])  # type: ignore[arg-type]
    found = calibrate_axes(cell.problem)
    assert found.status is Status.OK, found.findings
    assert nees(found, cell) < 8 + 5 * np.sqrt(16)
    for axis, (_, along) in zip(found.axes, cell.axes, strict=True):
        assert axis is not None
        assert axis.direction @ along > 1.0 - 1e-8
        assert np.sqrt(np.diag(axis.covariance))[:2].max() < 5e-5
    (p1, d1), (p2, d2) = cell.axes
    across = np.cross(d1, d2)
    known = {
        "axes apart": (p2 - p1) @ across / np.linalg.norm(across),
        "angle between axes": np.arccos(d1 @ d2),
    }
    derived = {each.name: each for each in found.derived}
    for what, value in known.items():
        assert abs(derived[what].value - value) < 4.0 * derived[what].u
    zero = derived["zero of axis 1"]
    steps = np.array([-0.01, 0.0, 0.01]) + zero.value
    heights = [Rotation.from_rotvec(angle * d1).apply(d2)[2] for angle in steps]
    assert heights[1] == max(heights)
    assert ("zero of axis 2" in derived) == (name in ("known points", "planes"))
    if "zero of axis 2" in derived:
        x, second = cell.object[:3, 0], derived["zero of axis 2"]
        along_1 = [
            Rotation.from_rotvec(angle * d2).apply(x) @ d1 for angle in steps - zero.value + second.value
        ]
        assert along_1[1] == max(along_1)


def test_the_truth_lies_in_the_stated_region_as_often_as_it_should() -> None:
    cells = [positioner_cell(np.random.default_rng(200 + seed)) for seed in range(10)]
    squares = np.array([nees(calibrate_axes(cell.problem), cell) for cell in cells])
    assert squares.mean() == pytest.approx(8.0, abs=3.3 * np.sqrt(16.0 / len(squares)))
    assert np.sum(squares < 15.507) >= 7  # chi-square of 8, 95 %


@pytest.mark.campaign
def test_coverage_over_many_positioners() -> None:
    names = list(CASES)
    squares = []
    for seed in range(300):
        cell = positioner_cell(np.random.default_rng(20_000 + seed), **CASES[names[seed % 5]])  # type: ignore[arg-type]
        found = calibrate_axes(cell.problem)
        if found.estimate is not None:
            squares.append(nees(found, cell))
    inside, count = int(np.sum(np.array(squares) < 15.507)), len(squares)
    print(f"positioner: {inside} of {count} inside 95 %, mean NEES/m {np.mean(squares) / 8:.4f}")
    assert count >= 297  # at most 1 % refused
    assert 273 - (300 - count) <= inside <= 294
    assert np.mean(squares) == pytest.approx(8.0, abs=3.3 * np.sqrt(16.0 / 300))


def test_the_same_as_least_squares_of_scipy() -> None:
    cell = positioner_cell(np.random.default_rng(5), each=2, angle_rad=0.0)
    problem = cell.problem
    angle = problem.motion.angles_rad[problem.pose_index]
    frames = [np.linalg.svd(along[None])[2][1:] for _, along in cell.axes]  # square to the true direction

    def residuals(x: FloatArray) -> FloatArray:
        markers, lines = x[:6].reshape(2, 3)[problem.marker_index], []
        for place, ((point, along), square) in enumerate(zip(cell.axes, frames, strict=True)):
            own = x[6 + 4 * place : 10 + 4 * place]
            tilted = along + own[2:] @ square
            lines.append((point + own[:2] @ square, tilted / np.linalg.norm(tilted)))
        seen = turned(lines[0], angle[:, 0], turned(lines[1], angle[:, 1], markers))
        return np.asarray((problem.points_m - seen) / POINT_M).reshape(-1)

    found = calibrate_axes(problem)
    start = np.concatenate([found.belief.vector("markers"), np.zeros(8)])
    other = least_squares(residuals, start, method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    covariance = np.linalg.inv(other.jac.T @ other.jac)
    assert found.chi2 == pytest.approx(2.0 * other.cost, rel=1e-6)
    assert found.belief.std("markers") == pytest.approx(np.sqrt(np.diag(covariance))[:6], rel=1e-3)
    assert found.belief.vector("markers") == pytest.approx(other.x[:6], abs=1e-3 * POINT_M)
    for place, axis in enumerate(found.axes):
        own = other.x[6 + 4 * place : 10 + 4 * place]
        point, along = cell.axes[place]
        tilted = along + own[2:] @ frames[place]
        line = point + own[:2] @ frames[place], tilted / np.linalg.norm(tilted)
        assert axis is not None
        assert np.abs(error_of(axis, line)) / np.sqrt(np.diag(axis.covariance)) == pytest.approx(
            0.0, abs=1e-2
        )


numbers = st.lists(st.floats(-1.0, 1.0), min_size=20, max_size=20).map(np.array)


@settings(max_examples=25)
@given(x=numbers, axes=st.sampled_from([(0, 1), (0,), (1,)]))
def test_law_derivatives_by_axes_and_angles(x: FloatArray, axes: tuple[int, ...]) -> None:
    angles = np.array([[0.3, -2.0], [1.2, 0.4], [-0.8, 2.9]])
    motion = Turning(angles, ANGLE_RAD, axes)
    values: dict[str, Transform | FloatArray] = {
        AXES[axis]: Transform("base", AXES[axis], exp(x[6 * place : 6 * place + 6]))
        for place, axis in enumerate(axes)
    }
    values[ANGLE_ERRORS] = 0.01 * x[12 : 12 + 3 * len(axes)]
    there = motion.at(values)
    for name, value in values.items():
        for column in range(there.jacobian[name].shape[2]):
            ends = []
            for step in (1e-6, -1e-6):
                if isinstance(value, Transform):
                    moved: Transform | FloatArray = value.perturbed(step * np.eye(6)[column])
                else:
                    moved = value + step * np.eye(len(value))[column]
                ends.append(motion.at({**values, name: moved}).pose)
            gap = (np.linalg.inv(there.pose) @ (ends[0] - ends[1])) / 2e-6
            twist = np.column_stack([gap[:, :3, 3], gap[:, 2, 1], gap[:, 0, 2], gap[:, 1, 0]])
            assert twist == pytest.approx(there.jacobian[name][:, :, column], abs=1e-7)


def test_law_axes_move_with_the_frame_of_the_points() -> None:
    cell = positioner_cell(np.random.default_rng(7))
    moved = exp(np.array([2.0, -1.0, 0.5, 0.4, -1.2, 2.0]))
    points = cell.problem.points_m @ moved[:3, :3].T + moved[:3, 3]
    here, there = calibrate_axes(cell.problem), calibrate_axes(replace(cell.problem, points_m=points))
    assert there.chi2 == pytest.approx(here.chi2, rel=1e-5)
    for one, other in zip(here.axes, there.axes, strict=True):
        assert one is not None and other is not None
        assert other.direction == pytest.approx(moved[:3, :3] @ one.direction, abs=1e-8)
        assert other.point_m == pytest.approx(moved[:3, :3] @ one.point_m + moved[:3, 3], abs=1e-8)


@pytest.mark.parametrize("still", [0, 1])
def test_an_axis_that_stood_still_gets_no_number(still: int) -> None:
    cell = positioner_cell(np.random.default_rng(3), still=(still,))
    found = calibrate_axes(cell.problem)
    assert found.status is Status.FLAGGED
    assert found.axes[still] is None and AXES[still] not in found.values
    assert found.derived == ()
    assert found.notes[0] == (
        f"Axis {still + 1} stood still: where it is cannot be seen, and it gets no number. "
        f"Turn axis {still + 1} through 60 deg or more as well."
    )
    axis, (point, along) = found.axes[1 - still], cell.axes[1 - still]
    assert axis is not None
    if still == 0:  # axis 1 has carried axis 2 to where it stood
        ends = turned(cell.axes[0], np.full(2, 0.3), np.array([point, point + along]))
        point, along = ends[0], ends[1] - ends[0]
    error = error_of(axis, (point, along))
    assert error @ np.linalg.solve(axis.covariance, error) < 4 + 5 * np.sqrt(8)


def causes(found: Positioned) -> set[Cause]:
    assert found.status is Status.REFUSED and found.axes == (None, None) and found.values == {}
    return {finding.cause for finding in found.findings}


def test_what_no_axis_can_be_told_from_is_refused_in_words() -> None:
    rng = np.random.default_rng(4)
    assert causes(calibrate_axes(positioner_cell(rng, still=(0, 1)).problem)) == {Cause.ONE_AXIS}
    little = calibrate_axes(positioner_cell(rng, turns_deg=(70.0, 1.0)).problem)
    assert causes(little) == {Cause.ONE_AXIS}
    assert "limit 5 deg: where it is cannot be seen" in little.findings[0].problem
    cell = positioner_cell(rng, count=20)
    point, along = cell.axes[1]
    angle = cell.problem.motion.angles_rad
    on_axis = turned(cell.axes[0], angle[:, 0], np.tile(point + 0.1 * along, (20, 1)))
    found = calibrate_axes(replace(cell.problem, points_m=on_axis + rng.normal(size=(20, 3)) * POINT_M))
    assert causes(found) == {Cause.UNDETERMINED}
    assert "of the axis 2" in found.findings[-1].problem
    assert "measure points farther away from it" in found.findings[-1].remedy
    few = calibrate_axes(positioner_cell(rng, "sphere", each=3).problem)
    assert causes(few) == {Cause.UNDETERMINED}
    assert "0 poses of the table have four or more touches" in few.findings[0].problem


def test_exchanged_angles_and_degrees_are_recognised() -> None:
    cell = positioner_cell(np.random.default_rng(6))
    angles = cell.problem.motion.angles_rad
    for other, cause in ((angles[:, ::-1], Cause.SWAPPED_JOINTS), (np.degrees(angles), Cause.WRONG_UNITS)):
        motion = replace(cell.problem.motion, angles_rad=other)
        assert cause in causes(calibrate_axes(replace(cell.problem, motion=motion)))


def test_an_outlier_is_left_out_and_flagged() -> None:
    cell = positioner_cell(np.random.default_rng(8))
    assert isinstance(cell.problem, PositionerPoints)
    points = cell.problem.points_m.copy()
    points[3] += 5e-3 * direction(np.random.default_rng(1))
    found = calibrate_axes(replace(cell.problem, points_m=points))
    assert found.status is Status.FLAGGED
    assert np.flatnonzero(found.rejected).tolist() == [9, 10, 11]
    assert nees(found, cell) < 8 + 5 * np.sqrt(16)


HOSTILE: dict[str, tuple[Callable[[PositionerPoints], dict[str, Any]], Cause]] = {
    "covariance of two": (lambda p: {"covariance": np.eye(2)}, Cause.WRONG_SHAPE),
    "covariance is no number": (lambda p: {"covariance": np.full((3, 3), np.nan)}, Cause.NOT_FINITE),
    "covariance below zero": (lambda p: {"covariance": -np.eye(3)}, Cause.NOISE),
    "one point": (lambda p: {"points_m": np.tile(p.points_m[:1], (16, 1))}, Cause.UNDETERMINED),
    "three angles": (
        lambda p: {"motion": replace(p.motion, angles_rad=np.zeros((16, 3)))},  # type: ignore[type-var]
        Cause.WRONG_SHAPE,
    ),
    "three stds": (lambda p: {"motion": replace(p.motion, std_rad=np.ones(3))}, Cause.WRONG_SHAPE),  # type: ignore[type-var]
    "two ups": (lambda p: {"up": (0.0, 1.0)}, Cause.WRONG_SHAPE),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", HOSTILE)
def test_bad_data_are_refused_without_a_warning(name: str) -> None:
    problem, (change, cause) = positioner_cell(np.random.default_rng(1)).problem, HOSTILE[name]
    assert causes(calibrate_axes(replace(problem, **change(problem)), explain=False)) == {cause}
