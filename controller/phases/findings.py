"""From an estimator's result to proofs, and to the numbers that people read."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from scipy.special import chdtri

from controller.gates import Proof, Verdict, worst
from controller.planning.plan import SLACK, GatedPrediction
from estimation.belief import Belief
from estimation.measurement import JOINT_NOISE, RANGE_NOISE, SURFACE, Points
from estimation.solver import Update
from estimation.statistics import Outcome, coverage_factor
from estimation.transform import FloatArray, Transform

_INDEPENDENT: Final = tuple(f" {noise}" for noise in (RANGE_NOISE, JOINT_NOISE, SURFACE))


def gated_points(points: Points, belief: Belief, names: Sequence[str]) -> list[dict[str, Any]]:
    """U, ellipsoid and budget of each point: what a gate looks at and a picture shows."""
    covariance = points.covariance(belief)
    budget = points.budget(belief)
    factor = coverage_factor(3)
    gated = []
    for i, name in enumerate(names):
        variance, axes = np.linalg.eigh(covariance[i])
        along = axes[:, -1]
        shares = {
            source: float(along @ matrix[i] @ along / variance[-1]) for source, matrix in budget.items()
        }
        gated.append(
            {
                "point": name,
                "position_m": points.points_m[i].tolist(),
                "U_m": float(factor * np.sqrt(variance[-1])),
                "axes_m": (factor * np.sqrt(np.maximum(variance, 0.0))).tolist(),
                "directions": axes.T.tolist(),
                "budget": dict(sorted(shares.items(), key=lambda item: -item[1])),
            }
        )
    return gated


def worst_point(gated: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The gated point with the largest U."""
    return max(gated, key=lambda point: float(point["U_m"]))


def uncertainty_proof(gated: Sequence[Mapping[str, Any]], limit_m: float) -> Proof:
    """The largest U held against the limit of the phase."""
    point = worst_point(gated)
    source, share = next(iter(point["budget"].items()))
    return Proof.at_most(
        "expanded uncertainty",
        point["U_m"] * 1e3,
        limit_m * 1e3,
        "mm",
        f"U (3-D, 95 %) at {point['point']}; {source} contributes {share:.0%} of the variance",
    )


def consistency_proof(update: Update, level: float, what: str = "") -> Proof:
    """Residuals against the declared noise, full covariance, both ways; an honest cell fails at `level`."""
    lower, upper = (float(chdtri(update.dof, p)) for p in (1 - level / 2, level / 2))
    inside = lower <= update.chi2 <= upper
    word = (
        "as declared"
        if inside
        else "larger than declared"
        if update.chi2 > upper
        else "smaller than declared"
    )
    return Proof(
        f"{what}chi-square of the residuals",
        update.chi2,
        upper if update.chi2 >= lower else lower,
        "",
        Outcome.OK if inside else Outcome.NOT_DECIDABLE,
        f"{update.dof} degrees of freedom, band {lower:.1f} to {upper:.1f}: residuals are {word}",
    )


def rank_proof(update: Update) -> Proof:
    """Every freedom of the target blocks is seen by the data themselves, not only by the prior."""
    missing = [] if update.rank is None else [direction.words for direction in update.rank.missing]
    return Proof(
        "directions held by no measurement",
        float(len(missing)),
        0.0,
        "",
        Outcome.NOT_DECIDABLE if missing else Outcome.OK,
        "; ".join(missing) if missing else "the data determine every freedom",
    )


