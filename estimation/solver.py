"""Joint MAP estimate of a belief from observations: damped Gauss-Newton on the manifold."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2 as chi_square

from estimation.belief import Belief, Value
from estimation.errors import EstimationError
from estimation.kinematics import ArmModel
from estimation.measurement import Observations, Rows, evaluate, rows_at
from estimation.observability import RankReport, rank_report
from estimation.transform import FloatArray, Transform

Robust = Literal["none", "huber", "cauchy"]
LARGEST_REJECTED_SHARE: Final = 0.1
_TUNING: Final[Mapping[Robust, float]] = {"huber": 1.345, "cauchy": 2.385}  # 95 % efficient on honest noise
_LARGEST_ITERATIONS: Final = 50
_REWEIGHTINGS: Final = 4  # passes with the noise variance taken at the latest estimate
_ROBUST_PASSES: Final = 12
_SMALLEST_VARIANCE: Final = 1e-30  # m^2: a row without any noise has no finite weight
_FIRST_TOLERANCE: Final = 1e-2  # standard deviations, for passes that only prepare the next
_ROUNDING: Final = 1e-14  # of the cost
_ROUNDING_M: Final = 1e-15  # of a residual, coordinates being of the size of a metre
_POLISHING_STEPS: Final = 3
_LARGEST_DAMPING: Final = 1e12
_EYE: Final = np.eye(3)
_NEAR_START: Final = "Check that the nominal poses in the cell file are near the real ones, and the readings"


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Posterior of a belief, and what is needed to judge it.

    Attributes
    ----------
    belief : posterior; contributions in Joseph form, with the noise sources of this call.
    chi2, dof : minimum of the joint cost with the prior; dof = rows + prior rows - unknowns = rows used.
    residual_m : (m,) at the posterior, rejected rows included.
    standardised : (m,) residual over its own standard deviation, for rejected rows that of the innovation.
    leverage : (m,) from 0 (checked by the others) to 1 (believed blindly); 0 for rejected rows.
    rejected : (m,) True for rows that the outlier gate left out.
    rank : of the target blocks on the data alone; None when no targets were named.
    costs : of each accepted iterate, one tuple for each pass with fixed noise variances; never rises in one.
    """

    belief: Belief
    chi2: float
    dof: int
    residual_m: FloatArray
    standardised: FloatArray
    leverage: FloatArray
    rejected: NDArray[np.bool_]
    rank: RankReport | None
    iterations: int
    initial_cost: float
    final_cost: float
    costs: tuple[tuple[float, ...], ...]
    stop_reason: str

    @property
    def p_value(self) -> float:
        """Probability that honest data have a chi2 at least this large."""
        return float(chi_square.sf(self.chi2, self.dof)) if self.dof else 1.0

    @property
    def variance_factor(self) -> float:
        """chi2 / dof: near 1 when all the uncertainties are honest."""
        return self.chi2 / self.dof if self.dof else 1.0


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
        return float(self.residual_m @ cho_solve(cho_factor(self.covariance), self.residual_m))

    @property
    def p_value(self) -> float:
        """Probability that honest data have a chi2 at least this large."""
        return float(chi_square.sf(self.chi2, len(self.residual_m)))


