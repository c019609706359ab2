"""What users would write for the pose of a cube from points on its sides: gtsam's Pose3, or scipy."""

import gtsam
import numpy as np
from scipy.optimize import least_squares

from estimation.transform import FloatArray, exp_pose
from tests.estimation.cube_plans import CubePlan


class Peer:
    """base_T_cube as a matrix (4, 4), from the truth."""

    def __init__(self, plan: CubePlan) -> None:
        self.plan, self.root = plan, np.sqrt(plan.weights)
        self.key = gtsam.symbol("x", 0)
        self.noise = gtsam.noiseModel.Unit.Create(len(self.root))
        self.start = plan.base_T_cube.matrix

    def linear(self, pose: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n,) and Jacobian (n, 6) by a right perturbation, turns first, as gtsam has it."""
        cube_p = (points - pose[:3, 3]) @ pose[:3, :3]
        normals = self.plan.normals
        rows = -np.concatenate([np.cross(cube_p, normals), normals], axis=1)
        distance = np.einsum("ij,ij->i", cube_p, normals) - self.plan.offsets_m
        return self.root * distance, self.root[:, None] * rows

    def by_gtsam(self, points: FloatArray) -> FloatArray:
        """By Gauss-Newton, all points in one factor."""

        def error(_: object, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            residual, jacobian = self.linear(values.atPose3(self.key).matrix(), points)
            if jacobians is not None:
                jacobians[0] = jacobian
            return residual

        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.CustomFactor(self.noise, [self.key], error))
        values = gtsam.Values()
        values.insert(self.key, gtsam.Pose3(self.start))
        found = gtsam.GaussNewtonOptimizer(graph, values, gtsam.GaussNewtonParams()).optimize()
        return np.asarray(found.atPose3(self.key).matrix())

    def by_scipy(self, points: FloatArray) -> FloatArray:
        """By Levenberg-Marquardt, in the turns and shifts from the start, which are small."""

        def at(x: FloatArray) -> FloatArray:
            return np.asarray(self.start @ exp_pose(np.concatenate([x[3:], x[:3]])))

        found = least_squares(
            lambda x: self.linear(at(x), points)[0],
            np.zeros(6),
            lambda x: self.linear(at(x), points)[1],  # of the perturbation there: equal to first order
            method="lm",
        )
        return at(found.x)

    def tight(self, pose: FloatArray, points: FloatArray) -> FloatArray:
        """The optimum to the last digit, from near it."""
        for _ in range(10):
            residual, jacobian = self.linear(pose, points)
            step = -np.linalg.lstsq(jacobian, residual)[0]
            pose = pose @ exp_pose(np.concatenate([step[3:], step[:3]]))
        return pose
