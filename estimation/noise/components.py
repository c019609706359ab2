"""Variance components: which joint or sensor the scatter of repeated measurements comes from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

from estimation.errors import DegenerateGeometry, EstimationError
from estimation.transform import FloatArray

_MOST_STEPS: Final = 200
_CONVERGED: Final = 1e-9  # step, relative to the standard uncertainty of each component
_SEPARABLE: Final = 5e-3  # smallest eigenvalue of the scaled information: below it, a split is arbitrary


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Sample covariances of repeated measurements, each at a pose of its own.

    Attributes
    ----------
    covariance : (n, m, m), unit^2, of m simultaneous values about their mean: 1 for a range, 6 for a pose.
    dof : (n,) repetitions less one.
    """

    covariance: FloatArray
    dof: FloatArray

    def __post_init__(self) -> None:
        shape = self.covariance.shape
        if len(shape) != 3 or shape[1] != shape[2] or self.dof.shape != shape[:1] or not shape[0]:
            raise EstimationError(
                f"Scatter of shape {shape} with degrees of freedom of shape {self.dof.shape}",
                "Give (n, m, m) covariances and (n,) degrees of freedom",
            )
        if not (np.isfinite(self.covariance).all() and np.isfinite(self.dof).all() and (self.dof > 0).all()):
            raise EstimationError(
                "Scatter with entries that are not finite, or of single measurements",
                "Repeat each measurement at least once",
            )

    @staticmethod
    def of_repeats(values: Sequence[FloatArray]) -> "Scatter":
        """From the repeats at each pose, (k_i, m) or (k_i,) each; the mean of each pose is taken off.

        Raises EstimationError where a pose has fewer than two repeats.
        """
        tables = [np.asarray(each, dtype=np.float64).reshape(len(each), -1) for each in values]
        short = [i for i, table in enumerate(tables) if len(table) < 2]
        if short or not tables:
            raise EstimationError(
                f"Pose {short[0] + 1} was measured once" if short else "No repeated measurements",
                "Measure each pose at least twice",
            )
        covariance = [np.atleast_2d(np.cov(table, rowvar=False)) for table in tables]
        return Scatter(np.array(covariance), np.array([len(table) - 1.0 for table in tables]))


@dataclass(frozen=True, slots=True, eq=False)
class VarianceComponents:
    """Variance of each source, with what is known of it.

    Attributes
    ----------
    variance, u : (k,), unit^2 of the source: estimate and its standard uncertainty.
    covariance : (k, k) of the estimates, inverse of the Fisher information.
    clamped : (k,) whether the likelihood wanted a negative variance, so that it was set to zero.
    """

    names: tuple[str, ...]
    variance: FloatArray
    covariance: FloatArray
    clamped: tuple[bool, ...]
    log_likelihood: float
    iterations: int

    @property
    def std(self) -> FloatArray:
        """Standard deviations (k,) of the sources."""
        return np.sqrt(self.variance)

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties (k,) of the variances."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def dof(self) -> FloatArray:
        """(k,) effective degrees of freedom 2 (variance / u)^2, by which a gate widens its factor."""
        return 2.0 * self.variance**2 / np.maximum(np.diag(self.covariance), np.finfo(float).tiny)

    def noisier_than(self, declared_std: FloatArray, level: float = 0.01) -> tuple[str, ...]:
        """Sources whose variance exceeds the declared one significantly, the worst first.

        `level` is the probability that any source of an honest cell is named (Bonferroni), one-sided.
        """
        declared = np.asarray(declared_std, dtype=np.float64) ** 2
        ratio = self.variance / declared
        # of an honest source: its own information at the declared variance, as chi-square
        dof = np.maximum(2.0 * declared**2 / np.maximum(np.diag(self.covariance), 1e-300), 1.0)
        dof = np.minimum(dof, np.maximum(self.dof, 1.0))
        limit = chdtri(dof, level / len(self.names)) / dof
        order = np.argsort(-ratio / limit)
        return tuple(self.names[i] for i in order if ratio[i] > limit[i])


