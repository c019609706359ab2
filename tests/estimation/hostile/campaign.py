"""Draws of hostile and of sound data, each judged: what was drawn, what was said, how it was accepted.

    .venv/bin/python -m tests.estimation.hostile.campaign [KIND|sound ...] [--draws 200]

prints the rows of the tables in docs/evidence.md.
"""

import argparse
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from estimation.localization.task import Localization, localize
from estimation.tasks.findings import Cause, Status
from estimation.tasks.solve import Result, solve
from tests.estimation.hostile.kinds import ALL, KINDS, LOCALIZATION, OF_PLACES, Kind
from tests.estimation.hostile.places import located


@dataclass(frozen=True)
class Draw:
    """One data set and what became of it; `wrong` says what is not as it must be, and is empty if all is."""

    task: str
    seed: int
    status: Status
    causes: tuple[Cause, ...]
    seconds: float
    wrong: str


def hostile(kind: Kind, draws: int, first: int = 0) -> list[Draw]:
    """Draws of one kind, in turn from its tasks."""
    return [_hostile(kind, kind.tasks[seed % len(kind.tasks)], seed) for seed in range(first, first + draws)]


def sound(draws: int, first: int = 0, names: Sequence[str] = tuple(ALL)) -> list[Draw]:
    """Sound sets, in turn from all tasks."""
    return [_sound(names[seed % len(names)], seed) for seed in range(first, first + draws)]


def _hostile(kind: Kind, task: str, seed: int) -> Draw:
    rng = np.random.default_rng([seed, (KINDS + OF_PLACES).index(kind)])
    problem = kind.draw(task, rng)
    result, seconds, wrong = _solved(problem)
    causes = tuple(finding.cause for finding in result.findings)
    if not wrong and (result.status is Status.OK or kind.cause not in causes):
        wrong = f"{result.status}: {'; '.join(map(str, result.findings)) or 'nothing found'}"
    return Draw(task, seed, result.status, causes, seconds, wrong)


def _sound(task: str, seed: int) -> Draw:
    cell = (located if task == LOCALIZATION else ALL[task])(np.random.default_rng(seed))
    result, seconds, wrong = _solved(cell.problem)
    causes = tuple(finding.cause for finding in result.findings)
    if not wrong and result.status is Status.REFUSED:
        wrong = "; ".join(map(str, result.findings))
    return Draw(task, seed, result.status, causes, seconds, wrong)


def _solved(problem: Any) -> tuple[Result, float, str]:
    """The result, its time, and whether its numbers are numbers. A warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        start = perf_counter()
        result = localize(problem) if isinstance(problem, Localization) else solve(problem)
        seconds = perf_counter() - start
    if result.estimate is None:
        return result, seconds, ""
    covariance = result.belief.covariance
    numbers = [covariance, *(getattr(v, "matrix", v) for v in result.values.values())]
    if not all(np.isfinite(each).all() for each in numbers):
        return result, seconds, "not a number"
    # Zero is what was held.
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(std > 0.0, std, 1.0)
    if (
        np.diag(covariance).min() < 0.0
        or np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() < -1e-9
    ):
        return result, seconds, "negative variance"
    return result, seconds, ""


def table(rows: Iterable[tuple[str, Sequence[Draw]]]) -> list[str]:
    """Lines of a table: what was drawn, and how often it was refused, flagged, with the right cause."""
    lines = [
        "| Kind | Tasks | Draws | Refused | Flagged | Right cause | Longest |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, draws in rows:
        status = Counter(draw.status for draw in draws)
        right = sum(not draw.wrong for draw in draws)
        lines.append(
            f"| {name} | {len({draw.task for draw in draws})} | {len(draws)} | {status[Status.REFUSED]} | "
            f"{status[Status.FLAGGED]} | {right} | {max(draw.seconds for draw in draws):.1f} s |"
        )
    return lines


def main() -> None:
    """Run what is named on the command line, all kinds by default."""
    parser = argparse.ArgumentParser()
    names = [*(kind.cause.name for kind in KINDS), "sound"]
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(names))
    parser.add_argument("--of", choices=("calibration", LOCALIZATION), default="calibration")
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    if unknown := set(given.kinds) - set(names):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; choose from {', '.join(names)}")
    kinds, tasks = (OF_PLACES, (LOCALIZATION,)) if given.of == LOCALIZATION else (KINDS, tuple(ALL))
    for kind in kinds:
        if not given.kinds or kind.cause.name in given.kinds:
            draws = hostile(kind, given.draws, given.first)
            print(table([(kind.cause.value, draws)])[-1], flush=True)
            _complain(draws)
    if "sound" in given.kinds:
        draws = sound(given.draws, given.first, tasks)
        for task in tasks:
            print(table([(task, [draw for draw in draws if draw.task == task])])[-1], flush=True)
        print(Counter(cause.value for draw in draws for cause in draw.causes))
        _complain(draws)


def _complain(draws: Sequence[Draw]) -> None:
    for draw in draws:
        if draw.wrong:
            print(f"    {draw.task} seed {draw.seed}: {draw.wrong}", flush=True)


if __name__ == "__main__":
    main()
