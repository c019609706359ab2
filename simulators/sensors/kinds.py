"""Which distance lasers can be simulated in a cell, by the name of their driver in the cell file."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.errors import CellFileError
from simulators.sensors import riftek_head
from simulators.sensors.ams335i import Ams335i, AmsSpec
from simulators.sensors.beam import Beam
from simulators.sensors.dlrs1a import Amplifier, AmplifierSpec, DlRs1a
from simulators.sensors.gocator import Gocator, GocatorSpec
from simulators.sensors.optoncdt import OptoNcdt1420
from simulators.sensors.riftek import Rf60x
from simulators.wired import Wired, on_can_bus, on_serial_line
from simulators.world.world_file import LaserSpec


@dataclass(frozen=True, slots=True)
class Optics:
    """The same for every kind of laser: what it sees, and how it errs."""

    spec: LaserSpec
    beam: Beam
    scale: float
    offset_m: float
    rng: np.random.Generator
    noise_factor: float

    @property
    def noise_m(self) -> float:
        """Standard deviation of one reading."""
        return self.spec.reading_noise_m * self.noise_factor

    @property
    def middle_m(self) -> float:
        """Of the measuring range."""
        return self.spec.range_start_m + self.spec.range_m / 2


def _optoncdt(o: Optics) -> Wired:
    return on_serial_line(OptoNcdt1420(o.spec, o.beam, o.scale, o.offset_m, o.rng, o.noise_factor))


def _riftek(protocol: int) -> Callable[[Optics], Wired]:
    def make(o: Optics) -> Wired:
        spec = riftek_head.RiftekSpec(
            base_mm=round(o.spec.range_start_m * 1e3),
            range_mm=round(o.spec.range_m * 1e3),
            noise_m=o.spec.reading_noise_m,
            protocol=protocol,
        )
        return on_serial_line(Rf60x(spec, o.beam, o.scale, o.offset_m, o.rng, o.noise_factor))

    return make


def _keyence(o: Optics) -> Wired:
    spec = AmplifierSpec(zero_m=o.middle_m, span_m=o.spec.range_m, noise_m=o.noise_m)
    return on_serial_line(DlRs1a([Amplifier(spec, o.beam, o.scale, o.offset_m, o.rng)]))


def _gocator(o: Optics) -> Wired:
    spec = GocatorSpec(zero_m=o.middle_m, span_m=o.spec.range_m, noise_m=o.noise_m)
    head = Gocator(spec, o.beam, o.scale, o.offset_m, o.rng)
    return Wired(head, connect=head.connect)


def _ams(o: Optics) -> Wired:
    return on_can_bus(Ams335i(AmsSpec(noise_m=o.noise_m), o.beam, o.scale, o.offset_m, o.rng))


LASERS: Final[dict[str, Callable[[Optics], Wired]]] = {
    "optoncdt-1420": _optoncdt,
    "riftek-ascii": _riftek(riftek_head.ASCII),
    "riftek-binary": _riftek(riftek_head.BINARY),
    "riftek-modbus": _riftek(riftek_head.MODBUS_RTU),
    "keyence-il": _keyence,
    "gocator": _gocator,
    "ams-335i": _ams,
}


def make_laser(kind: str, optics: Optics) -> Wired:
    """The simulated laser of this kind. Raises CellFileError if there is none."""
    if kind not in LASERS:
        raise CellFileError(f"No simulator for laser {kind!r}", f"Choose one of {', '.join(LASERS)}")
    return LASERS[kind](optics)
