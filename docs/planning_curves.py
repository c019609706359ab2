"""Makes docs/planning-curves.png and prints the tables of "Where to measure" in docs/evidence.md.

    .venv/bin/python docs/planning_curves.py

Figures 25 to 30 of Sallinen (2003), section 5.4.2, again: points on three sides of a cube, the same on each,
at every combination of a grid; the uncertainty of pose and corner against the distance of the points. And his
cube and square (sections 5.4 and 6.6) by named ways to choose.
"""

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Final

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import spearmanr

from estimation.design import CRITERIA, DesignProblem, choose
from estimation.design.baselines import annealed, extreme_points, generate_and_test, pattern, random_set
from estimation.design.indices import COSTS
from estimation.transform import FloatArray, skew

PICTURE: Final = Path(__file__).with_name("planning-curves.png")
SIDE_MM: Final = 100.0
GRID: Final = 5  # points along an edge
SIGMA_MM: Final = 0.1
CRITERION_NAMES: Final = (
    "product of eigenvalues (pose)",
    "sum of eigenvalues (pose)",
    "volume of the corner's ellipsoid",
)
UNITS: Final = ("mm$^6$ rad$^6$", "mm$^2$ + rad$^2$", "mm$^3$")  # the sum mixes units, as in the thesis
DRAWS: Final = 300


def rows(points: FloatArray, normals: FloatArray) -> FloatArray:
    """n^T [I | -[p]x] (..., 6)."""
    return np.concatenate([normals, np.cross(points, normals)], axis=-1)


def curves(count: int) -> tuple[FloatArray, FloatArray]:
    """Distances (c,) in mm and the three criteria (c, 3) of all sets of `count` points a side."""
    steps = np.linspace(0.0, SIDE_MM, GRID)
    flat = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    sets = np.array(list(combinations(range(len(flat)), count)))
    chosen = flat[sets]  # (c, count, 2)
    apart = np.linalg.norm(chosen[:, :, None] - chosen[:, None], axis=-1)
    if count == 3:
        distance = apart[:, 0, 1] + apart[:, 1, 2] + apart[:, 2, 0]  # around the triangle
    else:
        pairings = [((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2))]
        distance = np.max([apart[:, a, b] + apart[:, c, d] for (a, b), (c, d) in pairings], axis=0)
    information = np.zeros((len(sets), 6, 6))
    for face in range(3):
        points = np.zeros((*chosen.shape[:2], 3))
        points[..., [axis for axis in range(3) if axis != face]] = chosen
        jacobian = rows(points, np.broadcast_to(np.eye(3)[face], points.shape))
        information += jacobian.swapaxes(1, 2) @ jacobian / SIGMA_MM**2
    determined = np.linalg.cond(information) < 1e12  # points on one line leave a side free to turn
    covariance = np.linalg.inv(information[determined])
    to_corner = np.concatenate([np.eye(3), -skew(np.full(3, SIDE_MM))], axis=1)
    corner = to_corner @ covariance @ to_corner.T
    volume = 4.0 / 3.0 * np.pi * np.sqrt(np.linalg.det(corner))
    values = np.stack([np.linalg.det(covariance), np.trace(covariance, axis1=1, axis2=2), volume], axis=1)
    return distance[determined], values


def draw() -> Iterator[str]:
    """The picture; yields a row of the table for each curve."""
    figure, axes = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
    for line, (count, what) in enumerate(((4, "two pairs of points a side"), (3, "three points a side"))):
        distance, values = curves(count)
        for column, name in enumerate(CRITERION_NAMES):
            value, number = values[:, column], 25 + 3 * line + column
            axis = axes[line, column]
            axis.semilogy(distance, value, ".", markersize=1.5, color="#9aa5b1", rasterized=True)
            levels = np.unique(np.round(distance, 6))
            least = [value[np.isclose(distance, level)].min() for level in levels]
            axis.semilogy(levels, least, "-", linewidth=1.0, color="#1d5b8f")
            axis.set_title(f"Figure {number}: {name}", fontsize=8)
            axis.set_xlabel(f"distance (mm), {what}", fontsize=7)
            axis.set_ylabel(UNITS[column], fontsize=7)
            axis.tick_params(labelsize=7)
            best, farthest = int(np.argmin(value)), np.isclose(distance, distance.max())
            middle = np.abs(distance - np.median(distance)) < 0.02 * distance.max()
            spread = np.percentile(value[middle], 95) / np.percentile(value[middle], 5)
            yield (
                f"| {number} | {what} | {name} | {spearmanr(distance, value).statistic:.2f} | {spread:.1f} | "
                f"{distance[best] / distance.max():.2f} | {value[farthest].max() / value[best]:.2f} |"
            )
    figure.savefig(PICTURE, dpi=110)


