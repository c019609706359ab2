"""Thousands of replicas of one estimate at once: chord Newton with the exact gradient and one shared Hessian.

Replicas of a plan differ in their readings only, so the Hessian at the mean solution serves every one. The
gradient is exact, so each replica ends in its own optimum; the Hessian decides only how fast.
"""

from typing import Final

TOLERANCE: Final = 1e-4  # standard deviations: the last step of a replica
LARGEST_ITERATIONS: Final = 40
