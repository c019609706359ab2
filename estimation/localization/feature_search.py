"""Where an object can be when each point names the feature that it lies on: a search over all rotations."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.localization.descent import descend, distinct
from estimation.surfaces import Feature, feature_table, signed_distance
from estimation.tasks.starts import rotations
from estimation.transform import FloatArray

_POINTS: Final = 60  # of all that were measured: more would not tell more of where to begin
_ROTATIONS: Final = 576
_ROUNDS: Final = ((8, 150), (25, 40), (40, 40))  # steps, and how many poses are left for the next
_QUICK_POINTS: Final = 40
_QUICK_ROUNDS: Final = ((8, 40), (25, 8), (20, 8))
_SAME: Final = 5e-3  # of the size: two minima closer than this are one
_CROWDED: Final = 2e-2
_SMALLEST_SIZE_M: Final = 0.05


def search_features(
    features: tuple[Feature, ...],
    index: NDArray[np.intp],
    base_p: FloatArray,
    count: int = 12,
    quick: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Distinct poses of an object whose features some points lie on; no start is needed.

    Parameters
    ----------
    index : (m,) place in `features` of the feature that each point lies on.
    base_p : (m, 3), metres.
    quick : a third of the time, where only the best pose is of interest, and that only if it fits well.

    Returns base_T_object (k, 4, 4), the most likely first, and the mean square distance (k,), m^2.
    """
    chosen = _spread_over(index)[: _QUICK_POINTS if quick else _POINTS]
    points, index = base_p[chosen], index[chosen]
    middle = np.array([_middle(feature) for feature in features])[index]
    table = feature_table(features)
    at_rest = np.zeros(table.offset.shape[1])

    def distance(object_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = signed_distance(
            features, np.tile(index, len(object_p)), object_p.reshape(-1, 3) + _OFF_AXIS_M, at_rest
        )
        return found.distance_m.reshape(object_p.shape[:2]), found.gradient.reshape(object_p.shape)

    turns = rotations(_ROTATIONS)
    poses = np.zeros((len(turns), 4, 4))
    poses[:, :3, :3], poses[:, 3, 3] = turns, 1.0
    poses[:, :3, 3] = points.mean(axis=0) - turns @ middle.mean(axis=0)
    size_m = max(float(np.ptp(points, axis=0).max()), _SMALLEST_SIZE_M)
    for steps, keep in _QUICK_ROUNDS if quick else _ROUNDS:
        poses, square = descend(poses, points, distance, steps)
        # Not simply the lowest: one minimum to which many roll quickly must not crowd out the others.
        best = distinct(poses, square, _CROWDED * size_m, size_m, keep)
        poses, square = poses[best], square[best]
    left = distinct(poses, square, _SAME * size_m, size_m, count)
    return poses[left], square[left]


_OFF_AXIS_M: Final = np.array([1.1e-9, 1.3e-9, 1.7e-9])  # where the mean of the features is on an axis


def _middle(feature: Feature) -> FloatArray:
    if feature.shape is None:
        return np.asarray(feature.point_m)
    return np.asarray(feature.shape.coarse.vertices_m.mean(axis=0))


def _spread_over(index: NDArray[np.intp]) -> NDArray[np.intp]:
    """Places, in turn from each feature, at random within it."""
    shuffled = np.random.default_rng(0).permutation(len(index))
    rank = np.empty(len(index), dtype=np.intp)
    for feature in np.unique(index):
        mine = shuffled[index[shuffled] == feature]
        rank[mine] = np.arange(len(mine))
    return np.argsort(rank, kind="stable")
