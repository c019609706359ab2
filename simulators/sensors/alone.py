"""Sensors without a cell around them: their target runs through the range: a value tells its instant."""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from estimation.transform import FloatArray
from simulators.device_kind import DeviceKind, Setting, Simulated
from simulators.sensors.ams335i import Ams335i, AmsSpec
from simulators.sensors.dlrs1a import Amplifier, AmplifierSpec, DlRs1a
from simulators.sensors.ft300 import BAUD, Ft300, Ft300Spec
from simulators.sensors.gocator import Gocator, GocatorSpec
from simulators.sensors.riftek import Rf60x
from simulators.sensors.riftek_head import ASCII, BINARY, MODBUS_RTU, RiftekSpec
from simulators.signals import Signal

PERIOD: Final[Mapping[str, Setting]] = {"period_s": 20.0}


class PulledAlong:
    """A load along x that follows a signal."""

    def __init__(self, signal: Signal) -> None:
        self._signal = signal

    def wrenches(self, times_s: FloatArray) -> FloatArray:
        """Forces and torques (n, 6)."""
        wrenches = np.zeros((len(times_s), 6))
        wrenches[:, 0] = self._signal.at(times_s)
        return wrenches


def _ams(settings: Mapping[str, Setting], seed: int) -> Simulated:
    signal = Signal(1.0, 11.0, float(settings["period_s"]))
    spec = AmsSpec(node=int(settings["node"]), serial_number=int(settings["serial_number"]))
    sensor = Ams335i(spec, signal, 0.0, 0.0, np.random.default_rng(seed))
    return Simulated(sensor, can=sensor, signal=signal, restart=sensor.restart)


def _dlrs1a(settings: Mapping[str, Setting], seed: int) -> Simulated:
    signal, rng = Signal(0.08, 0.12, float(settings["period_s"])), np.random.default_rng(seed)
    amplifiers = [
        Amplifier(AmplifierSpec(), signal, 0.0, 0.0, rng) for _ in range(int(settings["amplifiers"]))
    ]
    unit = DlRs1a(amplifiers, int(settings["baud"]))
    return Simulated(
        unit, {"": lambda: unit}, signal=signal, baud=lambda: unit.uart.baud, restart=unit.restart
    )


def _ft300(settings: Mapping[str, Setting], seed: int) -> Simulated:
    signal = Signal(-100.0, 100.0, float(settings["period_s"]))
    spec = Ft300Spec(serial_number=str(settings["serial_number"]))
    sensor = Ft300(spec, PulledAlong(signal), np.random.default_rng(seed))
    return Simulated(sensor, {"": lambda: sensor}, signal=signal, baud=lambda: BAUD, restart=sensor.restart)


def _gocator(settings: Mapping[str, Setting], seed: int) -> Simulated:
    signal = Signal(0.22, 0.38, float(settings["period_s"]))
    spec = GocatorSpec(jobs=(str(settings["job"]), "other"))
    head = Gocator(spec, signal, 0.0, 0.0, np.random.default_rng(seed))
    return Simulated(head, {"modbus": head.connect}, signal=signal, restart=head.restart)


def _riftek(protocol: int) -> Callable[[Mapping[str, Setting], int], Simulated]:
    def make(settings: Mapping[str, Setting], seed: int) -> Simulated:
        signal = Signal(0.081, 0.129, float(settings["period_s"]))
        spec = RiftekSpec(serial_number=int(settings["serial_number"]), protocol=protocol)
        head = Rf60x(spec, signal, 0.0, 0.0, np.random.default_rng(seed))
        return Simulated(
            head, {"": lambda: head}, signal=signal, baud=lambda: head.uart.baud, restart=head.restart
        )

    return make


KINDS: Final = (
    DeviceKind(
        name="ams-335i",
        what="Leuze AMS 335i distance laser, CANopen",
        link="can",
        make=_ams,
        settings={"node": 16, "serial_number": 335001, **PERIOD},
        other={"serial_number": 335999},
    ),
    DeviceKind(
        name="dl-rs1a",
        what="Keyence DL-RS1A with IL laser amplifiers, RS-232",
        link="serial",
        make=_dlrs1a,
        settings={"amplifiers": 1, "baud": 9600, **PERIOD},
        other={"amplifiers": 2},
    ),
    DeviceKind(
        name="ft-300",
        what="Robotiq FT 300 force sensor, Modbus RTU and stream on RS-485",
        link="serial",
        make=_ft300,
        settings={"serial_number": "FTD-0417", **PERIOD},
        other={"serial_number": "FTD-0999"},
    ),
    DeviceKind(
        name="gocator",
        what="LMI Gocator profile sensor, Modbus TCP; knows no identity but its jobs",
        link="tcp",
        make=_gocator,
        settings={"job": "block", **PERIOD},
        other={"job": "foreign"},
        sockets={"modbus": 502},
    ),
    *(
        DeviceKind(
            name=f"rf60x-{name}",
            what=f"RIFTEK RF60x distance laser, {words}",
            link="serial",
            make=_riftek(protocol),
            settings={"serial_number": 17185, **PERIOD},
            other={"serial_number": 17999},
        )
        for name, words, protocol in (
            ("binary", "binary protocol", BINARY),
            ("ascii", "ASCII protocol", ASCII),
            ("modbus", "Modbus RTU", MODBUS_RTU),
        )
    ),
)