def update(
    belief: Belief,
    arm: ArmModel,
    observations: Sequence[Observations],
    *,
    targets: Sequence[str] = (),
    phase: str = "",
    robust: Robust = "none",
    reject_level: float | None = None,
    tolerance: float = 1e-7,
) -> Update:
    """MAP estimate of all blocks from the belief as prior and the observations.

    Parameters
    ----------
    targets : blocks whose rank on the data alone is reported.
    phase : goes before the noise sources in the budget ("hand-eye" gives "hand-eye range noise").
    robust : loss with which the start for the outlier gate is found; "none" starts from all rows.
    reject_level : probability that an honest batch loses a row to the outlier gate; None for no gate.
        Without a gate, `robust` only chooses the start and every row counts in full in the end.
    tolerance : largest last step and gradient, in posterior standard deviations.

    Raises
    ------
    EstimationError
        Observations that are empty, not finite or of blocks that are missing; no convergence; more than
        10 % of the rows rejected.

    Notes
    -----
    The state is r0 = [R0^T (t - t0); Log(R0^T R)] of the prior pose (ESTIMATION.md section 4), whitened by
    the prior covariance, so that B^T P0^-1 B is taken exactly and singular priors are welcome. Source:
    Sallinen (2003), eq. (46), with its missing prior residual.
    """
    if not any(len(batch) for batch in observations):
        raise EstimationError("No observations", "Measure before estimating")
    problem = _Problem(belief, arm, observations)
    z = np.zeros(belief.size)
    if robust != "none":
        z = _robust_start(problem, z, robust)
    fit = _reweighted(problem, z, np.ones(problem.rows, dtype=np.bool_), tolerance)
    if reject_level is not None:
        fit = _gated(problem, fit if robust == "none" else None, z, reject_level, tolerance)
    return _result(problem, fit, targets, phase)


def predict(belief: Belief, arm: ArmModel, observations: Sequence[Observations]) -> Prediction:
    """What the belief expects of the observations, without using them."""
    rows = evaluate(belief, arm, observations)
    jacobian, variance = rows.dense(belief), rows.noise_variance
    covariance = jacobian @ belief.covariance @ jacobian.T
    covariance = 0.5 * (covariance + covariance.T) + np.diag(variance)
    return Prediction(rows.residual_m, jacobian, variance, covariance)


def information_rows(
    belief: Belief, arm: ArmModel, observations: Sequence[Observations]
) -> tuple[FloatArray, FloatArray]:
    """(H (m, n), diagonal of Q (m,)) at the belief's values: rank-one pieces for a planner."""
    rows = evaluate(belief, arm, observations)
    return rows.dense(belief), rows.noise_variance


def predicted_belief(
    belief: Belief, arm: ArmModel, observations: Sequence[Observations], phase: str = ""
) -> Belief:
    """The belief with the covariance that the observations would leave, at its present values."""
    rows = evaluate(belief, arm, observations)
    identity = np.eye(belief.size)
    return belief.replaced({}, _posterior(belief, identity, rows.dense(belief), rows.noise, phase))


_Point = tuple[FloatArray, Rows, FloatArray]  # z, rows there, Jacobian (m, n) by z


class _Problem:
    """The prior as a chart: r0 = L z with z ~ N(0, I), and rows as functions of z."""

    def __init__(self, belief: Belief, arm: ArmModel, observations: Sequence[Observations]) -> None:
        self.belief, self.arm, self.observations = belief, arm, observations
        self.root = _square_root(belief.covariance)
        self.rows = sum(len(batch) for batch in observations)

    def at(self, z: FloatArray) -> tuple[dict[str, Value], dict[str, FloatArray]]:
        """Values at z, and for each pose B^-1 (6, a): a change of r0 as a right perturbation there."""
        deviation = self.root @ z
        values: dict[str, Value] = {}
        charts: dict[str, FloatArray] = {}
        for block in self.belief.blocks:
            change = deviation[self.belief.index(block.name)]
            if isinstance(block.value, Transform):
                xi = np.zeros(6)
                xi[block.active] = change
                rotation, right = rotation_and_right_jacobian(xi[3:])
                moved = np.eye(4)
                moved[:3, :3], moved[:3, 3] = rotation, xi[:3]
                inverse = np.zeros((6, 6))
                inverse[:3, :3], inverse[3:, 3:] = rotation.T, right
                values[block.name] = Transform(
                    block.value.target, block.value.source, block.value.matrix @ moved
                )
                charts[block.name] = inverse[:, block.active]
            else:
                values[block.name] = block.value + change
        return values, charts

    def evaluate(self, z: FloatArray) -> tuple[Rows, FloatArray]:
        """Rows at z, and their Jacobian (m, n) by z."""
        values, charts = self.at(z)
        rows = rows_at(values, self.arm, self.observations)
        dense = np.zeros((self.rows, self.belief.size))
        for name, matrix in rows.jacobian.items():
            if name in self.belief:
                dense[:, self.belief.index(name)] = matrix @ charts[name] if name in charts else matrix
        if not np.isfinite(rows.residual_m).all() or not np.isfinite(dense).all():
            raise EstimationError("A residual is not a finite number", "Check joints, readings and priors")
        return rows, dense @ self.root


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    z: FloatArray
    rows: Rows
    jacobian: FloatArray  # (m, n) by z
    used: NDArray[np.bool_]
    costs: tuple[tuple[float, ...], ...]
    stop_reason: str


