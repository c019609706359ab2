"""How much faster 24 of 100,000 candidates are chosen than by a plain greedy choice in numpy; one run.

    python -m benchmarks.choice_speed

The peer does what one writes first: the determinant of the information is multiplied by 1 + b C b for each
candidate, which one einsum computes for all of them in each step, and C follows by the rank-one formula.
"""

import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: for both, as the controller has it

import numpy as np

from estimation.design import CRITERIA, DesignProblem, choose
from estimation.transform import FloatArray

CANDIDATES, COUNT, STATES = 100_000, 24, 6
RUNS = 5


def plain_greedy(problem: DesignProblem, count: int) -> tuple[list[int], float]:
    """Candidates, and the D criterion (geometric mean of the variances, in units of the prior)."""
    prior = np.sqrt(np.diag(problem.covariance))
    rows = problem.rows * prior / np.sqrt(problem.variance)[:, None]
    covariance, chosen = np.eye(len(prior)), list[int]()
    free = np.ones(len(rows), dtype=bool)
    for _ in range(count):
        gain = np.einsum("mi,ij,mj->m", rows, covariance, rows, optimize=True)
        best = int(np.argmax(np.where(free, gain, -np.inf)))
        chosen.append(best)
        free[best] = False
        along = covariance @ rows[best]
        covariance = covariance - np.outer(along, along) / (1.0 + rows[best] @ along)
    return chosen, float(np.exp(np.linalg.slogdet(covariance)[1] / len(prior)))


def box(seed: int) -> DesignProblem:
    """Points on the faces of a box with edges of 100 to 150 mm; its pose is known to 5 mm and 1 deg."""
    random = np.random.default_rng(seed)
    size, face = np.array([0.1, 0.15, 0.1]), random.integers(0, 6, CANDIDATES)
    normals = np.concatenate([np.eye(3), -np.eye(3)])[face]
    points: FloatArray = size * random.uniform(0.0, 1.0, (CANDIDATES, 3))
    axis = face % 3
    points[np.arange(CANDIDATES), axis] = np.where(face < 3, size[axis], 0.0)
    rows = np.concatenate([normals, np.cross(points, normals)], axis=1)
    prior = np.diag([5e-3] * 3 + [0.017] * 3) ** 2
    return DesignProblem(prior, rows, 3e-5**2 * random.uniform(1.0, 2.0, CANDIDATES))


def best_of(function: object, *arguments: object) -> tuple[float, object]:
    """Shortest of some runs, seconds, and the result of the last."""
    assert callable(function)
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        result = function(*arguments)
        times.append(time.perf_counter() - begin)
    return min(times), result


def main() -> None:
    """Print times, ratio and criteria."""
    choose(box(0), 2, CRITERIA["D"], 0)  # compiles
    for seed in range(1, 4):
        plain_s, (_, plain) = best_of(plain_greedy, box(seed), COUNT)  # type: ignore[misc]
        times = {}
        for name, exchanges in (("greedy", 0), ("with exchanges", 2)):
            ours = []
            for _ in range(RUNS):
                problem = box(seed)  # nothing cached: whitening counts
                begin = time.perf_counter()
                selection = choose(problem, COUNT, CRITERIA["D"], exchanges)
                ours.append(time.perf_counter() - begin)
            times[name] = min(ours), selection.value
        for name, (ours_s, value) in times.items():
            print(
                f"seed {seed}: numpy {plain_s * 1e3:.0f} ms, {name} {ours_s * 1e3:.1f} ms: "
                f"{plain_s / ours_s:.1f} times faster; criterion {value / plain:.6f} of numpy's"
            )


if __name__ == "__main__":
    main()
