"""Joint noise at poses never measured, predicted from scatter at some poses, with its own uncertainty."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.special import digamma, polygamma

from estimation.errors import EstimationError
from estimation.transform import FloatArray

_LEAST_DOF: Final = 3.0  # fewer, and the logarithm of a variance is too skew for a normal model
_LEAST_POSES: Final = 8
_LENGTHS_RAD: Final = (0.1, 6.0)  # correlation length in joint space
_AMPLITUDES: Final = (1e-3, 3.0)  # standard deviation of the logarithm of the variance between poses


@dataclass(frozen=True, slots=True, eq=False)
class NoisePrediction:
    """Noise of each joint at some poses.

    Attributes
    ----------
    variance : (p, j), rad^2: geometric mean of what the model holds possible.
    log_std : (p, j), standard uncertainty of the natural logarithm of the variance.
    """

    variance: FloatArray
    log_std: FloatArray

    @property
    def dof(self) -> FloatArray:
        """(p, j) of a sample variance that would be as uncertain: trigamma(dof/2) = log_std^2."""
        return _dof_of(self.log_std**2)

    def interval(self, factor: float = 1.96) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (p, j), rad, between which the noise lies; 95 % by default."""
        half = 0.5 * factor * self.log_std
        std = np.sqrt(self.variance)
        return std * np.exp(-half), std * np.exp(half)


@dataclass(frozen=True, slots=True, eq=False)
class PoseNoiseModel:
    """A Gaussian process for the logarithm of each joint's variance over joint space; build it with `fit`.

    Far from every measured pose it returns to the mean over all poses, with the spread between poses as its
    uncertainty: it knows where it does not know.
    """

    joints_rad: FloatArray  # (n, a), measured poses
    mean: FloatArray  # (j,) of the logarithm of the variance
    amplitude: FloatArray  # (j,) its standard deviation between poses
    length_rad: FloatArray  # (j,)
    _weights: FloatArray  # (j, n) K^-1 (y - mean)
    _roots: FloatArray  # (j, n, n) Cholesky factors of K

    @staticmethod
    def fit(joints_rad: FloatArray, variance: FloatArray, dof: FloatArray) -> "PoseNoiseModel":
        """From sample variances of repeated readings.

        Parameters
        ----------
        joints_rad : (n, a), the poses at which was measured.
        variance : (n, j), rad^2, sample variance of each joint there.
        dof : (n,), degrees of freedom of each sample variance.

        Raises
        ------
        EstimationError
            Fewer than 8 poses, fewer than 3 degrees of freedom at a pose, a joint that does not scatter.

        Notes
        -----
        The logarithm of a sample variance has the mean log(sigma^2) + digamma(dof/2) - log(dof/2) and the
        variance trigamma(dof/2), whatever sigma is: the sampling error is known, and what is left between
        poses is learnt (amplitude and length by maximum marginal likelihood, the mean integrated out).
        """
        poses, seen = np.atleast_2d(joints_rad), np.atleast_2d(variance)
        half = 0.5 * np.broadcast_to(np.asarray(dof, dtype=np.float64), (len(poses),))
        if len(poses) < _LEAST_POSES or seen.shape[0] != len(poses):
            raise EstimationError(
                f"Noise of {len(seen)} poses, with joint angles of {len(poses)}",
                f"Measure the scatter at {_LEAST_POSES} poses or more",
            )
        if 2.0 * half.min() < _LEAST_DOF:
            raise EstimationError(
                f"A scatter with {2.0 * half.min():.0f} degrees of freedom",
                f"Repeat each reading at least {_LEAST_DOF + 1:.0f} times",
            )
        if not (np.isfinite(poses).all() and np.isfinite(seen).all() and (seen > 0.0).all()):
            raise EstimationError(
                "A joint that does not scatter, or numbers that are not finite",
                "Is the encoder step larger than the noise? Add its variance step^2/12",
            )
        y = np.log(seen) - (digamma(half) - np.log(half))[:, None]
        sampling = np.asarray(polygamma(1, half), dtype=np.float64)
        apart = _apart(poses, poses)
        found = [_fit_one(apart, y[:, j], sampling) for j in range(y.shape[1])]
        amplitude, length = (np.array([each[i] for each in found]) for i in (0, 1))
        kernels = [
            _kernel(apart, a, scale) + np.diag(sampling) for a, scale in zip(amplitude, length, strict=True)
        ]
        roots = np.array([cholesky(kernel, lower=True) for kernel in kernels])
        mean = np.array([_mean(root, y[:, j])[0] for j, root in enumerate(roots)])
        weights = np.array([cho_solve((root, True), y[:, j] - mean[j]) for j, root in enumerate(roots)])
        return PoseNoiseModel(poses, mean, amplitude, length, weights, roots)

    def predict(self, joints_rad: FloatArray) -> NoisePrediction:
        """Noise at poses (p, a), radians."""
        apart = _apart(np.atleast_2d(joints_rad), self.joints_rad)
        log_variance = np.empty((len(apart), len(self.mean)))
        uncertainty = np.empty_like(log_variance)
        for j, root in enumerate(self._roots):  # a handful of joints
            cross = _kernel(apart, self.amplitude[j], self.length_rad[j])
            log_variance[:, j] = self.mean[j] + cross @ self._weights[j]
            whitened = solve_triangular(root, cross.T, lower=True)
            ones = solve_triangular(root, np.ones(len(root)), lower=True)
            # the mean is estimated too: its error counts where the data do not hold the prediction
            left = 1.0 - ones @ whitened
            variance = (
                self.amplitude[j] ** 2 - np.einsum("np,np->p", whitened, whitened) + left**2 / (ones @ ones)
            )
            uncertainty[:, j] = np.sqrt(np.maximum(variance, 0.0))
        return NoisePrediction(np.exp(log_variance), uncertainty)


