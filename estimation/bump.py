"""Has the laser moved since it was calibrated? A five-parameter test on measurements that no fit has used."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc, chdtri, chndtr

from estimation.belief import Belief
from estimation.errors import EstimationError
from estimation.kinematics import ArmModel
from estimation.measurement import Chain, Observations
from estimation.solver import Update, update
from estimation.transform import FloatArray, Transform, exp_pose

FREEDOMS: Final = ("tx", "ty", "tz", "rx", "ry")  # turning about the beam changes no reading
# So wide that the prior of the bump decides nothing, and still narrow enough to converge.
PRIOR_U_M: Final = 0.02
PRIOR_U_RAD: Final = 0.1
_ONE_AXIS: Final = 0.9  # share of the length along one axis from which that axis is named alone


@dataclass(frozen=True, slots=True, eq=False)
class BumpTest:
    """Outcome of the test, for a gate and for people.

    Attributes
    ----------
    statistic, limit, p_value : how much worse the measurements fit without a bump: chi-square with five
        degrees of freedom for an honest cell, and its limit at the level of the test.
    chi2, dof, chi2_limit : what is left with the bump free; a fault that is no bump shows here. Independent
        of `statistic`, same level.
    bump, covariance : (5,) right perturbation of flange_T_laser, tx ty tz (m) rx ry (rad), and (5, 5).
    words : the finding in one sentence part.
    """

    statistic: float
    limit: float
    p_value: float
    level: float
    chi2: float
    dof: int
    chi2_limit: float
    bump: FloatArray
    covariance: FloatArray
    words: str

    @property
    def passed(self) -> bool:
        """The laser stands where it was calibrated, as far as these measurements can tell."""
        return self.statistic <= self.limit

    @property
    def consistent(self) -> bool:
        """Apart from a bump, the measurements are as uncertain as declared."""
        return self.chi2 <= self.chi2_limit

    def detection_probability(self, bump: FloatArray) -> float:
        """Probability that this test, with these measurements, would have caught a bump (5,) (m, rad)."""
        return detection_probability(self.covariance, bump, self.level)


def bump_test(
    belief: Belief, arm: ArmModel, observations: Sequence[Observations], level: float = 0.005
) -> BumpTest:
    """Test measurements, new to the belief, for a movement of the laser in its mount.

    Parameters
    ----------
    belief : from before the measurements, with the blocks of the reference objects. It stays as it is.
    observations : laser batches on references; references that the calibration used catch drift, others
        absolute errors.
    level : probability that an honest cell fails.

    Raises
    ------
    EstimationError
        Fewer than six measurements, or no convergence.

    Notes
    -----
    The bump is estimated together with everything that the belief is uncertain of, so that the test uses
    the full covariance H P H^T + Q of the measurements (ESTIMATION.md sections 4 and 12). The statistic is
    the likelihood ratio. Where a check hardly tells a shift from a turn, b^T P^-1 b is not chi-square: the
    curvature at a far estimate makes P too small.
    """
    rows = sum(len(batch) for batch in observations)
    if rows <= len(FREEDOMS):
        raise EstimationError(
            f"Bump test with {rows} measurements", f"Measure at least {len(FREEDOMS) + 1}, better 20"
        )
    moved = _with_free_bump(belief, arm, observations)
    bump, covariance = _found(moved)
    try:
        statistic = _distance2(belief, arm, observations, np.zeros(len(FREEDOMS)), moved)
    except (
        EstimationError
    ):  # after a crash "it did not move" has no minimum nearby, and is far from the limit
        statistic = float(bump @ np.linalg.solve(covariance, bump))
    limit = float(chdtri(len(FREEDOMS), level))
    dof = rows - len(FREEDOMS)
    return BumpTest(
        statistic=statistic,
        limit=limit,
        p_value=float(chdtrc(len(FREEDOMS), statistic)),
        level=level,
        chi2=moved.chi2,
        dof=dof,
        chi2_limit=float(chdtri(dof, level)),
        bump=bump,
        covariance=covariance,
        words=_words(bump, covariance, level, statistic <= limit),
    )


def bump_distance2(
    belief: Belief, arm: ArmModel, observations: Sequence[Observations], bump: FloatArray
) -> float:
    """How much worse a bump (5,) (m, rad) fits than the best one: chi-square(5) of the true bump.

    It is what `bump_test` computes for no bump at all. Raises EstimationError without convergence.
    """
    return _distance2(belief, arm, observations, bump, _with_free_bump(belief, arm, observations))


def _with_free_bump(belief: Belief, arm: ArmModel, observations: Sequence[Observations]) -> Update:
    prior_u = [PRIOR_U_M] * 3 + [PRIOR_U_RAD] * 2
    free = belief.with_block("bump", Transform("laser", "laser", np.eye(4)), std=prior_u, freedoms=FREEDOMS)
    return update(free, Chain(arm, observations))


def _distance2(
    belief: Belief, arm: ArmModel, observations: Sequence[Observations], bump: FloatArray, free: Update
) -> float:
    there = Transform("laser", "laser", exp_pose(np.append(bump, 0.0)))
    held = belief.with_block("bump", there, std=0.0, freedoms=FREEDOMS)
    return max(update(held, Chain(arm, observations)).chi2 - free.chi2, 0.0)


def _found(free: Update) -> tuple[FloatArray, FloatArray]:
    """The bump (5,) and its covariance (5, 5)."""
    pose = free.belief.transform("bump")
    rotation = Rotation.from_matrix(pose.rotation).as_rotvec()
    return np.concatenate([pose.origin_m, rotation[:2]]), free.belief.block_covariance("bump")


def detection_probability(covariance: FloatArray, bump: FloatArray, level: float) -> float:
    """Probability that a test at `level` catches a bump (5,), from the covariance (5, 5) of its estimate."""
    distance2 = float(bump @ np.linalg.solve(covariance, bump))
    return 1.0 - float(chndtr(chdtri(len(bump), level), len(bump), distance2))


def _words(bump: FloatArray, covariance: FloatArray, level: float, passed: bool) -> str:
    """The simplest movement that explains the statistic: one axis, a shift, a turn, or both."""
    information: FloatArray = np.linalg.inv(covariance).astype(np.float64)
    if passed:
        return f"no movement of the laser beyond its uncertainty (estimate {_shift(bump)}, {_turn(bump)})"
    for group in ([[axis] for axis in range(len(bump))], [[0, 1, 2], [3, 4]]):
        fits = sorted((_constrained(bump, information, axes) for axes in group), key=lambda item: item[1])
        limits = [float(chdtri(len(bump) - np.count_nonzero(fit), level)) for fit, _ in fits]
        possible = [_moved(fit) for (fit, left), limit in zip(fits, limits, strict=True) if left <= limit]
        if possible:  # at one distance a shift looks like a turn: say so when the data cannot tell
            return f"laser {' or '.join(possible)}"
    return f"laser {_moved(bump)}"


def _constrained(bump: FloatArray, information: FloatArray, axes: list[int]) -> tuple[FloatArray, float]:
    """The likeliest bump about some axes only, and what it leaves of the statistic."""
    fit = np.zeros(len(bump))
    fit[axes] = np.linalg.solve(information[np.ix_(axes, axes)], (information @ bump)[axes])
    return fit, float((bump - fit) @ information @ (bump - fit))


def _moved(bump: FloatArray) -> str:
    parts = []
    if bump[:3].any():
        parts.append(f"moved by {_shift(bump)} {_axes('along', bump[:3] * 1e3, '.2f')}")
    if bump[3:].any():
        parts.append(f"turned by {_turn(bump)} {_axes('about', np.degrees(bump[3:]), '.3f')}")
    return " and ".join(parts)


def _shift(bump: FloatArray) -> str:
    return f"{np.linalg.norm(bump[:3]) * 1e3:.2f} mm"


def _turn(bump: FloatArray) -> str:
    return f"{np.degrees(np.linalg.norm(bump[3:])):.3f} deg"


def _axes(preposition: str, part: FloatArray, digits: str) -> str:
    share = np.abs(part) / np.linalg.norm(part)
    main = int(np.argmax(share))
    if share[main] >= _ONE_AXIS:
        return f"{preposition} its {'-' if part[main] < 0 else ''}{'xyz'[main]}"
    listed = ", ".join(f"{axis} {value:{digits}}" for axis, value in zip("xyz", part, strict=False))
    return f"{preposition} its axes ({listed})"
