"""The touch-probe input of a drive: it holds the position at an edge (CiA 402-2, 60B8h to 60BAh).

Only what probing needs: input 1, its rising edge, the first event after it was switched on.
"""

from collections.abc import Callable
from typing import Final

from simulators.canopen_objects import Key, Value, entries_of

FUNCTION: Final[Key] = (0x60B8, 0)
STATUS: Final[Key] = (0x60B9, 0)
RISING_EDGE: Final[Key] = (0x60BA, 0)
ENTRIES: Final = entries_of(
    [(0x60B8, 0, "u16", 0, "w"), (0x60B9, 0, "u16", 0, "r"), (0x60BA, 0, "i32", 0, "r")]
)
ON, AT_RISING_EDGE = 1 << 0, 1 << 4  # of 60B8h
IS_ON, STORED = 1 << 0, 1 << 1  # of 60B9h


class TouchInput:
    """`first_closing(since_s, until_s)` is when the contact closed; `measure` the position at an instant."""

    def __init__(
        self, first_closing: Callable[[float, float], float | None], measure: Callable[[float], int]
    ) -> None:
        self._first_closing, self._measure = first_closing, measure
        self.reset()

    def reset(self) -> None:
        """The power came back."""
        self._function, self._since_s = 0, 0.0
        self._stored: int | None = None

    def write(self, function: int, time_s: float) -> None:
        """60B8h. Switching it on forgets what was stored."""
        if function & ON and not self._function & ON:
            self._since_s, self._stored = time_s, None
        self._function = function

    def read(self, key: Key, time_s: float) -> Value:
        """One of ENTRIES, as it is then."""
        watching = self._function & ON and self._function & AT_RISING_EDGE
        if watching and self._stored is None:
            closed_s = self._first_closing(self._since_s, time_s)
            self._stored = None if closed_s is None else self._measure(closed_s)
        if key == FUNCTION:
            return self._function
        if key == STATUS:
            return bool(self._function & ON) * IS_ON | (self._stored is not None) * STORED
        return self._stored or 0
