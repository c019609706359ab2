"""Other ways to choose measurements, by name: what the literature and common practice would do.

They share candidates and predictions with the planner, so that a comparison compares the choice alone. All
are repeatable: whatever is random comes from the generator that is passed in.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from estimation.errors import EstimationError
from estimation.transform import FloatArray

IntArray = NDArray[np.intp]
Cost = Callable[[FloatArray], float]  # of the rows (k, n) of a set; less is better

_TIGHTEST: Final = 64  # points in one direction beyond which a pattern is not sought
_FLAT: Final = 1e-6  # of the largest spread: a column that does not vary controls nothing


def random_set(candidates: int, count: int, random: np.random.Generator) -> IntArray:
    """Any `count` of the candidates, each as likely as the others."""
    _require(candidates, count)
    return np.asarray(random.choice(candidates, size=count, replace=False), dtype=np.intp)


def pattern(surface_p: FloatArray, face: IntArray, side: int) -> IntArray:
    """An equal grid of side x side points on each face: of the candidates the nearest to its nodes.

    Parameters
    ----------
    surface_p : (m, 3) points of the candidates, in one frame.
    face : (m,) the face that each lies on; grids fill the rectangle, along the principal axes of the face,
        that its candidates span.
    side : points along each edge of a face, at most 64; at least 1 (its middle).
    """
    if not 1 <= side <= _TIGHTEST:
        raise EstimationError(f"A pattern with {side} points a side", f"Ask for 1 to {_TIGHTEST}")
    chosen: list[int] = []
    for each in np.unique(face):
        rows = np.flatnonzero(face == each)
        flat, low, high = _flattened(surface_p[rows])
        steps = np.linspace(0.0, 1.0, side) if side > 1 else np.array([0.5])
        nodes = low + np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2) * (
            high - low
        )
        chosen += rows[_nearest_distinct(flat, nodes)].tolist()
    return np.array(chosen, dtype=np.intp)


def extreme_points(rows: FloatArray, face: IntArray, count: int) -> IntArray:
    """The thesis's rule: on each face the candidates at the extremes of its control parameters, in turn.

    The control parameters of a face are the columns of the Jacobian that vary over it (for a plane two lever
    arms), each taken at its minimum and at its maximum; further points gather around these corners. The signs
    that are printed wrongly in (122), (124) and (130) change no extreme.

    Parameters
    ----------
    rows : (m, n) derivative of each candidate's residual by the state; face : (m,).

    Source: Sallinen (2003), eq. (115) and (122) to (131).
    """
    _require(len(rows), count)
    order: list[list[int]] = []
    for each in np.unique(face):
        mine = np.flatnonzero(face == each)
        low, high = rows[mine].min(axis=0), rows[mine].max(axis=0)
        spread = high - low
        control = np.flatnonzero(spread > _FLAT * max(float(spread.max()), 1e-300))
        scaled = (rows[mine][:, control] - low[control]) / spread[control]
        corners = np.array(list(np.ndindex(*(2,) * min(len(control), 6))), dtype=np.float64)
        distance = np.linalg.norm(scaled[:, None, : corners.shape[1]] - corners, axis=2)
        # Corners differ in how near a candidate comes to them: those that exist (a plane has four) first.
        real = np.argsort(distance.min(axis=0), kind="stable")[:4]
        ranked = [mine[np.argsort(distance[:, corner], kind="stable")].tolist() for corner in real]
        order += ranked
    chosen: list[int] = []
    taken: set[int] = set()
    while len(chosen) < count:
        for queue in order:
            fresh = next((candidate for candidate in queue if candidate not in taken), None)
            if fresh is not None and len(chosen) < count:
                taken.add(fresh)
                chosen.append(fresh)
    return np.array(chosen, dtype=np.intp)


def generate_and_test(
    rows: FloatArray, count: int, cost: Cost, random: np.random.Generator, tries: int = 200
) -> IntArray:
    """The best of many random sets. Source: Sallinen (2003), section 4.2."""
    sets = [random_set(len(rows), count, random) for _ in range(tries)]
    return min(sets, key=lambda chosen: cost(rows[chosen]))


def annealed(
    rows: FloatArray,
    count: int,
    cost: Cost,
    random: np.random.Generator,
    moves: int = 2000,
    temperature: float | None = None,
    chain: int = 20,
    speed: float = 1.0,
) -> IntArray:
    """Simulated annealing: one measurement after the other replaced at random, under a falling temperature.

    T_k = T0 ln 2 / ln(l speed + 2) with l = truncate(k / chain).

    Parameters
    ----------
    temperature : T0; by default the spread of the cost over random sets.

    Source: Sallinen (2003), eq. (33).
    """
    chosen = random_set(len(rows), count, random)
    if temperature is None:
        costs = [cost(rows[random_set(len(rows), count, random)]) for _ in range(20)]
        finite = [value for value in costs if np.isfinite(value)]
        temperature = float(np.std(finite)) if finite else 1.0
    now = cost(rows[chosen])
    best, least = chosen.copy(), now
    for move in range(moves):
        heat = temperature * np.log(2.0) / np.log(move // chain * speed + 2.0)
        fresh = int(random.integers(len(rows)))
        if fresh in chosen:
            continue
        trial = chosen.copy()
        trial[random.integers(count)] = fresh
        value = cost(rows[trial])
        if value <= now or random.uniform() < np.exp((now - value) / max(heat, 1e-300)):
            chosen, now = trial, value
            if now < least:
                best, least = chosen.copy(), now
    return best


def _flattened(surface_p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (m, 2) along the two longest principal axes of a face, and the rectangle that they span."""
    centred = surface_p - surface_p.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2] if len(centred) > 2 else np.eye(3)
    flat = centred @ axes[:2].T
    return flat, flat.min(axis=0), flat.max(axis=0)


def _nearest_distinct(flat: FloatArray, nodes: FloatArray) -> list[int]:
    """Of points (m, 2) the nearest to each node (k, 2) that no node before it took."""
    if len(nodes) > len(flat):
        raise EstimationError(
            f"A pattern of {len(nodes)} points on a face with {len(flat)} candidates", "Draw more candidates"
        )
    tree = KDTree(flat)
    taken: list[int] = []
    for node in nodes:
        near = 8
        while True:
            ranked = np.atleast_1d(tree.query(node, k=min(near, len(flat)))[1])
            fresh = next((int(point) for point in ranked if point not in taken), None)
            if fresh is not None:
                taken.append(fresh)
                break
            near *= 4
    return taken


def _require(candidates: int, count: int) -> None:
    if count > candidates:
        raise EstimationError(
            f"{candidates} reachable measurements, {count} wanted", "Ask for fewer, or draw more candidates"
        )
