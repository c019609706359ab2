"""Uncertainty of 100,000 points of a part, from the covariance of its pose."""

import numpy as np

from benchmarks.harness import Row, medians, peak_mb
from estimation.covariance import PoseCovariance, point_axes
from estimation.transform import FloatArray, Transform, exp_pose

TITLE = "Ellipsoids"
WORDS = (
    "Principal standard deviations of points fixed on a part; the peer is numpy with its batched "
    "eigh. Cost is the largest relative difference of the longest axis."
)
COUNT = 100_000


def rows() -> list[Row]:
    """One row."""
    rng = np.random.default_rng(6)
    root = rng.normal(size=(6, 8)) * np.array([1e-4, 2e-4, 1e-4, 2e-4, 1e-4, 3e-4])[:, None]
    pose = PoseCovariance(Transform("base", "part", exp_pose(rng.uniform(-0.5, 0.5, 6))), root @ root.T)
    points = rng.uniform(-0.2, 0.2, (COUNT, 3))

    def ours() -> FloatArray:
        return point_axes(pose, points)

    def peer() -> FloatArray:
        jacobian = np.zeros((COUNT, 3, 6))
        jacobian[:, [0, 1, 2], [0, 1, 2]] = 1.0
        x, y, z = points.T
        jacobian[:, 0, 4], jacobian[:, 0, 5] = z, -y
        jacobian[:, 1, 3], jacobian[:, 1, 5] = -z, x
        jacobian[:, 2, 3], jacobian[:, 2, 4] = y, -x
        values, _ = np.linalg.eigh(jacobian @ pose.matrix @ jacobian.swapaxes(1, 2))
        return np.asarray(np.sqrt(values[:, ::-1]))

    peer_s, ours_s = medians(peer, ours)
    apart = float(np.max(np.abs(ours()[:, 0] / peer()[:, 0] - 1.0)))
    row = Row(
        f"ellipsoids, {COUNT:,} points",
        "numpy eigh",
        None,
        peer_s,
        ours_s,
        peak_mb(peer),
        peak_mb(ours),
        cost_excess=apart,
    )
    print(row, flush=True)
    return [row]
