"""What users would write for a laser's hand-eye on a plane: residual and Jacobian, for gtsam or scipy."""

import gtsam
import numpy as np
from scipy.optimize import least_squares

from estimation.transform import FloatArray
from tests.estimation.laser_plans import LaserPlan


class Peer:
    """Origin, two tilts of the beam, two of the normal and the offset, from the truth or near it."""

    def __init__(self, plan: LaserPlan, start: FloatArray | None = None) -> None:
        self.plan, self.root = plan, np.sqrt(plan.weights)
        at_truth = np.array([*plan.origin_m, 0.0, 0.0, 0.0, 0.0, plan.offset_m])
        self.start = at_truth if start is None else at_truth + start
        self.key = gtsam.symbol("x", 0)
        self.noise = gtsam.noiseModel.Unit.Create(len(self.root))
        self.one = gtsam.noiseModel.Unit.Create(1)

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

    def by_scipy(self, ranges_m: FloatArray) -> FloatArray:
        """By Levenberg-Marquardt."""
        found = least_squares(
            lambda x: self.linear(x, ranges_m)[0],
            self.start,
            lambda x: self.linear(x, ranges_m)[1],
            method="lm",
        )
        return np.asarray(found.x)

    def by_gtsam(self, ranges_m: FloatArray) -> FloatArray:
        """By Gauss-Newton, all readings in one factor."""

        def error(_: object, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            residual, jacobian = self.linear(values.atVector(self.key), ranges_m)
            if jacobians is not None:
                jacobians[0] = jacobian
            return residual

        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.CustomFactor(self.noise, [self.key], error))
        return self._optimised(graph)

    def by_gtsam_each(self, ranges_m: FloatArray) -> FloatArray:
        """By Gauss-Newton, one factor for each reading."""
        graph = gtsam.NonlinearFactorGraph()
        for i in range(len(ranges_m)):
            graph.add(gtsam.CustomFactor(self.one, [self.key], self._factor(i, float(ranges_m[i]))))
        return self._optimised(graph)

    def _factor(self, i: int, range_m: float):  # type: ignore[no-untyped-def]
        rotation, position, root = self.plan.rotations[i], self.plan.positions_m[i], self.root[i]

        def error(_: object, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            x = values.atVector(self.key)
            beam, by_beam = _unit(self.plan.beam, x[3:5])
            normal, by_normal = _unit(self.plan.normal, x[5:7])
            row, hit = normal @ rotation, rotation @ (x[:3] + range_m * beam) + position
            if jacobians is not None:
                jacobians[0] = (
                    root * np.concatenate([row, range_m * (row @ by_beam), hit @ by_normal, [-1.0]])[None]
                )
            return np.array([root * (hit @ normal - x[7])])

        return error

    def _optimised(self, graph: gtsam.NonlinearFactorGraph) -> FloatArray:
        values = gtsam.Values()
        values.insert(self.key, self.start)
        found = gtsam.GaussNewtonOptimizer(graph, values, gtsam.GaussNewtonParams()).optimize()
        return np.asarray(found.atVector(self.key))

    def tight(self, x: FloatArray, ranges_m: FloatArray) -> FloatArray:
        """The optimum to the last digit, from near it."""
        for _ in range(20):
            residual, jacobian = self.linear(x, ranges_m)
            x = x - np.linalg.lstsq(jacobian, residual)[0]
        return x

    def coordinates(
        self, origin_m: FloatArray, beam: FloatArray, normal: FloatArray, offset_m: float
    ) -> FloatArray:
        """(8,) of a solution in the words of others."""
        return np.array(
            [*origin_m, *_shifts(beam, self.plan.beam), *_shifts(normal, self.plan.normal), offset_m]
        )


def _unit(lead: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """lead + shift along x and y, of length 1, with its derivative (3, 2)."""
    vector = lead + np.array([*shift, 0.0])
    length = np.linalg.norm(vector)
    unit = vector / length
    return unit, (np.eye(3)[:, :2] - np.outer(unit, unit[:2])) / length


def _shifts(unit: FloatArray, lead: FloatArray) -> FloatArray:
    """The inverse of `_unit`."""
    return np.asarray((unit * (lead[2] / unit[2]) - lead)[:2])