def compared(size_mm: FloatArray, count: int) -> Iterator[str]:
    """Rows of named choices on three sides of a block: worst corner (mm) for a noise of 0.1 mm."""
    points, normals, face = [], [], []
    for side in range(3):
        u, v = (axis for axis in range(3) if axis != side)
        grid = np.stack(
            np.meshgrid(*(np.linspace(0, size_mm[i], 21) for i in (u, v)), indexing="ij"), axis=-1
        )
        place = np.zeros((grid[..., 0].size, 3))
        place[:, [u, v]] = grid.reshape(-1, 2)
        points.append(place)
        normals.append(np.broadcast_to(np.eye(3)[side], place.shape))
        face.append(np.full(len(place), side))
    surface, index = np.concatenate(points), np.concatenate(face)
    jacobian = rows(surface, np.concatenate(normals))
    corners = np.array(list(np.ndindex(2, 2, 2))) * size_mm
    targets = np.concatenate([np.broadcast_to(np.eye(3), (8, 3, 3)), -skew(corners)], axis=2)
    prior = np.diag([1e2] * 3 + [1.0] * 3) ** 2
    problem = DesignProblem(prior, jacobian, np.full(len(jacobian), SIGMA_MM**2), targets)

    def worst_mm(chosen: FloatArray) -> float:
        return float(
            np.sqrt(CRITERIA["worst"].value(problem.judged(problem.white_covariance(chosen=chosen))))
        )

    scaled = jacobian * np.array([1.0, 1.0, 1.0, *(1.0 / size_mm)])
    random = np.random.default_rng(1)
    yield f"| planned, worst corner | {worst_mm(choose(problem, count).chosen):.4f} |"
    yield f"| planned, D | {worst_mm(choose(problem, count, CRITERIA['D']).chosen):.4f} |"
    yield f"| extreme points | {worst_mm(extreme_points(jacobian, index, count)):.4f} |"
    for name, cost in COSTS.items():
        tested = generate_and_test(scaled, count, cost, random)
        yield f"| best of 200 random sets by {name} | {worst_mm(tested):.4f} |"
    cooled = annealed(scaled, count, COSTS["observability"], random)
    yield f"| annealed on observability | {worst_mm(cooled):.4f} |"
    side = round((count / 3) ** 0.5)
    grid_set = pattern(surface, index, side)
    yield f"| pattern of {len(grid_set)}: {side} x {side} a side | {worst_mm(grid_set):.4f} |"
    drawn = [worst_mm(random_set(len(jacobian), count, random)) for _ in range(DRAWS)]
    yield f"| random, median of {DRAWS} | {np.median(drawn):.4f} |"


def square() -> Iterator[str]:
    """100 points on each of two sides of a square, for sigma^2 / n = 0.1: second axis of the far corner."""
    places = np.linspace(5.0, 95.0, 181)
    planned = np.concatenate([np.linspace(0.0, 5.0, 50), np.linspace(95.0, 100.0, 50)])
    random = np.random.default_rng(1)
    yield f"| planned: half in 0..5, half in 95..100 | {second_axis(planned):.4f} |"
    yield f"| pattern: even from 5 to 95 | {second_axis(np.linspace(5.0, 95.0, 100)):.4f} |"
    drawn = [second_axis(random.choice(places, 100)) for _ in range(DRAWS)]
    yield f"| random from 5 to 95, median of {DRAWS} | {np.median(drawn):.4f} |"


def second_axis(positions: FloatArray) -> float:
    """Larger principal standard deviation of the far corner of the square."""
    ones, zeros = np.ones_like(positions), np.zeros_like(positions)
    jacobian = np.concatenate(
        [np.column_stack([zeros, ones, positions]), np.column_stack([ones, zeros, -positions])]
    )
    covariance = 0.1 * len(positions) * np.linalg.inv(jacobian.T @ jacobian)
    to_corner = np.array([[1.0, 0.0, -100.0], [0.0, 1.0, 100.0]])
    return float(np.sqrt(np.linalg.eigvalsh(to_corner @ covariance @ to_corner.T)[-1]))


def main() -> None:
    """Print all tables."""
    print(*draw(), sep="\n")
    print("\ncube of 100 x 100 x 100, 27 points", *compared(np.full(3, 100.0), 27), sep="\n")
    print("\nblock of 100 x 400 x 100, 27 points", *compared(np.array([100.0, 400.0, 100.0]), 27), sep="\n")
    print("\nsquare", *square(), sep="\n")


if __name__ == "__main__":
    main()
