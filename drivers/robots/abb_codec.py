"""The open_abb server, a RAPID program on ABB controllers: requests and replies as text.

A request is numbers with blanks between them and `#` at the end; a reply is `code ok values` without any end,
so that its completeness follows from the number of values and of their decimals.
Source: RAPID/SERVER.mod of robotics/open_abb.
"""

import math
import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.errors import DeviceError, FrameError
from estimation.transform import FloatArray

MOVE_LINEAR, MOVE_JOINTS = 1, 2
POSE, JOINTS = 3, 4
TOOL, WORK_OBJECT, SPEED, ZONE = 6, 7, 8, 9
INFORMATION, CLOSE = 98, 99

MOST_BYTES: Final = 80  # a RAPID string has no more
NOTHING: Final = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # a frame that is its parent
FINE: Final = (1.0, 0.0, 0.0, 0.0)  # every move ends in its target, at rest
_POSE_VALUES: Final = 7


def encode(code: int, values: Sequence[float] = (), decimals: int = 4) -> bytes:
    """A request. Raises DeviceError if RAPID could not take it."""
    numbers = "".join(f"{value:.{decimals}f} " for value in values)
    request = f"{code:02d} {numbers}#".encode("ascii")
    if len(request) > MOST_BYTES:
        raise DeviceError(f"ABB request of {len(request)} bytes, limit {MOST_BYTES}", "Send fewer decimals")
    return request


def parse_reply(data: bytes, code: int, counts: Sequence[int]) -> list[float] | None:
    """Values of a complete reply to `code`, or None until more bytes come.

    `counts` are the decimals of each value: a number that is cut short is not taken for a whole one.
    Raises FrameError for a reply to something else, DeviceError for a request that was not understood.
    """
    text = data.decode("ascii", errors="replace")
    if text == f"{code} 0 ":
        raise DeviceError(
            f"ABB did not understand request {code:02d}", "Check the version of the server program"
        )
    head = f"{code} 1 "
    if not head.startswith(text[: len(head)]):
        raise FrameError(
            f"ABB answered {data!r} to request {code:02d}", "Check that only this controller asks"
        )
    numbers = [rf"-?[0-9]+\.[0-9]{{{count}}}" if count else r"-?[0-9]+" for count in counts]
    if re.fullmatch(re.escape(head) + " ".join(numbers), text):
        return [float(word) for word in text.split()[2:]]
    if len(text) > MOST_BYTES:
        raise FrameError(f"ABB answered {data!r} to request {code:02d}", "Check the number of decimals")
    return None


def parse_information(data: bytes) -> tuple[str, str, str]:
    """Serial number, version and type of the robot."""
    text = data.decode("ascii", errors="replace")
    fields = text.removeprefix(f"{INFORMATION} 1 ").split("*")
    if not text.startswith(f"{INFORMATION} 1 ") or len(fields) != 3:
        raise FrameError(
            f"ABB answered {data!r} to request {INFORMATION}", "Check that this is the open_abb server"
        )
    serial, version, kind = (field.strip() for field in fields)
    return serial, version, kind


def joint_decimals(decimals: int) -> list[int]:
    """Of a reply to `JOINTS`."""
    return [decimals] * 6


def pose_decimals(length: int, quaternion: int) -> list[int]:
    """Of a reply to `POSE`."""
    return [length] * 3 + [quaternion] * 4


def pose_values(base_T_flange: FloatArray) -> list[float]:
    """Millimetres and quaternion, scalar first, of a pose (4, 4)."""
    x, y, z, w = Rotation.from_matrix(base_T_flange[:3, :3]).as_quat()
    return [*(1e3 * base_T_flange[:3, 3]).tolist(), float(w), float(x), float(y), float(z)]


def pose_matrix(values: Sequence[float]) -> FloatArray:
    """The pose (4, 4) of a reply. Raises FrameError if its quaternion is none."""
    w, x, y, z = values[3:_POSE_VALUES]
    if not math.isclose(math.hypot(w, x, y, z), 1.0, abs_tol=0.01):
        raise FrameError(f"ABB sent the quaternion {values[3:]}", "Check that only this controller asks")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, 3] = np.array(values[:3]) * 1e-3
    return matrix
