"""Joint MAP estimate of a belief from observations: damped Gauss-Newton on the manifold."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from estimation.belief import Belief
from estimation.chart import Chart, prior_rows, solved, square_root, undetermined
from estimation.errors import EstimationError
from estimation.fitting import Fit, Robust, gated, reweighted, robust_start, row_variance
from estimation.model import Model, Point, Rows, evaluate
from estimation.observability import RANK_TOLERANCE, RankReport, rank_report, require_determined, spectrum_of
from estimation.posterior import After, after
from estimation.statistics import ChiSquareTest, chi_square_two_sided
from estimation.transform import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Posterior of a belief, and what is needed to judge it.

    Attributes
    ----------
    belief : posterior; contributions in Joseph form, with the noise sources of this call.
    chi2, dof : minimum of the joint cost with the prior; dof = rows + prior rows - unknowns, which is the
        rows used less the flat freedoms.
    residual_m : (m,) at the posterior, rejected rows included.
    standardised : (m,) residual over its own standard deviation, for rejected rows that of the innovation.
    leverage : (m,) from 0 (checked by the others) to 1 (believed blindly); 0 for rejected rows.
    rejected : (m,) True for rows that the outlier gate left out.
    group : consecutive rows that make one measurement.
    rank : of target and flat blocks on the data alone; None when there are none.
    costs : of each accepted iterate, one tuple for each pass with fixed noise variances; never rises in one.
    """

    belief: Belief
    chi2: float
    dof: int
    residual_m: FloatArray
    standardised: FloatArray
    leverage: FloatArray
    rejected: NDArray[np.bool_]
    group: int
    rank: RankReport | None
    iterations: int
    initial_cost: float
    final_cost: float
    costs: tuple[tuple[float, ...], ...]
    stop_reason: str

    @property
    def p_value(self) -> float:
        """Probability that honest data have a chi2 at least this large."""
        return float(chdtrc(self.dof, self.chi2)) if self.dof else 1.0

    @property
    def variance_factor(self) -> float:
        """chi2 / dof: near 1 when all the uncertainties are honest; 1 when there is no redundancy."""
        return self.chi2 / self.dof if self.dof else 1.0

    def consistency(self, level: float = 0.05) -> ChiSquareTest:
        """chi2 against its band, both ways. Raises EstimationError without redundancy."""
        return chi_square_two_sided(self.chi2, self.dof, level)

    def residual_based(self) -> Belief:
        """The posterior with all covariances times the variance factor: for noise known but for its size.

        Raises EstimationError without redundancy, where residuals say nothing of the noise.
        """
        if self.dof == 0:
            raise EstimationError(
                "As many measurements as unknowns: residuals say nothing of the noise",
                "Measure more, or use the covariance that follows from the declared noise",
            )
        contributions = self.belief.contributions
        return self.belief.replaced(
            {}, {source: self.variance_factor * matrix for source, matrix in contributions.items()}
        )


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Residuals before they are used: innovation covariance S = H P H^T + Q."""

    residual_m: FloatArray  # (m,)
    jacobian: FloatArray  # (m, n)
    noise_variance: FloatArray  # (m,) diagonal of Q, m^2
    covariance: FloatArray  # (m, m) S, m^2

    @property
    def standardised(self) -> FloatArray:
        """(m,) residuals over their own standard deviations; correlated with each other."""
        return self.residual_m / np.sqrt(np.diag(self.covariance))

    @property
    def chi2(self) -> float:
        """r^T S^-1 r, chi-square with m degrees of freedom for honest data."""
        return float(self.residual_m @ np.linalg.solve(self.covariance, self.residual_m))

    @property
    def p_value(self) -> float:
        """Probability that honest data have a chi2 at least this large."""
        return float(chdtrc(len(self.residual_m), self.chi2))


def update(
    belief: Belief,
    model: Model,
    *,
    targets: Sequence[str] = (),
    consider: Sequence[str] = (),
    phase: str = "",
    robust: Robust = "none",
    reject_level: float | None = None,
    tolerance: float = 1e-7,
    rank_tolerance: float = RANK_TOLERANCE,
) -> Update:
    """MAP estimate of all blocks from the belief as prior and the rows of the model.

    Flat freedoms start at their value in the belief, which must be near enough to roll down from, and
    come from the data and from what is known of the other blocks.

    Parameters
    ----------
    targets : blocks whose rank on the data alone is reported; flat blocks always are.
    consider : blocks that act on the residuals but are not updated (their prior must be independent of the
        others); the other blocks are weighted by the noise alone and carry what these do to them. By
        default everything is estimated jointly, which is never worse.
    phase : goes before the noise sources in the budget ("hand-eye" gives "hand-eye range noise").
    robust : loss with which the start for the outlier gate is found; "none" starts from all rows.
    reject_level : probability that an honest batch loses a row to the outlier gate; None for no gate,
        so that every row counts in full.
    tolerance : largest last step and gradient, in posterior standard deviations.
    rank_tolerance : smallest over largest singular value that counts as information.

    Raises
    ------
    DegenerateGeometry
        The data leave a direction of the flat freedoms open.
    EstimationError
        Rows that are none, not finite or of blocks that are missing; no convergence; more than 10 % of the
        observations rejected.

    Notes
    -----
    The state is r0 = [R0^T (t - t0); Log(R0^T R)] of the prior pose (ESTIMATION.md section 4), whitened by
    the prior covariance, so that B^T P0^-1 B is taken exactly and singular priors are welcome. Source:
    Sallinen (2003), eq. (46), with its missing prior residual.
    """
    if not len(model):
        raise EstimationError("No observations", "Measure before estimating")
    chart = Chart(belief, model, consider)
    z = np.zeros(belief.size)
    first = chart.evaluate(z)
    known: Point | None = first
    require_determined(belief, first[1].dense(belief), first[1].noise_variance, rank_tolerance)
    if robust != "none":
        z, known = robust_start(chart, z, robust), None
    if reject_level is None:
        fit = reweighted(chart, z, np.ones(len(model), dtype=np.bool_), tolerance, known)
        fit.require_converged()
    else:
        fit = gated(chart, z, robust, reject_level, tolerance)
    return _result(chart, fit, targets, phase, rank_tolerance)


def predict(belief: Belief, model: Model) -> Prediction:
    """What the belief expects of the measurements, without using them. No freedom may be flat."""
    rows = evaluate(belief, model)
    jacobian, variance = rows.dense(belief), rows.noise_variance
    covariance = jacobian @ belief.covariance @ jacobian.T
    covariance = 0.5 * (covariance + covariance.T) + np.diag(variance)
    return Prediction(rows.residual_m, jacobian, variance, covariance)


def information_rows(belief: Belief, model: Model) -> tuple[FloatArray, FloatArray]:
    """(H (m, n), diagonal of Q (m,)) at the belief's values: rank-one pieces for a planner."""
    rows = evaluate(belief, model)
    return rows.dense(belief), rows.noise_variance