def _fit_one(apart: FloatArray, y: FloatArray, sampling: FloatArray) -> tuple[float, float]:
    """Amplitude and length (rad) of the largest restricted likelihood."""

    def cost(logs: FloatArray) -> float:
        kernel = _kernel(apart, np.exp(logs[0]), np.exp(logs[1])) + np.diag(sampling)
        root = cholesky(kernel, lower=True)
        mean, weight = _mean(root, y)
        residual = solve_triangular(root, y - mean, lower=True)
        return float(residual @ residual + 2.0 * np.sum(np.log(np.diag(root))) + np.log(weight))

    bounds = [tuple(np.log(_AMPLITUDES)), tuple(np.log(_LENGTHS_RAD))]
    starts = [np.log([amplitude, length]) for amplitude in (0.1, 0.8) for length in (0.4, 1.5)]
    runs = [minimize(cost, start, method="L-BFGS-B", bounds=bounds) for start in starts]
    best = min(runs, key=lambda run: float(run.fun))
    return float(np.exp(best.x[0])), float(np.exp(best.x[1]))


def _mean(root: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Generalised least-squares mean, and its information."""
    ones = solve_triangular(root, np.ones(len(y)), lower=True)
    return float(ones @ solve_triangular(root, y, lower=True) / (ones @ ones)), float(ones @ ones)


def _kernel(apart: FloatArray, amplitude: float, length: float) -> FloatArray:
    """Matern 5/2: noise changes smoothly with the pose, but not infinitely so."""
    scaled = np.sqrt(5.0) * apart / length
    return np.asarray(amplitude**2 * (1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled))


def _apart(a: FloatArray, b: FloatArray) -> FloatArray:
    """Distances (p, n) in joint space, rad."""
    return np.asarray(np.sqrt(np.sum((a[:, None, :] - b[None, :, :]) ** 2, axis=-1)))


def _dof_of(log_variance: FloatArray) -> FloatArray:
    """Inverse of trigamma(dof / 2), by Newton from its asymptotes."""
    target = np.maximum(log_variance, 1e-12)
    half = np.where(target > 1.0, 1.0 / np.sqrt(target), 0.5 + 1.0 / target)
    for _ in range(20):
        half = half * np.exp((polygamma(1, half) - target) / (-half * polygamma(2, half)))
    return 2.0 * half
