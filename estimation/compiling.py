"""Functions that are compiled where numba is installed, and run as they stand where it is not."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from estimation.transform import FloatArray

try:
    from numba import njit as _njit
except ImportError:  # numba is optional
    _njit = None  # type: ignore[assignment]

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """For algebra of small matrices, where calls take longer than what they do.

    The function must keep to what numba knows of numpy. Loops over measurements belong into a kernel that
    has a twin in numpy.
    """
    return cast("_Function", function if _njit is None else _njit(cache=True)(function))


def plain_copy(values: FloatArray) -> FloatArray:
    """A copy in rows that may be written to, as compiled functions expect: others would be compiled anew."""
    return np.array(values, dtype=np.float64, order="C")