def predicted_belief(belief: Belief, model: Model, phase: str = "") -> Belief:
    """The belief with the covariance that the measurements would leave, at its present values.

    Raises DegenerateGeometry when they leave a direction of the flat freedoms open.
    """
    rows = evaluate(belief, model)
    dense, variance = rows.dense(belief), row_variance(rows)
    require_determined(belief, dense, variance)
    root, used = square_root(belief.prior_covariance), np.ones(len(rows.residual_m), dtype=np.bool_)
    prior = prior_rows(belief, root)
    return belief.replaced(
        {}, _posterior(belief, root, prior, np.eye(belief.size), rows, dense, variance, used, phase)[0]
    )


def _result(chart: Chart, fit: Fit, targets: Sequence[str], phase: str, rank_tolerance: float) -> Update:
    belief, rows, used = chart.belief, fit.rows, fit.used
    values, poses = chart.at(fit.z)
    to_body = np.eye(belief.size)  # B^-1
    for name, inverse in poses.items():
        place = belief.index(name)
        to_body[place, place] = inverse[belief.block(name).active]
    dense, variance = rows.dense(belief), row_variance(rows)
    kept, kept_variance = dense[used], variance[used]
    flat = [block.name for block in belief.blocks if block.flat and block.name not in targets]
    columns = belief.columns((*targets, *flat))
    spectrum = spectrum_of(belief, kept, kept_variance, columns, rank_tolerance) if len(columns) else None
    if spectrum is not None and len(spectrum.null):  # is it the flat freedoms that are open?
        require_determined(belief, kept, kept_variance, rank_tolerance)
    contributions, leverage, standardised = _posterior(
        belief,
        chart.root,
        chart.prior_rows,
        to_body,
        rows,
        dense,
        variance,
        used,
        phase,
        after if chart.compiled is None else chart.compiled.after,
    )
    posterior = belief.replaced(values, contributions)
    final = _joint_chi2(chart, fit, to_body, kept, kept_variance)
    return Update(
        belief=posterior,
        chi2=final,
        dof=int(np.count_nonzero(used) - np.count_nonzero(belief.flat)),
        residual_m=rows.residual_m,
        standardised=standardised,
        leverage=leverage,
        rejected=~used,
        group=rows.group,
        rank=None if spectrum is None else rank_report(belief, posterior, spectrum),
        iterations=sum(len(course) - 1 for course in fit.costs),
        initial_cost=fit.costs[0][0],
        final_cost=final,
        costs=fit.costs,
        stop_reason=fit.stop_reason,
    )


