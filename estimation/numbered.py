"""Places in an array, told to people: counted from 1, and not too many of them."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

_MOST_TOLD: Final = 10


def numbered(places: Sequence[int] | NDArray[np.intp]) -> str:
    """Such as "3, 8" for the places 2 and 7; of many the first ten."""
    told = ", ".join(str(place + 1) for place in places[:_MOST_TOLD])
    return f"{told}, .." if len(places) > _MOST_TOLD else told