def _solve(
    problem: _Problem, start: _Point, weight: FloatArray, tolerance: float
) -> tuple[_Point, tuple[float, ...], str]:
    """Levenberg-Marquardt in z with fixed weights (m,) = 1/sigma per row; the prior adds |z|^2."""
    z, rows, jacobian = start
    residual = weight * rows.residual_m
    cost = float(residual @ residual + z @ z)
    costs, damping, growth, last_step, polished = [cost], 0.0, 2.0, np.inf, 0
    for _ in range(_LARGEST_ITERATIONS):
        whitened = weight[:, None] * jacobian
        normal = whitened.T @ whitened + np.eye(len(z))
        gradient = whitened.T @ residual + z
        newton = cho_solve(cho_factor(normal), -gradient)
        expected = float(-gradient @ newton)  # the undamped step squared, in posterior sigmas
        steepest = float(np.max(np.abs(gradient) / np.sqrt(np.diag(normal)), initial=0.0))
        if steepest <= tolerance and min(last_step, np.sqrt(expected)) <= tolerance:
            return (z, rows, jacobian), tuple(costs), "step and gradient small"
        if polished >= _POLISHING_STEPS:
            return (z, rows, jacobian), tuple(costs), "cost at its rounding"
        # Below the rounding of the cost no step can prove that it helps: take a few in good faith.
        rounding = _ROUNDING_M * float(np.linalg.norm(residual * weight)) + _ROUNDING * cost
        at_floor = expected <= rounding
        polished += at_floor
        while True:
            scaled = normal + damping * np.diag(np.diag(normal))
            step = newton if damping == 0.0 or at_floor else cho_solve(cho_factor(scaled), -gradient)
            trial = z + step
            trial_rows, trial_jacobian = problem.evaluate(trial)
            trial_residual = weight * trial_rows.residual_m
            trial_cost = float(trial_residual @ trial_residual + trial @ trial)
            promised = float(-step @ (2.0 * gradient + normal @ step))
            gain = (cost - trial_cost) / promised
            if trial_cost <= cost or at_floor:
                trial_cost = min(trial_cost, cost)
                break
            if damping > _LARGEST_DAMPING:
                raise EstimationError(
                    f"No step lowers the cost, gradient {steepest:.3g}, limit {tolerance:.3g}", _NEAR_START
                )
            damping, growth = max(damping * growth, 1e-3), growth * 2.0
        # Nielsen's rule: the better the linear model did, the less damping; a good step needs none.
        damping = 0.0 if gain > 0.9 else damping * max(1 / 3, 1 - (2 * gain - 1) ** 3)
        growth = 2.0
        last_step = float(np.sqrt(step @ normal @ step))
        z, rows, jacobian, residual, cost = trial, trial_rows, trial_jacobian, trial_residual, trial_cost
        costs.append(cost)
    raise EstimationError(
        f"No convergence in {_LARGEST_ITERATIONS} iterations: last step {last_step:.3g} standard deviations, "
        f"limit {tolerance:.3g}",
        _NEAR_START,
    )


