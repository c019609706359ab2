"""RIFTEK RF602/603/605 laser on its serial line: a head with one of three protocols in front."""

import math

import numpy as np

from simulators.sensors.beam import Beam
from simulators.sensors.riftek_head import (
    ASCII,
    BINARY,
    LASER_ON,
    MODBUS_RTU,
    PROTOCOL,
    RiftekHead,
    RiftekSpec,
)
from simulators.sensors.riftek_protocols import AsciiPort, BinaryPort, Port, RegisterPort


class Rf60x(RiftekHead):
    """The laser's end of the line."""

    def __init__(
        self,
        spec: RiftekSpec,
        beam: Beam,
        scale: float,
        offset_m: float,
        rng: np.random.Generator,
        noise_factor: float = 1.0,
    ) -> None:
        super().__init__(spec, beam, scale, offset_m, rng, noise_factor)
        self._ports: dict[int, Port] = {
            BINARY: BinaryPort(self),
            ASCII: AsciiPort(self),
            MODBUS_RTU: RegisterPort(self),
        }

    @property
    def _port(self) -> Port:
        return self._ports[self.parameters[PROTOCOL]]

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the host; deaf while it boots."""
        self._advance(time_s)
        if time_s >= self._up_s:
            self._port.receive(data, time_s)

    def _advance(self, time_s: float) -> None:
        while self._later and self._later[0][0] <= time_s:
            due_s, action = self._later.popleft()
            action(due_s)
        self._port.advance(time_s)

    def next_output_s(self) -> float:
        """When the next bytes are handed over, or something happens inside."""
        due_s = min(self._later[0][0] if self._later else math.inf, self.gap.end_s)
        stream_s = math.inf
        if self._stream_cycle is not None and self.parameters[LASER_ON]:
            stream_s = self.uart.handed_over_s(self._complete_s(self._stream_cycle))
        return 0.0 if self._passed else min(due_s, self.uart.next_output_s(), stream_s)

    def take(self, time_s: float) -> bytes:
        """Everything handed over by then."""
        self._advance(time_s)
        passed, self._passed = self._passed, b""
        return passed + self._stream(self.uart.handed_over_until_s(time_s)) + self.uart.take(time_s)

    def discard(self, time_s: float) -> None:
        """Forget what was handed over by then, without making it."""
        self._advance(time_s)
        self._passed = b""
        self._stream_until(self.uart.handed_over_until_s(time_s))
        self.uart.take(time_s)
