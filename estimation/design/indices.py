"""Goodness of a set of measurements by the singular values of its Jacobian alone, as in the literature.

None of them knows the noise, the prior or what the result is for; they are kept for comparison. Scale the
columns first: with metres beside radians they say little.

Source: Sallinen (2003), eq. (22) to (24) and (26).
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from estimation.transform import FloatArray


def condition_number(jacobian: FloatArray) -> float:
    """(22) largest over smallest singular value; 1 is best."""
    singular = np.linalg.svd(jacobian, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")


def noise_amplification(jacobian: FloatArray) -> float:
    """(23) smallest singular value squared over the largest; more is better."""
    singular = np.linalg.svd(jacobian, compute_uv=False)
    return float(singular[-1] ** 2 / singular[0]) if singular[0] > 0.0 else 0.0


def observability(jacobian: FloatArray) -> float:
    """(24) geometric mean of the singular values over the root of the number of rows; more is better."""
    singular = np.linalg.svd(jacobian, compute_uv=False)
    if not singular[-1] > 0.0:
        return 0.0
    return float(np.exp(np.log(singular).mean()) / np.sqrt(len(jacobian)))


def smallest_singular_value(jacobian: FloatArray) -> float:
    """(26); more is better."""
    return float(np.linalg.svd(jacobian, compute_uv=False)[-1])


# Each as a cost: less is better.
COSTS: Final[Mapping[str, Callable[[FloatArray], float]]] = {
    "condition number": condition_number,
    "noise amplification": lambda jacobian: -noise_amplification(jacobian),
    "observability": lambda jacobian: -observability(jacobian),
    "smallest singular value": lambda jacobian: -smallest_singular_value(jacobian),
}
