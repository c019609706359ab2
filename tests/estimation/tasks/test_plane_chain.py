"""The compiled rows and descent of a sensor that sees planes: the same numbers as the general ones."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from estimation import chart, compiling
from estimation.chart import Chart
from estimation.errors import DegenerateGeometry, EstimationError
from estimation.solver import Update, update
from estimation.tasks import chain
from estimation.tasks.motion import Poses
from estimation.tasks.solve import solve
from estimation.transform import FloatArray, Transform
from tests.estimation.tasks import cells

pytestmark = pytest.mark.skipif(chain.TIER is None, reason="numba is not installed")


@pytest.fixture(autouse=True)
def compiled() -> None:
    """Without 2,000 uses before."""
    assert chain.TIER is not None
    chain.TIER.compile_now()


NOISY = {"std_m": 2e-5, "std_rad": 1e-5}


def _at(problem: Any, **noise: float) -> Any:
    return replace(problem, motion=Poses(problem.motion.base_T_flange, **noise))


def _known(problem: Any, truth: dict[str, FloatArray]) -> Any:
    """With a mount that an earlier calibration gave, correlated, and one freedom exactly known."""
    covariance = np.diag([1e-4, 2e-4, 1e-4, 1e-3, 0.0]) ** 2
    covariance[0, 3] = covariance[3, 0] = 5e-8
    mount = Transform("flange", "laser", truth["laser"]).perturbed(np.array([1e-4, 0, 0, 0, 0, 0.0]))
    return replace(problem, mount=mount, mount_covariance=covariance)


def _problems() -> dict[str, tuple[Any, dict[str, FloatArray]]]:
    one = cells.point_laser_plane(np.random.default_rng(1))
    part = cells.point_laser_planes(np.random.default_rng(2))
    profile = cells.profile_laser_plane(np.random.default_rng(3))
    return {
        "a plane": (_at(one.problem), one.truth),
        "a plane, noisy poses": (_at(one.problem, **NOISY), one.truth),
        "a plane, known mount": (_known(_at(one.problem, **NOISY), one.truth), one.truth),
        "faces": (_at(part.problem, **NOISY), part.truth),
        "profiles": (_at(profile.problem), profile.truth),
    }


PROBLEMS = _problems()


def _update(name: str, off: float = 3e-3, **options: Any) -> Update:
    problem, truth = PROBLEMS[name]
    starts = {}
    belief = problem.belief()
    for block in belief.blocks:
        if block.flat:
            pose = Transform(block.value.target, block.value.source, truth[block.name])
            starts[block.name] = pose.perturbed(off * np.array([1.0, -2.0, 1.0, 3.0, -2.0, 1.0]))
    return update(belief.started(starts), problem.model(), targets=(problem.sensor,), **options)


@pytest.mark.parametrize("options", [{}, {"robust": "cauchy", "reject_level": 1e-3}, {"robust": "huber"}])
@pytest.mark.parametrize("name", list(PROBLEMS))
def test_every_number_is_that_of_the_general_way(
    name: str, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    fast = _update(name, **options)
    monkeypatch.setattr(chain, "TIER", None)
    plain = _update(name, **options)
    deviations = np.sqrt(np.diag(plain.belief.covariance))
    for block in plain.belief.blocks:
        there = fast.belief.value(block.name)
        assert isinstance(block.value, Transform) and isinstance(there, Transform)
        assert_allclose(there.matrix, block.value.matrix, atol=1e-6 * deviations[deviations > 0.0].min())
    assert list(fast.belief.contributions) == list(plain.belief.contributions)
    for source, matrix in plain.belief.contributions.items():
        scale = np.outer(deviations, deviations) + (np.outer(deviations, deviations) == 0.0)
        assert_allclose(fast.belief.contributions[source] / scale, matrix / scale, atol=1e-9)
    assert fast.chi2 == pytest.approx(plain.chi2, rel=1e-9)
    assert (fast.dof, fast.stop_reason) == (plain.dof, plain.stop_reason)
    assert [len(course) for course in fast.costs] == [len(course) for course in plain.costs]
    assert_allclose(fast.residual_m, plain.residual_m, atol=1e-12)
    assert_allclose(fast.standardised, plain.standardised, atol=1e-6)
    assert_allclose(fast.leverage, plain.leverage, atol=1e-9)
    assert (fast.rejected == plain.rejected).all()
    assert fast.rank is not None and plain.rank is not None
    assert_allclose(fast.rank.singular_values, plain.rank.singular_values, rtol=1e-6)


def test_the_general_way_is_taken_where_more_is_unknown() -> None:
    problem, _ = PROBLEMS["a plane"]
    for other in (problem, replace(problem, scale_std=1e-3), replace(problem, offset_std_m=1e-4)):
        made = Chart(other.belief(), other.model()).compiled
        assert (made is None) == (other is not problem)
    sphere = cells.point_laser_sphere(np.random.default_rng(4)).problem
    assert Chart(sphere.belief(), sphere.model()).compiled is None


def test_arrays_of_different_lengths_are_left_to_the_general_way() -> None:
    problem = cells.point_laser_planes(np.random.default_rng(2)).problem
    short = replace(problem, motion=Poses(problem.motion.base_T_flange[:7]), reading_m=problem.reading_m[:7])
    with pytest.raises(ValueError, match="broadcast"):
        update(short.belief(), short.model())


def test_what_is_open_is_refused_in_the_same_words(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = PROBLEMS["a plane"]
    still = replace(problem, motion=Poses(np.repeat(problem.motion.base_T_flange[:1], 30, axis=0)))
    words = []
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(chain, "TIER", None)
        with pytest.raises(DegenerateGeometry) as refusal:
            update(still.belief(), still.model())
        words.append(str(refusal.value))
    assert words[0] == words[1]


def test_readings_that_are_no_numbers_raise_no_numbers() -> None:
    problem, _ = PROBLEMS["a plane"]
    reading = problem.reading_m.copy()
    reading[3] = np.inf
    infinite = replace(problem, reading_m=reading)
    with pytest.raises(EstimationError, match="not a finite number"):
        update(infinite.belief(), infinite.model())


def test_a_whole_task_comes_to_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = cells.point_laser_plane(np.random.default_rng(8)).problem
    reading = problem.reading_m.copy()
    reading[5] += 2e-3
    outlier = replace(problem, reading_m=reading)
    fast = solve(outlier)
    monkeypatch.setattr(chain, "TIER", None)
    plain = solve(outlier)
    assert fast.notes == plain.notes
    assert np.flatnonzero(fast.rejected).tolist() == [5]
    assert_allclose(fast.covariance("laser"), plain.covariance("laser"), rtol=1e-6)


def test_the_chart_moves_poses_the_same_without_a_compiler() -> None:
    pose, active = np.eye(4), np.array([0, 1, 2, 3, 5])
    for change in (np.zeros(5), np.array([0.1, 0.2, 0.3, 0.7, -0.4]), np.full(5, 1e-5)):
        for fast, plain in zip(
            chart.moved(pose, change, active), chart.moved.py_func(pose, change, active), strict=True
        ):
            assert_allclose(fast, plain, atol=1e-15)


def test_a_kernel_is_compiled_when_it_pays() -> None:
    class Kernel:
        _cache = None  # nothing on disk

    tier = compiling.Tier(Kernel())
    assert [tier.ready() for _ in range(2_001)] == [False] * 2_000 + [True]