def _reweighted(problem: _Problem, z: FloatArray, used: NDArray[np.bool_], tolerance: float) -> _Fit:
    """Passes with the noise variance taken at the estimate, until it stands still."""
    point: _Point = (z, *problem.evaluate(z))
    variance = _variance(point[1])
    costs: list[tuple[float, ...]] = []
    for number in range(_REWEIGHTINGS):
        # The first variance is that of the prior's values: no use in converging to the last digit with it.
        limit = tolerance if number else max(tolerance, _FIRST_TOLERANCE)
        point, course, reason = _solve(problem, point, used / np.sqrt(variance), limit)
        costs.append(course)
        latest = _variance(point[1])
        settled = np.max(np.abs(latest / variance - 1.0)) < tolerance
        variance = latest
        if settled and number:
            break
    return _Fit(*point, used, tuple(costs), reason)


def _robust_start(problem: _Problem, z: FloatArray, robust: Robust) -> FloatArray:
    """Iteratively reweighted least squares; only a start, so loose and few passes."""
    limit = _TUNING[robust]
    point: _Point = (z, *problem.evaluate(z))
    for _ in range(_ROBUST_PASSES):
        before, rows, _ = point
        sigma = np.sqrt(_variance(rows))
        size = np.abs(rows.residual_m) / sigma / limit
        weight = np.maximum(size, 1.0) ** -0.5 if robust == "huber" else (1.0 + size**2) ** -0.5
        point = _solve(problem, point, weight / sigma, _FIRST_TOLERANCE)[0]
        if np.max(np.abs(point[0] - before), initial=0.0) < _FIRST_TOLERANCE:
            break
    return point[0]


def _gated(problem: _Problem, fit: _Fit | None, z: FloatArray, level: float, tolerance: float) -> _Fit:
    """Mahalanobis gate: each row against what all the other accepted rows predict for it."""
    limit = float(chi_square.isf(level / problem.rows, 1))  # Bonferroni
    if fit is None:  # judge first at the robust start, where outliers cannot hide each other
        rows, jacobian = problem.evaluate(z)
        used = rows.residual_m**2 / _innovation_variance(rows, jacobian, None) <= limit
        fit = _reweighted(problem, z, _within_share(used), tolerance)
    for _ in range(int(LARGEST_REJECTED_SHARE * problem.rows) + 3):
        squared = _mahalanobis(fit.rows, fit.jacobian, fit.used)
        # Rows may come back, and only the worst leaves at a time: it drags honest rows over the limit.
        used = fit.used | (squared <= limit)
        worst = int(np.argmax(np.where(used, squared, -1.0)))
        used[worst] = squared[worst] <= limit
        if (_within_share(used) == fit.used).all():
            return fit
        fit = _reweighted(problem, fit.z, used, tolerance)
    return fit


