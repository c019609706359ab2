"""Which touch probes can be simulated in a cell, by the name of their driver in the cell file."""

from collections.abc import Callable
from typing import Final

import numpy as np

from estimation.errors import CellFileError
from estimation.transform import FloatArray
from simulators.modbus_server import ModbusConnection
from simulators.probes.adam6052 import Adam6052
from simulators.probes.wago750 import Wago750, WagoSpec
from simulators.sensors.dlrs1a import Amplifier, AmplifierSpec, DlRs1a
from simulators.sensors.ft300 import Ft300, Ft300Spec
from simulators.wired import Wired, on_can_bus, on_serial_line
from simulators.world.contact import StylusContact
from simulators.world.world_file import ProbeSpec

STIFFNESS_N_M: Final = 5e5  # of stylus and sensor
STYLUS_N: Final = (0.4, -0.3, -3.0)  # weight and zero of the sensor
FORCE_NOISE_N: Final = 0.03
GAUGE_BAUD: Final = 38400

Make = Callable[[StylusContact, ProbeSpec, np.random.Generator], Wired]


class _Push:
    """The pressed stylus as a force."""

    def __init__(self, contact: StylusContact) -> None:
        self._contact = contact

    def wrenches(self, times_s: FloatArray) -> FloatArray:
        """Along the stylus, (n, 6)."""
        wrenches = np.zeros((len(times_s), 6))
        wrenches[:, :3] = STYLUS_N
        wrenches[:, 2] += STIFFNESS_N_M * self._contact.depths_m(times_s)
        return wrenches


class _Stroke:
    """The pressed stylus as a movement of a spindle."""

    def __init__(self, contact: StylusContact) -> None:
        self._contact = contact

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        """How far it is pressed, (n,)."""
        return self._contact.depths_m(times_s)


def _adam(contact: StylusContact, spec: ProbeSpec, rng: np.random.Generator) -> Wired:
    module = Adam6052(contact, spec.model, spec.channel, spec.reply_delay_s)
    return Wired(module, connect=lambda: ModbusConnection(module))


def _wago(contact: StylusContact, spec: ProbeSpec, rng: np.random.Generator) -> Wired:
    return on_can_bus(Wago750(WagoSpec(channel=spec.channel), contact))


def _ft300(contact: StylusContact, spec: ProbeSpec, rng: np.random.Generator) -> Wired:
    return on_serial_line(Ft300(Ft300Spec(noise_n=FORCE_NOISE_N), _Push(contact), rng))


def _gauge(contact: StylusContact, spec: ProbeSpec, rng: np.random.Generator) -> Wired:
    gauge = AmplifierSpec(kind="GT2", zero_m=0.0, span_m=0.01, towards=False, response_s=0.003)
    return on_serial_line(DlRs1a([Amplifier(gauge, _Stroke(contact), 0.0, 0.0, rng)], GAUGE_BAUD))


PROBES: Final[dict[str, Make]] = {
    "adam-6052": _adam,
    "wago-750-337": _wago,
    "robotiq-ft300": _ft300,
    "keyence-gt2": _gauge,
}


def make_probe(kind: str, contact: StylusContact, spec: ProbeSpec, rng: np.random.Generator) -> Wired:
    """The simulated probe of this kind. Raises CellFileError if there is none."""
    if kind not in PROBES:
        raise CellFileError(f"No simulator for probe {kind!r}", f"Choose one of {', '.join(PROBES)}")
    return PROBES[kind](contact, spec, rng)