def uncertainty_verdict(
    update: Update, gated: Sequence[Mapping[str, Any]], limit_m: float, what: str, level: float
) -> Verdict:
    """The gate of a phase that estimates: every freedom seen, residuals as declared, U within the limit.

    Only too large a U can be cured by measuring more of the same.
    """
    rank, consistency = rank_proof(update), consistency_proof(update, level)
    uncertainty = uncertainty_proof(gated, limit_m)
    if rank.outcome is not Outcome.OK and update.rank is not None:
        remedy = "; ".join(dict.fromkeys(direction.remedy for direction in update.rank.missing))
    elif consistency.outcome is not Outcome.OK:
        remedy = (
            "Look for a loose sensor, a moved object or a wrong noise in the cell file, then measure again"
        )
    elif uncertainty.outcome is not Outcome.OK:
        remedy = f"Reduce {next(iter(worst_point(gated)['budget']))}, or raise the limit"
    else:
        remedy = ""
    proofs = (rank, consistency, uncertainty)
    done = f"{what} known to U = {uncertainty.value:.3f} mm, limit {uncertainty.limit:.3f} mm"
    curable = rank.outcome is consistency.outcome is Outcome.OK
    return Verdict(proofs, message(proofs, done), remedy, curable)


def out_of_reach(verdict: Verdict, best: GatedPrediction, limit_m: float, left: int) -> Verdict:
    """The verdict, with the reason why the measurements that are left would be in vain."""
    source, share = by_phase(best.shares)
    problem = (
        f"cannot be met: the best {left} further measurements would reach {best.U_m * 1e3:.2f} mm, "
        f"limit {limit_m * 1e3:.2f} mm; {source} contributes {share:.0%} of the variance"
    )
    remedy = f"Reduce {source}, or raise the limit to {best.U_m * SLACK * 1e3:.2f} mm"
    return Verdict(verdict.proofs, problem, remedy, curable=False)


def by_phase(shares: Mapping[str, float]) -> tuple[str, float]:
    """The largest contribution to a variance, the noises of one phase taken together ("hand-eye")."""
    together: dict[str, float] = {}
    for source, share in shares.items():
        phase = next((source.removesuffix(noise) for noise in _INDEPENDENT if source.endswith(noise)), source)
        together[phase] = together.get(phase, 0.0) + share
    return max(together.items(), key=lambda item: item[1])


def fit_summary(update: Update) -> dict[str, Any]:
    """How the estimator came to its result."""
    return {
        "chi2": update.chi2,
        "dof": update.dof,
        "p_value": update.p_value,
        "variance_factor": update.variance_factor,
        "rejected": int(np.sum(update.rejected)),
        "iterations": update.iterations,
        "stop_reason": update.stop_reason,
        "initial_cost": update.initial_cost,
        "final_cost": update.final_cost,
        "standardised_residuals": update.standardised.tolist(),
        "residuals_m": update.residual_m.tolist(),
    }


def block_values(belief: Belief, names: Sequence[str]) -> list[dict[str, Any]]:
    """Each freedom with value and standard uncertainty, for tables."""
    rows = []
    for name in names:
        block, std = belief.block(name), belief.std(name)
        values = _freedom_values(block.value, block.freedoms)
        for freedom, unit, value, u in zip(block.freedoms, block.units, values, std, strict=True):
            rows.append({"name": f"{name} {freedom}", "value": float(value), "u": float(u), "unit": unit})
    return rows


def _freedom_values(value: Transform | FloatArray, freedoms: Sequence[str]) -> FloatArray:
    if not isinstance(value, Transform):
        return value
    from scipy.spatial.transform import Rotation

    angles = Rotation.from_matrix(value.rotation).as_euler("xyz")
    every = dict(zip(("tx", "ty", "tz", "rx", "ry", "rz"), [*value.origin_m, *angles], strict=True))
    return np.array([every[freedom] for freedom in freedoms])


def pose_dict(transform: Transform) -> dict[str, Any]:
    """A transform for JSON: frames, and the matrix in metres."""
    return {"target": transform.target, "source": transform.source, "matrix": transform.matrix.tolist()}


def message(proofs: Sequence[Proof], done: str) -> str:
    """One sentence: `done` when all passed, else the worst proof with value, limit and unit."""
    failed = [proof for proof in proofs if proof.outcome is not Outcome.OK]
    if not failed:
        return done
    ruling = worst(proof.outcome for proof in failed)
    proof = next(proof for proof in failed if proof.outcome is ruling)
    unit = f" {proof.unit}" if proof.unit else ""
    return f"{proof.name} {proof.value:.3g}{unit}, limit {proof.limit:.3g}{unit}: {proof.detail}"
