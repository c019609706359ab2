"""What is said of a move that failed, when its end is looked at: the first cause, unless the arm moves on."""

import contextlib
from collections.abc import Iterator

from estimation.errors import DeviceError, StillMoving


@contextlib.contextmanager
def only_still_moving(cause: BaseException) -> Iterator[None]:
    """Lets StillMoving through, the cause behind it; other errors of the look say less than the cause."""
    try:
        yield
    except StillMoving as error:
        raise error from cause
    except DeviceError:
        return