def _within_share(used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    rejected, allowed = int(np.sum(~used)), int(LARGEST_REJECTED_SHARE * len(used))
    if rejected > allowed:
        raise EstimationError(
            f"{rejected} of {len(used)} measurements contradict the others, at most {allowed} may",
            "Look for a moved object, a wrong feature or a loose sensor, then measure again",
        )
    return used


def _mahalanobis(rows: Rows, jacobian: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Squared deleted residuals (m,): each row against what the other used rows predict for it."""
    variance = _variance(rows)
    spread = _spread(jacobian, variance, used)
    own = np.where(used, np.maximum(variance - spread, 1e-9 * variance), variance + spread)
    squared: FloatArray = rows.residual_m**2 / own
    return squared


def _innovation_variance(rows: Rows, jacobian: FloatArray, used: NDArray[np.bool_] | None) -> FloatArray:
    variance = _variance(rows)
    everything = np.ones(len(variance), dtype=np.bool_) if used is None else used
    return variance + _spread(jacobian, variance, everything)


def _spread(jacobian: FloatArray, variance: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Diagonal (m,) of H P H^T with the posterior P of the used rows."""
    whitened = jacobian[used] / np.sqrt(variance[used])[:, None]
    factor = cho_factor(whitened.T @ whitened + np.eye(jacobian.shape[1]))
    spread: FloatArray = np.einsum("mn,nm->m", jacobian, cho_solve(factor, jacobian.T))
    return spread


def _result(problem: _Problem, fit: _Fit, targets: Sequence[str], phase: str) -> Update:
    belief, rows, used = problem.belief, fit.rows, fit.used
    values, charts = problem.at(fit.z)
    chart = np.eye(belief.size)
    for name, inverse in charts.items():
        place = belief.index(name)
        chart[place, place] = inverse[belief.block(name).active]
    at_posterior = belief.replaced(values, belief.contributions)
    dense = rows.dense(at_posterior)
    noise = {source: variance[used] for source, variance in rows.noise.items()}
    posterior = belief.replaced(values, _posterior(belief, chart, dense[used], noise, phase))
    variance = _variance(rows)
    spread = np.einsum("mi,ij,mj->m", dense, posterior.covariance, dense, optimize=True)
    leverage = np.where(used, np.clip(spread / variance, 0.0, 1.0), 0.0)
    own = np.where(used, variance * (1.0 - leverage), variance + spread)
    standardised = np.where(
        used & (leverage > 1.0 - 1e-9), 0.0, rows.residual_m / np.sqrt(np.maximum(own, _SMALLEST_VARIANCE))
    )
    prior_cost = float(fit.z @ fit.z)
    final = float(np.sum(rows.residual_m[used] ** 2 / variance[used])) + prior_cost
    return Update(
        belief=posterior,
        chi2=final,
        dof=int(np.sum(used)),
        residual_m=rows.residual_m,
        standardised=standardised,
        leverage=leverage,
        rejected=~used,
        rank=rank_report(belief, posterior, dense[used], variance[used], targets) if targets else None,
        iterations=sum(len(course) - 1 for course in fit.costs),
        initial_cost=fit.costs[0][0],
        final_cost=final,
        costs=fit.costs,
        stop_reason=fit.stop_reason,
    )


def _posterior(
    belief: Belief, chart: FloatArray, dense: FloatArray, noise: Mapping[str, FloatArray], phase: str
) -> dict[str, FloatArray]:
    """Contributions after an update. Joseph form: error = (I - K H) B^-1 prior error - K noise."""
    root = chart @ _square_root(belief.covariance)
    variance = np.maximum(np.sum(list(noise.values()), axis=0), _SMALLEST_VARIANCE)
    whitened = (dense @ root) / np.sqrt(variance)[:, None]
    factor = cho_factor(whitened.T @ whitened + np.eye(belief.size))
    gain = root @ cho_solve(factor, whitened.T) / np.sqrt(variance)
    kept = (np.eye(belief.size) - gain @ dense) @ chart
    contributions = {source: kept @ matrix @ kept.T for source, matrix in belief.contributions.items()}
    for source, row_variance in noise.items():
        if row_variance.any():
            label = f"{phase} {source}".strip()
            added = (gain * row_variance) @ gain.T
            contributions[label] = contributions[label] + added if label in contributions else added
    return contributions


def _variance(rows: Rows) -> FloatArray:
    return np.maximum(rows.noise_variance, _SMALLEST_VARIANCE)


def _square_root(covariance: FloatArray) -> FloatArray:
    """L (n, n) with L L^T = covariance, which may be singular."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(std > 0.0, std, 1.0)
    correlation = covariance / np.outer(scale, scale)
    try:
        root = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:  # singular: something is known exactly
        values, vectors = np.linalg.eigh(correlation)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
    return scale[:, None] * root


def rotation_and_right_jacobian(rotation_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Exp(phi) and Jr(phi), (3, 3) each: Exp(phi + d) = Exp(phi) Exp(Jr d), to first order in d; rad."""
    x, y, z = rotation_rad.tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < 1e-3:  # the series are exact to rounding here, the closed forms are not
        first, second, third = 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        first, second = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
        third = (angle - math.sin(angle)) / (angle2 * angle)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    squared = cross @ cross
    return _EYE + first * cross + second * squared, _EYE - second * cross + third * squared
