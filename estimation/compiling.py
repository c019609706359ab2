"""Functions that are compiled where numba is installed, and run as they stand where it is not."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

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