def variance_components(scatter: Scatter, cofactors: FloatArray, names: Sequence[str]) -> VarianceComponents:
    """Maximum-likelihood variances of sources that add up: Sigma_i = sum_k variance_k Q_ik.

    Parameters
    ----------
    cofactors : (n, k, m, m): what a unit variance of source k puts into the covariance at pose i. For joint j
        it is J_j J_j^T with the column of the Jacobian; for range noise K K^T.
    names : (k,) of the sources.

    Raises
    ------
    DegenerateGeometry
        Sources that act alike at all poses ("noise of joint 2 and joint 3 cannot be told apart").
    EstimationError
        Shapes that do not fit, or no convergence.

    Notes
    -----
    Sample covariances are Wishart distributed; the likelihood is climbed by Fisher scoring, and a variance
    that would become negative is held at zero. Source: Helmert/REML estimation of variance components, where
    taking off the mean of each pose is the restriction.
    """
    size, count = scatter.covariance.shape[1], len(names)
    if cofactors.shape != (len(scatter.dof), count, size, size) or not np.isfinite(cofactors).all():
        raise EstimationError(
            f"Cofactors of shape {cofactors.shape}, or not finite",
            f"Give {(len(scatter.dof), count, size, size)}: pose, source, row, column",
        )
    # In units of the total scatter, so that the tolerances mean the same for metres and radians.
    mean_scatter = np.einsum("n,nii->", scatter.dof, scatter.covariance) / scatter.dof.sum()
    reach = np.einsum("n,nkii->k", scatter.dof, cofactors) / scatter.dof.sum()
    if not mean_scatter > 0.0:
        raise EstimationError(
            "The repeats do not scatter at all", "Is the device frozen, or rounding its values?"
        )
    unseen = [name for name, size_ in zip(names, reach, strict=True) if not size_ > 0.0]
    if unseen:
        raise DegenerateGeometry(f"No measurement feels {unseen[0]}", "Measure poses in which it acts")
    scale = mean_scatter / reach
    climbed = _climb(scatter, cofactors * scale[:, None, None], names)
    return VarianceComponents(
        tuple(names),
        climbed.variance * scale,
        climbed.covariance * np.outer(scale, scale),
        climbed.clamped,
        climbed.log_likelihood,
        climbed.iterations,
    )


def _climb(scatter: Scatter, cofactors: FloatArray, names: Sequence[str]) -> VarianceComponents:
    """Fisher scoring with an active set of components at zero, in scaled units."""
    count = len(names)
    variance = np.full(count, 1.0 / count)
    best = _log_likelihood(scatter, cofactors, variance)
    for iteration in range(1, _MOST_STEPS + 1):
        gradient, information = _score(scatter, cofactors, variance)
        if iteration == 1:
            _check_separable(information, names)
        free = (variance > 0.0) | (gradient > 0.0)
        step = np.zeros(count)
        step[free] = np.linalg.solve(information[np.ix_(free, free)], gradient[free])
        length, tried, value = 1.0, variance, -np.inf
        while length > 1e-8:
            tried = np.maximum(variance + length * step, 0.0)
            value = _log_likelihood(scatter, cofactors, tried)
            if value >= best:
                break
            length *= 0.5
        moved = np.abs(tried - variance) * np.sqrt(np.diag(information))
        if value >= best:
            variance, best = tried, value
        if length <= 1e-8 or moved.max() < _CONVERGED:
            gradient, information = _score(scatter, cofactors, variance)
            clamped = tuple(bool(v == 0.0 and g <= 0.0) for v, g in zip(variance, gradient, strict=True))
            return VarianceComponents(tuple(names), variance, _inverse(information), clamped, best, iteration)
    raise EstimationError(
        f"The variance components did not settle in {_MOST_STEPS} steps",
        "Measure more poses, or fewer sources",
    )


def _log_likelihood(scatter: Scatter, cofactors: FloatArray, variance: FloatArray) -> float:
    """Of the Wishart distribution, without constants; -inf where the model is singular."""
    sigma = np.einsum("k,nkij->nij", variance, cofactors)
    sign, log_det = np.linalg.slogdet(sigma)
    if (sign <= 0.0).any() or not np.isfinite(log_det).all():
        return -np.inf
    trace = np.einsum("nii->n", np.linalg.solve(sigma, scatter.covariance))
    return float(-0.5 * scatter.dof @ (log_det + trace))


def _score(scatter: Scatter, cofactors: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (k,) and Fisher information (k, k) of the log likelihood."""
    sigma = np.einsum("k,nkij->nij", variance, cofactors)
    whitened = np.linalg.solve(sigma[:, None], cofactors)  # Sigma^-1 Q_k
    seen = np.linalg.solve(sigma, scatter.covariance)
    excess = seen - np.eye(seen.shape[-1])
    gradient = 0.5 * np.einsum("n,nkij,nji->k", scatter.dof, whitened, excess)
    information = 0.5 * np.einsum("n,nkij,nlji->kl", scatter.dof, whitened, whitened)
    return gradient, information


def _check_separable(information: FloatArray, names: Sequence[str]) -> None:
    """Raise DegenerateGeometry when the data cannot split the scatter between some sources."""
    length = np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information / np.outer(length, length))
    if values[0] > _SEPARABLE:
        return
    share = np.abs(vectors[:, 0])
    alike = [names[i] for i in np.argsort(-share) if share[i] > 0.3]
    if len(alike) < 2:
        return
    raise DegenerateGeometry(
        f"Noise of {', '.join(alike[:-1])} and {alike[-1]} cannot be told apart from these poses",
        "Add poses in which they act differently: stretch and fold the arm, or read the joints themselves",
    )


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
