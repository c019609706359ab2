"""RTDE server of a Universal Robots controller, protocol version 2, for one client.

Packages come on the grid of the control cycle. A client that does not read for long misses the older ones.
"""

import math
import struct
from typing import Final

from simulators.answers import Answers
from simulators.robots.ur_fields import Recipe, Sampled

CYCLE_S: Final = 0.002
LATENCY_S: Final = 0.0006  # from the sample to the client
ANSWER_S: Final = 0.0015
KEPT_S: Final = 1.0  # packages older than this are skipped
ACCEPTED, REFUSED = b"\x01", b"\x00"


def frame(kind: bytes, payload: bytes = b"") -> bytes:
    """Size with itself and the type, type, payload."""
    return struct.pack(">H", 3 + len(payload)) + kind + payload


class RtdeSession(Answers):
    """One client. Inputs cannot be written: their set-up is answered with NOT_FOUND."""

    def __init__(self, robot: Sampled, version: tuple[int, int, int, int]) -> None:
        super().__init__()
        self._robot, self._version = robot, version
        self._input = b""
        self._recipe: Recipe | None = None
        self._period_s, self._next_s = CYCLE_S, math.inf  # sample time of the next package

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client, however they are cut."""
        self._input += data
        while len(self._input) >= 3:
            size = int.from_bytes(self._input[:2], "big")
            if size < 3:  # nobody can tell where the next one begins
                self._input = b""
            if len(self._input) < max(size, 3):
                return
            kind, payload, self._input = self._input[2:3], self._input[3:size], self._input[size:]
            self._sample(time_s)
            if (answer := self._answer(kind, payload, time_s)) is not None:
                last_s = self._output[-1][0] if self._output else 0.0
                self._output.append((max(time_s + ANSWER_S, last_s), frame(kind, answer)))

    def _answer(self, kind: bytes, payload: bytes, time_s: float) -> bytes | None:
        match kind:
            case b"V":
                return ACCEPTED if payload == b"\x00\x02" else REFUSED
            case b"v":
                return struct.pack(">4I", *self._version)
            case b"O" if len(payload) > 8:
                (rate_hz,) = struct.unpack_from(">d", payload)
                names = [name for name in payload[8:].decode("ascii", errors="replace").split(",") if name]
                self._period_s = CYCLE_S * max(1, round(1.0 / CYCLE_S / min(max(rate_hz, 1.0), 500.0)))
                self._recipe = Recipe(names)
                return bytes((self._recipe.complete,)) + ",".join(self._recipe.types).encode()
            case b"I":
                return b"\x00" + ",".join(["NOT_FOUND"] * (payload.count(b",") + 1)).encode()
            case b"S":
                if self._recipe is None or not self._recipe.complete:
                    return REFUSED
                self._next_s = math.ceil(time_s / CYCLE_S + 1.0) * CYCLE_S
                return ACCEPTED
            case b"P":
                self._next_s = math.inf
                return ACCEPTED
        return None

    def _sample(self, time_s: float, latency_s: float = 0.0) -> None:
        """Make the packages that were sampled by then, or have arrived by then."""
        if self._recipe is None or self._next_s + latency_s > time_s:
            return
        if self._next_s < time_s - KEPT_S:
            self._next_s += math.floor((time_s - KEPT_S - self._next_s) / self._period_s) * self._period_s
        while self._next_s + latency_s <= time_s:
            package = frame(b"U", self._recipe.package(self._robot.moment(self._next_s)))
            last_s = self._output[-1][0] if self._output else 0.0
            self._output.append((max(self._next_s + LATENCY_S, last_s), package))
            self._next_s += self._period_s

    def next_output_s(self) -> float:
        """When the next frame comes."""
        return min(super().next_output_s(), self._next_s + LATENCY_S)

    def take(self, time_s: float) -> bytes:
        """All frames that came by then."""
        self._sample(time_s, LATENCY_S)
        return super().take(time_s)
