"""Which of many measurements to take: criteria, choice, the fewest for a limit, lower bounds, baselines."""

from estimation.design.bound import Bound, lower_bound
from estimation.design.choice import Selection, choose, fewest, worth
from estimation.design.criteria import CRITERIA, Criterion
from estimation.design.problem import DesignProblem

__all__ = [
    "CRITERIA",
    "Bound",
    "Criterion",
    "DesignProblem",
    "Selection",
    "choose",
    "fewest",
    "lower_bound",
    "worth",
]
