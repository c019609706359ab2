"""Monte Carlo of a laser's hand-eye on a plane, 2000 x 28, against loops over scipy and gtsam."""

import gtsam
import numpy as np
from scipy.optimize import least_squares

from benchmarks.harness import Row, medians, peak_mb
from estimation.replicas.hand_eye import plane_hand_eye
from estimation.transform import FloatArray
from tests.estimation.laser_plans import LaserPlan, laser_plan

GOAL = 100.0
REPLICAS = 2000
LOOPED = 100  # replicas of the peers' loops, whose time is scaled


class Peer:
    """One stacked residual with its Jacobian, from the truth, which is near every replica's solution."""

    def __init__(self, plan: LaserPlan) -> None:
        self.plan, self.root = plan, np.sqrt(plan.weights)
        self.start = np.array([*plan.origin_m, 0.0, 0.0, 0.0, 0.0, plan.offset_m])
        self.key = gtsam.symbol("x", 0)
        self.noise = gtsam.noiseModel.Unit.Create(len(self.root))

    def linear(self, x: FloatArray, ranges_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n,) and Jacobian (n, 8)."""
        plan = self.plan
        beam, by_beam = _unit(plan.beam, x[3:5])
        normal, by_normal = _unit(plan.normal, x[5:7])
        rows = normal @ plan.rotations  # R^T n
        hits = plan.rotations @ x[:3] + ranges_m[:, None] * (plan.rotations @ beam) + plan.positions_m
        columns = np.column_stack(
            [rows, ranges_m[:, None] * (rows @ by_beam), hits @ by_normal, np.full(len(rows), -1.0)]
        )
        return self.root * (hits @ normal - x[7]), self.root[:, None] * columns

    def scipy(self, ranges_m: FloatArray) -> FloatArray:
        found = least_squares(
            lambda x: self.linear(x, ranges_m)[0],
            self.start,
            lambda x: self.linear(x, ranges_m)[1],
            method="lm",
        )
        return np.asarray(found.x)

    def gtsam(self, ranges_m: FloatArray) -> FloatArray:
        def error(_: object, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            residual, jacobian = self.linear(values.atVector(self.key), ranges_m)
            if jacobians is not None:
                jacobians[0] = jacobian
            return residual

        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.CustomFactor(self.noise, [self.key], error))
        values = gtsam.Values()
        values.insert(self.key, self.start)
        found = gtsam.GaussNewtonOptimizer(graph, values, gtsam.GaussNewtonParams()).optimize()
        return np.asarray(found.atVector(self.key))


def _unit(lead: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """lead + shift along x and y, of length 1, with its derivative (3, 2)."""
    vector = lead + np.array([*shift, 0.0])
    length = np.linalg.norm(vector)
    unit = vector / length
    return unit, (np.eye(3)[:, :2] - np.outer(unit, unit[:2])) / length


def rows() -> list[Row]:
    """One row for each peer."""
    plan = laser_plan(REPLICAS)
    peer = Peer(plan)
    start = (plan.origin_m, plan.beam, plan.normal, plan.offset_m)

    fixed = (np.zeros_like(plan.weights), 1.0 / plan.weights)  # as the peers have them

    def ours() -> object:
        return plane_hand_eye(plan.rotations, plan.positions_m, plan.ranges_m, fixed, start)

    found = plane_hand_eye(plan.rotations, plan.positions_m, plan.ranges_m, fixed, start)
    deviations = np.sqrt(np.diag(found.covariance))
    out = []
    for name, solve in (("gtsam, stacked", peer.gtsam), ("scipy lm, analytic Jacobian", peer.scipy)):

        def loop(solve=solve) -> list[FloatArray]:  # type: ignore[no-untyped-def]
            return [solve(ranges) for ranges in plan.ranges_m[:LOOPED]]

        peer_s, ours_s = medians(loop, ours)
        error, excess = 0.0, 0.0
        for k, ranges in enumerate(plan.ranges_m[:LOOPED]):
            tight = solve(ranges)
            for _ in range(20):  # the peer's solution, to the last digit
                residual, jacobian = peer.linear(tight, ranges)
                tight = tight - np.linalg.lstsq(jacobian, residual)[0]
            own = np.array([*found.origin_m[k], *_shifts(found.beam[k], plan.beam)])
            own = np.array([*own, *_shifts(found.normal[k], plan.normal), found.offset_m[k]])
            error = max(error, float(np.max(np.abs(own - tight)[[0, 1, 2, 7]] / deviations[[0, 1, 2, 7]])))
            cost = float(np.sum(peer.linear(solve(ranges), ranges)[0] ** 2))
            excess = max(excess, float(np.sum(peer.linear(own, ranges)[0] ** 2)) / cost - 1.0)
        scale = REPLICAS / LOOPED
        out.append(
            Row(
                f"hand-eye, {REPLICAS} replicas of 28",
                name,
                GOAL,
                peer_s * scale,
                ours_s,
                peak_mb(loop),
                peak_mb(ours),
                error,
                excess,
            )
        )
        print(out[-1], flush=True)
    return out


def _shifts(unit: FloatArray, lead: FloatArray) -> FloatArray:
    """The inverse of `_unit`."""
    return np.asarray((unit * (lead[2] / unit[2]) - lead)[:2])
