"""Which touch probes can be simulated, by the name of their driver in the cell file."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.transform import FloatArray
from simulators.device_kind import DeviceKind, Settings, Simulated, on_can_bus, on_serial_line
from simulators.modbus_tcp_slave import RegisterConnection
from simulators.probes.adam6052 import FUNCTIONS, Adam6052
from simulators.probes.switch import Switch
from simulators.probes.wago750 import Wago750, WagoSpec
from simulators.sensors.beam import Beam
from simulators.sensors.dlrs1a import Amplifier, AmplifierSpec, DlRs1a
from simulators.sensors.ft300 import BAUD, Ft300, Ft300Spec, Load
from simulators.signals import Signal, Ticker
from simulators.world.contact import StylusContact

STIFFNESS_N_M: Final = 5e5  # of stylus and sensor
STYLUS_N: Final = (0.4, -0.3, -3.0)  # weight and zero of the sensor


@dataclass(frozen=True, slots=True)
class Stylus:
    """The touch as each kind of probe sees it: as a contact, as a force, as a movement of a spindle."""

    switch: Switch
    load: Load
    stroke: Beam
    rng: np.random.Generator


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


class _Pull:
    """A load along x that follows a signal."""

    def __init__(self, signal: Signal) -> None:
        self._signal = signal

    def wrenches(self, times_s: FloatArray) -> FloatArray:
        """Forces and torques (n, 6)."""
        wrenches = np.zeros((len(times_s), 6))
        wrenches[:, 0] = self._signal.at(times_s)
        return wrenches


def stylus_of(contact: StylusContact, rng: np.random.Generator) -> Stylus:
    """What the probe of a cell touches with."""
    return Stylus(contact, _Push(contact), _Stroke(contact), rng)


def _ticking(settings: Settings, rng: np.random.Generator) -> tuple[Stylus, None]:
    """A contact that closes again and again."""
    still = Signal(0.0, 0.0, 1.0)
    return Stylus(Ticker(float(settings["period_s"])), _Pull(still), still, rng), None


def _rising(low: float, high: float, settings: Settings, rng: np.random.Generator) -> tuple[Stylus, Signal]:
    """A force in newton or a stroke in metres that rises steadily, so that a value tells its instant."""
    signal = Signal(low, high, float(settings["period_s"]))
    return Stylus(Ticker(signal.period_s), _Pull(signal), signal, rng), signal


def _adam(settings: Settings, stylus: Stylus) -> Simulated:
    model, channel = int(str(settings["model"]), 16), int(settings["channel"])
    module, reply_s = Adam6052(stylus.switch, model, channel), float(settings["reply_delay_ms"]) / 1000
    connections = {"": lambda: RegisterConnection(module, FUNCTIONS, reply_s)}
    return Simulated(module, connections, restart=lambda time_s: module.restart())


def _wago(settings: Settings, stylus: Stylus) -> Simulated:
    spec = WagoSpec(node=int(settings["node"]), name=str(settings["name"]), channel=int(settings["channel"]))
    return on_can_bus(Wago750(spec, stylus.switch))


def _ft300(settings: Settings, stylus: Stylus) -> Simulated:
    spec = Ft300Spec(str(settings["serial_number"]), noise_n=float(settings["noise_n"]))
    return on_serial_line(Ft300(spec, stylus.load, stylus.rng), lambda: BAUD)


def _gauge(settings: Settings, stylus: Stylus) -> Simulated:
    spec = AmplifierSpec(kind="GT2", zero_m=0.0, span_m=0.01, towards=False, response_s=0.003)
    amplifiers = [
        Amplifier(spec, stylus.stroke, 0.0, 0.0, stylus.rng) for _ in range(int(settings["amplifiers"]))
    ]
    unit = DlRs1a(amplifiers, int(settings["baud"]))
    return on_serial_line(unit, lambda: unit.uart.baud)


PROBES: Final = (
    DeviceKind(
        "adam-6052",
        "Advantech remote input with a touch probe, Modbus TCP",
        "tcp",
        _adam,
        _ticking,
        settings={"model": "6052", "channel": 0, "reply_delay_ms": 1.5, "period_s": 0.02},
        other={"model": "6050"},
        sockets={"": 502},
    ),
    DeviceKind(
        "wago-750-337",
        "WAGO station with a touch probe, CANopen CiA 401",
        "can",
        _wago,
        _ticking,
        settings={"node": 20, "name": "750-337", "channel": 0, "period_s": 0.5},
        other={"name": "750-338"},
    ),
    DeviceKind(
        "robotiq-ft300",
        "Robotiq FT 300 force sensor, Modbus RTU and stream on RS-485",
        "serial",
        _ft300,
        lambda settings, rng: _rising(-100.0, 100.0, settings, rng),
        settings={"serial_number": "FTD-0417", "noise_n": 0.03, "period_s": 20.0},
        other={"serial_number": "FTD-0999"},
    ),
    DeviceKind(
        "keyence-gt2",
        "Keyence DL-RS1A with GT2 contact gauges, RS-232",
        "serial",
        _gauge,
        lambda settings, rng: _rising(0.0005, 0.0095, settings, rng),
        settings={"amplifiers": 1, "baud": 38400, "period_s": 20.0},
        other={"amplifiers": 2},
    ),
)
