"""One hand-eye: the estimator with all that its result says, against a bare optimum."""

import numpy as np

from benchmarks.harness import Row, medians, peak_mb
from benchmarks.laser_peers import Peer
from estimation.solver import Update, update
from estimation.tasks.laser import PointLaserOnPlane
from estimation.tasks.motion import Poses
from estimation.tasks.plane_chain import TIER
from estimation.tasks.solve import solve
from estimation.transform import FloatArray, Transform
from tests.estimation.laser_plans import laser_plan

TITLE = "One solution"
WORDS = (
    "The general estimator from the start that the peers have, with covariance, budget by source,"
    " chi-square, rank, leverage and standardised residuals; the peers give the optimum only. The"
    " last row is the whole task of `truecell estimate`: no start, all other minima, outlier "
    "gate, diagnosis; the peers have nothing like it. The kernel of the small solve is compiled when a "
    "process has solved 2,000 times, and then kept on disk; until then numpy gives the same numbers in "
    "some 3 ms."
)
START = np.array([2e-3, -2e-3, 1e-3, 0.01, -0.01, 0.005, 0.005, 1e-3])
SIGMA_M = 3e-5


def rows() -> list[Row]:
    """28, 280 and 2800 poses."""
    out = []
    if TIER is not None:
        TIER.compile_now()
    for count in (28, 280, 2800):
        plan = laser_plan(1, count, SIGMA_M)
        ranges, peer = plan.ranges_m[0], Peer(plan, START)
        flange = np.tile(np.eye(4), (count, 1, 1))
        flange[:, :3, :3], flange[:, :3, 3] = plan.rotations, plan.positions_m
        problem = PointLaserOnPlane(motion=Poses(flange), reading_m=ranges, std_m=SIGMA_M)
        beam = plan.beam + np.array([*START[3:5], 0.0])
        normal = plan.normal + np.array([*START[5:7], 0.0])
        normal /= np.linalg.norm(normal)
        starts = {
            "laser": _along(beam, plan.origin_m + START[:3], ("flange", "laser")),
            "plane": _along(normal, normal * (plan.offset_m + START[7]), ("base", "plane")),
        }

        def ours(problem: PointLaserOnPlane = problem, starts: dict[str, Transform] = starts) -> Update:
            return update(problem.belief().started(starts), problem.model(), targets=("laser",))

        def whole(problem: PointLaserOnPlane = problem) -> object:
            return solve(problem)

        belief = ours().belief
        laser, plate = belief.transform("laser").matrix, belief.transform("plane").matrix
        own = peer.coordinates(laser[:3, 3], laser[:3, 2], plate[:3, 2], float(plate[:3, 2] @ plate[:3, 3]))
        slope = np.einsum("nij,j,i->n", plan.rotations, laser[:3, 2], plate[:3, 2])
        solution = peer.by_gtsam(ranges)
        # The estimator takes the weights at its solution, the peers at the truth: judged with its own.
        judge = Peer(plan)
        judge.root = 1.0 / (SIGMA_M * np.abs(slope))
        jacobian = judge.linear(own, ranges)[1]
        deviations = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
        off = float(np.max(np.abs(own - judge.tight(own, ranges)) / deviations))
        costs = [float(np.sum(judge.linear(each, ranges)[0] ** 2)) for each in (own, solution)]
        truth = float(np.max(np.abs(own - Peer(plan).start) / deviations))
        peers = [
            ("gtsam, stacked by hand", peer.by_gtsam, ours, 1.0),
            ("gtsam, a factor for each reading", peer.by_gtsam_each, ours, 1.0),
            ("scipy lm, analytic Jacobian", peer.by_scipy, ours, None),
        ]
        if count == 28:
            peers.append(("gtsam, stacked by hand", peer.by_gtsam, whole, None))
        for name, bare, mine, goal in peers:
            if name.endswith("reading") and count > 280:
                continue

            def there(bare=bare, ranges: FloatArray = ranges) -> object:  # type: ignore[no-untyped-def]
                return bare(ranges)

            peer_s, ours_s = medians(there, mine, repeat=15)
            task = f"hand-eye, {count} poses" + (", the whole task" if mine is whole else "")
            out.append(
                Row(
                    task,
                    name,
                    goal if count == 28 else None,
                    peer_s,
                    ours_s,
                    peak_mb(there),
                    peak_mb(mine),
                    off,
                    costs[0] / costs[1] - 1.0,
                    truth,
                )
            )
            print(out[-1], flush=True)
    return out


def _along(axis: FloatArray, origin_m: FloatArray, names: tuple[str, str]) -> Transform:
    """A frame with its z along an axis that is nearly z already."""
    matrix, axis = np.eye(4), axis / np.linalg.norm(axis)
    matrix[:3, 0] = np.cross([0.0, 1.0, 0.0], axis)
    matrix[:3, 0] /= np.linalg.norm(matrix[:3, 0])
    matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = np.cross(axis, matrix[:3, 0]), axis, origin_m
    return Transform(*names, matrix)
