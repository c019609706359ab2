"""Functions that are compiled where numba is installed, and run as they stand where it is not."""

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numpy as np

from estimation.transform import FloatArray

try:
    from numba import njit as _njit
except ImportError:  # numba is optional
    _njit = None  # type: ignore[assignment]

_PAYS: Final = 2_000  # uses, each of which saves some milliseconds
_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """For algebra of small matrices, where calls take longer than what they do.

    The function must keep to what numba knows of numpy. Loops over measurements belong into a kernel that
    has a twin in numpy.
    """
    return cast("_Function", function if _njit is None else _njit(cache=True)(function))


class Tier:
    """Whether a kernel that has a twin in numpy is worth its compilation, which takes seconds.

    It is once it lies on disk, or when a process has asked so often that it is about to pay. Compiled kernels
    stay on disk, so that on one computer this comes once.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel, self._asked, self._ready = kernel, 0, False

    def ready(self) -> bool:
        """Asked before each use."""
        if not self._ready:
            self._asked += 1
            often = self._asked > _PAYS
            self._ready = often or (self._asked == 1 and _on_disk(self._kernel))
        return self._ready

    def compile_now(self) -> None:
        """From here on it is used, whatever the first use takes."""
        self._ready = True


def _on_disk(kernel: Any) -> bool:
    try:  # numba has no public question for it
        return bool(kernel._cache._cache_file._load_index())
    except (AttributeError, OSError):
        return False


def plain_copy(values: FloatArray) -> FloatArray:
    """A copy in rows that may be written to, as compiled functions expect: others would be compiled anew."""
    return np.array(values, dtype=np.float64, order="C")
