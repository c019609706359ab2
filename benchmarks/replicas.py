"""Monte Carlo: 2000 replicas of a hand-eye with 28 poses, 1000 of a pose from 26 points on a cube."""

from collections.abc import Callable

import numpy as np

from benchmarks import cube_peers, laser_peers
from benchmarks.harness import Row, medians, peak_mb
from estimation.replicas.hand_eye import plane_hand_eye
from estimation.replicas.plane_pose import plane_poses
from estimation.transform import FloatArray, log_pose
from tests.estimation.cube_plans import cube_plan
from tests.estimation.laser_plans import laser_plan

TITLE = "Monte Carlo"
WORDS = (
    "The peers' loops run over 100 of the replicas, from the truth; their times are scaled. Ours "
    "solves all of them. Error and cost are the worst of the 100; off the truth is the standard "
    "deviation over all replicas over the predicted one, its largest freedom."
)
LOOPED = 100


def rows() -> list[Row]:
    """Each task against each peer."""
    return [*_hand_eye(2000), *_cube(1000)]


def _hand_eye(count: int) -> list[Row]:
    plan = laser_plan(count)
    peer = laser_peers.Peer(plan)
    start = (plan.origin_m, plan.beam, plan.normal, plan.offset_m)
    fixed = (np.zeros_like(plan.weights), 1.0 / plan.weights)  # weights as the peers have them

    def ours() -> object:
        return plane_hand_eye(plan.rotations, plan.positions_m, plan.ranges_m, fixed, start)

    found = plane_hand_eye(plan.rotations, plan.positions_m, plan.ranges_m, fixed, start)
    jacobian = peer.linear(peer.start, plan.ranges_m[0])[1]
    deviations = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    own = np.array(
        [
            peer.coordinates(*each)
            for each in zip(found.origin_m, found.beam, found.normal, found.offset_m, strict=True)
        ]
    )
    spread = float(np.max(own.std(axis=0) / deviations))
    out = []
    for name, solve in (("gtsam, stacked", peer.by_gtsam), ("scipy lm, analytic Jacobian", peer.by_scipy)):
        off, excess = 0.0, -np.inf
        for x, ranges in zip(own[:LOOPED], plan.ranges_m, strict=False):
            off = max(off, float(np.max(np.abs(x - peer.tight(x, ranges)) / deviations)))
            costs = [float(np.sum(peer.linear(each, ranges)[0] ** 2)) for each in (x, solve(ranges))]
            excess = max(excess, costs[0] / costs[1] - 1.0)
        task = f"hand-eye, {count} replicas of 28"
        out.append(_row(task, name, 100.0, count, ours, solve, plan.ranges_m, (off, excess, spread)))
    return out


def _cube(count: int) -> list[Row]:
    plan = cube_plan(count)
    peer = cube_peers.Peer(plan)

    def ours() -> object:
        return plane_poses(plan.base_p, plan.normals, plan.offsets_m, plan.weights, plan.base_T_cube)

    found = plane_poses(plan.base_p, plan.normals, plan.offsets_m, plan.weights, plan.base_T_cube)
    deviations = np.sqrt(np.diag(found.covariance))
    own = np.tile(np.eye(4), (count, 1, 1))
    own[:, :3, :3], own[:, :3, 3] = found.rotations, found.origins_m
    apart = np.array([log_pose(np.linalg.inv(plan.base_T_cube.matrix) @ pose) for pose in own])
    spread = float(np.max(apart.std(axis=0) / deviations))
    out = []
    for name, solve in (
        ("gtsam Pose3, stacked", peer.by_gtsam),
        ("scipy lm, analytic Jacobian", peer.by_scipy),
    ):
        off, excess = 0.0, -np.inf
        for pose, points in zip(own[:LOOPED], plan.base_p, strict=False):
            gap = log_pose(np.linalg.inv(peer.tight(pose, points)) @ pose)
            off = max(off, float(np.max(np.abs(gap) / deviations)))
            costs = [float(np.sum(peer.linear(each, points)[0] ** 2)) for each in (pose, solve(points))]
            excess = max(excess, costs[0] / costs[1] - 1.0)
        task = f"cube, {count} replicas of 26"
        out.append(_row(task, name, 50.0, count, ours, solve, plan.base_p, (off, excess, spread)))
    return out


def _row(
    task: str,
    name: str,
    goal: float,
    count: int,
    ours: Callable[[], object],
    solve: Callable[[FloatArray], FloatArray],
    replicas: FloatArray,
    errors: tuple[float, float, float],
) -> Row:
    def loop() -> list[FloatArray]:
        return [solve(each) for each in replicas[:LOOPED]]

    peer_s, ours_s = medians(loop, ours)
    row = Row(task, name, goal, peer_s * count / LOOPED, ours_s, peak_mb(loop), peak_mb(ours), *errors)
    print(row, flush=True)
    return row
