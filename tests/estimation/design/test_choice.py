"""Choosing measurements: right sums, better than chance, near to what is possible, the same every time."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.design import CRITERIA, DesignProblem, choose, fewest, lower_bound
from estimation.design import gains as compiled
from estimation.design.criteria import Criterion
from estimation.errors import EstimationError
from tests.estimation.design.problems import box_problem, exact_covariance

ALL = pytest.mark.parametrize("criterion", CRITERIA.values(), ids=list(CRITERIA))


def value_of(problem: DesignProblem, criterion: Criterion, chosen: np.ndarray) -> float:
    """Of the criterion, by the plain formula."""
    covariance = exact_covariance(problem, chosen)
    if problem.targets is None:
        inverse = np.linalg.pinv(problem.root)
        return criterion.value((inverse @ covariance @ inverse.T)[None])
    return criterion.value(problem.targets @ covariance @ problem.targets.swapaxes(-1, -2))


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.integers(1, 20), st.integers(0, 2), st.sampled_from(sorted(CRITERIA)))
def test_what_is_left_is_what_the_plain_formula_says(
    seed: int, count: int, exchanges: int, name: str
) -> None:
    problem = box_problem(seed, candidates=80, shared=3)
    selection = choose(problem, count, CRITERIA[name], exchanges)
    assert len(set(selection.chosen.tolist())) == count
    expected = exact_covariance(problem, selection.chosen)
    scale = np.sqrt(np.diag(problem.covariance))
    np.testing.assert_allclose(
        selection.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-9
    )
    assert selection.value == pytest.approx(value_of(problem, CRITERIA[name], selection.chosen), rel=1e-6)


@ALL
def test_every_measurement_helps_or_at_least_does_no_harm(criterion: Criterion) -> None:
    curve = choose(box_problem(1, shared=4), 30, criterion, exchanges=0).curve
    assert len(curve) == 31
    assert np.all(np.diff(curve) <= 1e-9 * curve[0])


@ALL
def test_exchanges_never_make_it_worse(criterion: Criterion) -> None:
    for seed in range(5):
        problem = box_problem(seed, shared=2)
        values = [choose(problem, 15, criterion, exchanges).value for exchanges in (0, 1, 3)]
        assert values[0] >= values[1] * (1 - 1e-9) >= values[2] * (1 - 2e-9)


@ALL
def test_small_problems_come_near_the_best_of_all_sets(criterion: Criterion) -> None:
    problem = box_problem(7, candidates=14, judged=criterion.name not in ("D", "E"))
    sets = [np.array(chosen) for chosen in combinations(range(14), 7)]
    best = min(value_of(problem, criterion, chosen) for chosen in sets)
    found = choose(problem, 7, criterion, exchanges=5).value
    bound = lower_bound(problem, 7, criterion)
    assert bound.value <= best * (1 + 1e-9)  # the bound is one
    assert best <= found * (1 + 1e-9) <= 1.15 * best


@ALL
def test_no_random_set_beats_the_bound_and_the_choice_beats_them_all(criterion: Criterion) -> None:
    problem = box_problem(11, shared=3)
    random = np.random.default_rng(0)
    drawn = [value_of(problem, criterion, random.choice(400, 24, replace=False)) for _ in range(200)]
    bound, found = lower_bound(problem, 24, criterion), choose(problem, 24, criterion)
    assert bound.value <= found.value < min(drawn)
    assert bound.value <= bound.relaxed
    assert bound.weights.sum() == pytest.approx(24) and bound.weights.max() <= 1 + 1e-12


def test_24_points_for_d_are_within_5_percent_of_the_bound() -> None:
    for seed in range(5):
        problem = box_problem(seed, judged=False)
        found, bound = choose(problem, 24, CRITERIA["D"]), lower_bound(problem, 24, CRITERIA["D"])
        assert bound.value / found.value >= 0.95


def test_an_error_that_all_share_does_not_average_out() -> None:
    problem = box_problem(5)
    height = problem.rows[:, 2:3]  # as an error of the arm's height acts: like a shift of the part
    covariance = np.zeros((7, 7))
    covariance[:6, :6], covariance[6, 6] = problem.covariance, 1e-4**2
    assert problem.targets is not None
    targets = np.concatenate([problem.targets, np.zeros((8, 3, 1))], axis=2)
    everything = DesignProblem(covariance, np.hstack([problem.rows, height]), problem.variance, targets)
    assert np.sqrt(lower_bound(everything, 400).value) == pytest.approx(1e-4, rel=0.01)
    assert np.sqrt(lower_bound(problem, 400).value) < 1e-5


def test_the_same_input_gives_the_same_choice() -> None:
    first, second = (choose(box_problem(3, shared=2), 20).chosen for _ in range(2))
    assert first.tolist() == second.tolist()


def test_numpy_and_the_compiled_passes_choose_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    if not compiled.COMPILED:
        pytest.skip("numba is not installed")
    for name, candidates, count in (("D", 400, 20), ("D", 5000, 100), ("worst", 400, 20)):
        problem = box_problem(3, candidates, shared=2, judged=name != "D")
        with_compiler = choose(problem, count, CRITERIA[name])
        monkeypatch.setattr(compiled, "COMPILED", False)
        without = choose(problem, count, CRITERIA[name])
        monkeypatch.undo()
        assert with_compiler.chosen.tolist() == without.chosen.tolist()


def test_fewest_meets_the_limit_with_hardly_more_than_a_search_for_that_number_needs() -> None:
    problem = box_problem(2, candidates=150, shared=2)
    target = choose(problem, 30).value
    selection = fewest(problem, target)
    assert selection.value <= target
    assert len(selection) <= 32
    assert lower_bound(problem, 20).value > target  # so that no 20 could do it


def test_fewest_does_its_best_when_the_budget_misses_the_limit() -> None:
    problem = box_problem(2)
    selection = fewest(problem, 0.0, most=12)
    assert len(selection) == 12
    assert selection.value == pytest.approx(choose(problem, 12).value, rel=0.05)


def test_no_face_takes_more_than_its_share() -> None:
    group = np.arange(400) % 3
    chosen = choose(box_problem(3), 9, group=group, group_limit=3).chosen
    assert np.bincount(group[chosen]).tolist() == [3, 3, 3]


def test_a_state_that_is_known_exactly_is_no_obstacle() -> None:
    problem = box_problem(4)
    covariance = problem.covariance.copy()
    covariance[5, :] = covariance[:, 5] = 0.0
    selection = choose(DesignProblem(covariance, problem.rows, problem.variance, problem.targets), 10)
    assert np.abs(selection.covariance[5]).max() < 1e-18


def test_what_cannot_be_chosen_from_is_refused() -> None:
    with pytest.raises(EstimationError, match=r"5 reachable measurements, 6 wanted"):
        choose(box_problem(0, candidates=5), 6)
    problem = box_problem(0)
    with pytest.raises(EstimationError, match="noise variance of 0"):
        DesignProblem(problem.covariance, problem.rows, np.zeros(400), problem.targets)
    with pytest.raises(EstimationError, match="expected"):
        DesignProblem(problem.covariance, problem.rows[:, :5], problem.variance)
