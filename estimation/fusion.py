"""Fusion of sets of measurements: what each says adds up, in memory that does not grow with their number."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from estimation.belief import Belief
from estimation.chart import Chart, solved
from estimation.errors import EstimationError
from estimation.fitting import row_variance
from estimation.model import Model
from estimation.observability import require_determined
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What measurements say of the unknowns of a belief, linearised where its `Tangent` is.

    Attributes
    ----------
    matrix, vector : H^T Q^-1 H (n, n) and H^T Q^-1 r (n,), without the prior.
    squares, rows : r^T Q^-1 r, and the number of residuals.
    noise : H^T Q^-1 Q_s Q^-1 H (n, n) for each source s of noise: what the budget needs.
    """

    matrix: FloatArray
    vector: FloatArray
    squares: float
    rows: int
    noise: Mapping[str, FloatArray]

    def __add__(self, other: "Information") -> "Information":
        noise = dict(self.noise)
        for source, matrix in other.noise.items():
            noise[source] = noise[source] + matrix if source in noise else matrix
        return Information(
            self.matrix + other.matrix,
            self.vector + other.vector,
            self.squares + other.squares,
            self.rows + other.rows,
            noise,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Tangent:
    """Where the measurements of all sets are linearised: a deviation z (n,) from the values of a belief.

    Sets that are fused share one tangent, whatever sensor they come from; shared errors are blocks of the
    belief, and stay correlated with everything through all sets. The prior enters once, in `fused`.
    """

    belief: Belief
    z: FloatArray

    @staticmethod
    def at(belief: Belief) -> "Tangent":
        """At the values of the belief."""
        return Tangent(belief, np.zeros(belief.size))

    def see(self, model: Model, phase: str = "") -> Information:
        """What some measurements say; `phase` goes before their noise sources in the budget."""
        chart = Chart(self.belief, model)
        rows, dense = chart.linear(self.z)
        variance = row_variance(rows)
        weighted = dense / variance[:, None]
        return Information(
            dense.T @ weighted,
            weighted.T @ rows.residual_m,
            float(np.sum(rows.residual_m**2 / variance)),
            len(variance),
            {
                f"{phase} {source}".strip(): weighted.T @ (each[:, None] * weighted)
                for source, each in rows.noise.items()
                if each.any()
            },
        )

    def fused(self, seen: Information) -> "Fused":
        """Posterior of all that was seen from this tangent, and the prior.

        Raises DegenerateGeometry when it leaves a direction of the flat freedoms open.

        Source: Sallinen (2003), eq. (110-111), in one tangent space and with the prior counted once.
        """
        belief = self.belief
        values, vectors = np.linalg.eigh(seen.matrix)
        root_rows = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        require_determined(belief, root_rows, np.ones(belief.size))
        chart = Chart(belief, _NOTHING)
        root, prior = chart.root, chart.prior_rows
        whitened = root.T @ seen.matrix @ root
        normal = whitened + np.diag(prior)
        step = -solved(normal, root.T @ seen.vector + prior * self.z)
        z = self.z + step
        chi2 = seen.squares + 2.0 * step @ (root.T @ seen.vector) + step @ whitened @ step + z @ (prior * z)
        moved, poses = chart.at(z)
        to_body = np.eye(belief.size)
        for name, inverse in poses.items():
            place = belief.index(name)
            to_body[place, place] = inverse[belief.block(name).active]
        gain = root @ solved(normal, root.T)  # of H^T Q^-1 times an error
        kept = to_body @ (np.eye(belief.size) - gain @ seen.matrix)
        contributions = {source: kept @ each @ kept.T for source, each in belief.contributions.items()}
        for source, each in seen.noise.items():
            added = to_body @ gain @ each @ gain.T @ to_body.T
            contributions[source] = contributions[source] + added if source in contributions else added
        return Fused(
            belief.replaced(moved, contributions),
            float(chi2),
            seen.rows - int(belief.flat.sum()),
            float(np.sqrt(step @ normal @ step)),
            Tangent(belief, z),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """Posterior of fused sets.

    Attributes
    ----------
    belief : with contributions by source, as after an update.
    chi2, dof : of the linear model, against the full covariance.
    step_sigmas : how far the values moved, in standard deviations; what is not small asks for a second pass.
    tangent : the same prior, linearised where the values are now, for that pass.
    """

    belief: Belief
    chi2: float
    dof: int
    step_sigmas: float
    tangent: Tangent


def fuse(belief: Belief, sets: Iterable[Model], passes: int = 2) -> Fused:
    """Posterior of a belief from sets of measurements that are read one by one, `passes` times.

    sets : anything that can be run through more than once; no two sets are held at a time.

    Raises EstimationError when there is no set.
    """
    tangent = Tangent.at(belief)
    for _ in range(passes):
        total: Information | None = None
        for model in sets:
            seen = tangent.see(model)
            total = seen if total is None else total + seen
        if total is None:
            raise EstimationError("No set of measurements", "Give a list, or what can be read again")
        found = tangent.fused(total)
        tangent = found.tangent
    return found


class _Nothing:
    """No measurements: a chart of the prior alone."""

    def __len__(self) -> int:
        return 0


_NOTHING: Model = _Nothing()  # type: ignore[assignment]