def _posterior(
    belief: Belief,
    root: FloatArray,
    prior: FloatArray,
    to_body: FloatArray,
    rows: Rows,
    dense: FloatArray,
    variance: FloatArray,
    used: NDArray[np.bool_],
    phase: str,
    run: After = after,
) -> tuple[dict[str, FloatArray], FloatArray, FloatArray]:
    """Contributions by source after an update, leverage (m,) and standardised residuals (m,)."""
    size, residual = belief.size, rows.residual_m
    if not size:
        return {}, np.zeros(len(used)), residual / np.sqrt(variance)
    before = np.array(list(belief.contributions.values())).reshape(len(belief.contributions), size, size)
    noise = {source: own for source, own in rows.noise.items() if own[used].any()}
    variances = np.array(list(noise.values())).reshape(len(noise), len(used))
    try:
        left, added, leverage, standardised = run(
            root, prior, to_body, dense, variance, used, before, variances, residual
        )
    except np.linalg.LinAlgError as error:
        raise undetermined() from error
    contributions = dict(zip(belief.contributions, left, strict=True))
    for source, matrix in zip(noise, added, strict=True):
        label = f"{phase} {source}".strip()
        contributions[label] = contributions[label] + matrix if label in contributions else matrix
    return contributions, leverage, standardised


def _joint_chi2(
    chart: Chart, fit: Fit, to_body: FloatArray, dense: FloatArray, variance: FloatArray
) -> float:
    """Minimum of the joint cost; with considered blocks, that of its linear model with them free."""
    residual = fit.rows.residual_m[fit.used] / np.sqrt(variance)
    at_minimum = float(residual @ residual + fit.z @ (chart.prior_rows * fit.z))
    if not chart.considers:
        return at_minimum
    innovation = residual - (fit.jacobian[fit.used] @ fit.z) / np.sqrt(variance)
    root = square_root(chart.belief.prior_covariance)
    prior = prior_rows(chart.belief, root)
    whitened = dense @ to_body @ root / np.sqrt(variance)[:, None]
    projected = whitened.T @ innovation
    return float(
        innovation @ innovation - projected @ solved(whitened.T @ whitened + np.diag(prior), projected)
    )
