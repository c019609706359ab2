"""Monte Carlo after JCGM 101: adaptive stopping, coverage intervals, and the test of a linear result."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from estimation.errors import EstimationError
from estimation.transform import FloatArray

Interval = Literal["symmetric", "shortest"]
LEAST_BLOCK: Final = 10_000  # trials in a block, JCGM 101 clause 7.9.4
_LEAST_USABLE: Final = 100


@dataclass(frozen=True, slots=True)
class Summary:
    """What JCGM 101 reports of one scalar quantity, in its unit."""

    value: float
    u: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class MonteCarlo:
    """The result of an adaptive run.

    Attributes
    ----------
    summaries : one for each quantity.
    tolerance : (q,) numerical tolerance that the figures were asked to have.
    stable : whether all figures settled within the tolerance before the trials ran out.
    interval : kind of the coverage interval.
    """

    summaries: tuple[Summary, ...]
    tolerance: FloatArray
    trials: int
    block: int
    stable: bool
    probability: float
    interval: Interval


@dataclass(frozen=True, slots=True)
class Validation:
    """Whether a linear result may stand: the ends of its interval are those of Monte Carlo to `tolerance`."""

    d_low: float
    d_high: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Both ends agree."""
        return self.d_low <= self.tolerance and self.d_high <= self.tolerance


def block_size(probability: float = 0.95) -> int:
    """Trials of a block: max(100 / (1 - p), 10^4). Source: JCGM 101, clause 7.9.4."""
    return max(math.ceil(100.0 / (1.0 - probability)), LEAST_BLOCK)


def numerical_tolerance(u: float, digits: int = 2) -> float:
    """Half of the last of `digits` significant digits of u: 0.00035 has 5e-6. Source: JCGM 101, 7.9.2."""
    if not u > 0.0 or not math.isfinite(u) or digits < 1:
        raise EstimationError(f"Numerical tolerance of u = {u:g} to {digits} digits", "Give u above zero")
    exponent = math.floor(math.log10(u)) - (digits - 1)
    if round(u / 10.0**exponent) >= 10**digits:  # 0.0999 is 0.10 to two digits
        exponent += 1
    return 0.5 * 10.0**exponent


def summary(values: FloatArray, probability: float = 0.95, interval: Interval = "symmetric") -> Summary:
    """Mean, standard deviation and coverage interval of trials (m,).

    "symmetric" leaves (1 - p) / 2 on either side; "shortest" is shorter for a skew quantity.
    Source: JCGM 101, clause 7.7. Raises EstimationError for fewer than 100 trials or NaN among them.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    count = len(ordered)
    if count < _LEAST_USABLE or not np.isfinite(ordered[-1]):
        raise EstimationError(
            f"A coverage interval from {count} trials, or some that are not finite",
            f"Take {_LEAST_USABLE} or more, and leave out those that were refused",
        )
    inside = min(round(probability * count), count - 1)
    if interval == "shortest":
        start = int(np.argmin(ordered[inside:] - ordered[: count - inside]))
    else:
        start = (count - inside) // 2
    return Summary(
        float(ordered.mean()),
        float(ordered.std(ddof=1)),
        float(ordered[start]),
        float(ordered[start + inside]),
    )


def adaptive(
    run_block: Callable[[int, int], FloatArray],
    block: int | None = None,
    digits: int = 2,
    probability: float = 0.95,
    most_trials: int = 10_000_000,
    interval: Interval = "symmetric",
    progress: Callable[[int, float], None] | None = None,
) -> MonteCarlo:
    """Blocks of trials until value, u and both ends of the interval of every quantity are stable.

    Parameters
    ----------
    run_block : (number of the block, trials) -> (trials, q) values of the q quantities.
    block : trials in a block; that of the guide unless given. With fewer, the stopping rule is the guide's
        but the block is not, and the caller must say so.
    digits : significant digits of u that shall be right.
    progress : called after each block with the trials so far and how many tolerances the least settled
        figure still moves by: at 1 it is done.

    Source: JCGM 101, clause 7.9.4. Raises EstimationError when not even two blocks may be run.
    """
    size = block_size(probability) if block is None else block
    if 2 * size > most_trials:
        raise EstimationError(
            f"Two blocks of {size} do not fit into {most_trials} trials", "Allow more trials"
        )
    trials: list[FloatArray] = []
    figures: list[FloatArray] = []
    tolerance, unsettled = np.zeros(0), math.inf
    while unsettled > 1.0 and (len(trials) + 1) * size <= most_trials:
        values = np.asarray(run_block(len(trials), size), dtype=np.float64).reshape(size, -1)
        trials.append(values)
        figures.append(_figures(values, probability, interval))
        if len(figures) > 1:
            mean_u = np.mean(figures, axis=0)[:, 1]
            tolerance = np.array([numerical_tolerance(float(u), digits) for u in mean_u])
            spread = np.std(figures, axis=0, ddof=1) / math.sqrt(len(figures))
            unsettled = float((2.0 * spread / tolerance[:, None]).max())
            if progress is not None:
                progress(len(trials) * size, unsettled)
    everything = np.concatenate(trials)
    return MonteCarlo(
        tuple(summary(column, probability, interval) for column in everything.T),
        tolerance,
        len(everything),
        size,
        unsettled <= 1.0,
        probability,
        interval,
    )


def validate_linear(value: float, expanded: float, seen: Summary, tolerance: float) -> Validation:
    """Compare y +- U of the linear propagation with the interval of Monte Carlo.

    Source: JCGM 101, clause 8.1: valid if neither end differs by more than the tolerance. The guide asks for
    a Monte Carlo run with a tolerance of about a fifth of that.
    """
    return Validation(abs(value - expanded - seen.low), abs(value + expanded - seen.high), tolerance)


def _figures(values: FloatArray, probability: float, interval: Interval) -> FloatArray:
    """(q, 4): value, u, low, high of each quantity."""
    found = (summary(column, probability, interval) for column in values.T)
    return np.array([(each.value, each.u, each.low, each.high) for each in found])
