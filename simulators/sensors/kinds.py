"""Which distance lasers can be simulated, by the name of their driver in the cell file."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimation.transform import Transform
from simulators.device_kind import DeviceKind, Settings, Simulated, on_can_bus, on_serial_line
from simulators.sensors.ams335i import Ams335i, AmsSpec
from simulators.sensors.beam import Beam
from simulators.sensors.dlrs1a import Amplifier, AmplifierSpec, DlRs1a
from simulators.sensors.gocator import Gocator, GocatorSpec
from simulators.sensors.optoncdt import OptoNcdt1420
from simulators.sensors.riftek import Rf60x
from simulators.sensors.riftek_head import ASCII, BINARY, MODBUS_RTU, RiftekSpec
from simulators.signals import Signal
from simulators.world.world_file import LaserSpec, Placement


@dataclass(frozen=True, slots=True)
class Optics:
    """The same for every kind of laser: what it sees, and how it errs."""

    spec: LaserSpec
    beam: Beam
    scale: float
    offset_m: float
    rng: np.random.Generator
    noise_factor: float = 1.0

    @property
    def noise_m(self) -> float:
        """Standard deviation of one reading."""
        return self.spec.reading_noise_m * self.noise_factor

    @property
    def middle_m(self) -> float:
        """Of the measuring range."""
        return self.spec.range_start_m + self.spec.range_m / 2


def _alone(settings: Settings, rng: np.random.Generator) -> tuple[Optics, Signal]:
    """A target that runs through the measuring range, so that a value tells its instant."""
    start_m, range_m = float(settings["range_start_mm"]) / 1000, float(settings["range_mm"]) / 1000
    spec = LaserSpec(
        model=str(settings.get("model", "")),
        serial_number=str(settings.get("serial_number", "")),
        article="4120217",
        version=str(settings.get("version", "")),
        baud=int(settings.get("baud", 0)),
        range_start_m=start_m,
        range_m=range_m,
        max_incidence_rad=math.pi / 2,
        point_noise_m=0.0,
        reading_noise_m=float(settings["noise_mm"]) / 1000,
        scale_sigma=0.0,
        offset_sigma_m=0.0,
        clock_drift=float(settings.get("clock_drift", 0.0)),
        latency_s=float(settings.get("latency_ms", 0.0)) / 1000,
        mount=Placement(Transform("flange", "laser", np.eye(4)), 0.0),
    )
    inside_m = float(settings["margin_mm"]) / 1000
    signal = Signal(start_m + inside_m, start_m + range_m - inside_m, float(settings["period_s"]))
    return Optics(spec, signal, 0.0, 0.0, rng), signal


def _seen(range_start_mm: float, range_mm: float, margin_mm: float = 1.0) -> Settings:
    """Settings that every laser has; its target, alone, keeps away from the ends of the range by a margin."""
    return {
        "range_start_mm": range_start_mm,
        "range_mm": range_mm,
        "margin_mm": margin_mm,
        "noise_mm": 0.0,
        "period_s": 20.0,
    }


def _optoncdt(settings: Settings, o: Optics) -> Simulated:
    sensor = OptoNcdt1420(o.spec, o.beam, o.scale, o.offset_m, o.rng, o.noise_factor)
    return on_serial_line(sensor, lambda: sensor.baud)


def _riftek(protocol: int) -> Callable[[Settings, Optics], Simulated]:
    def make(settings: Settings, o: Optics) -> Simulated:
        spec = RiftekSpec(
            serial_number=int(settings["serial_number"]),
            base_mm=round(o.spec.range_start_m * 1e3),
            range_mm=round(o.spec.range_m * 1e3),
            noise_m=o.spec.reading_noise_m,
            protocol=protocol,
        )
        head = Rf60x(spec, o.beam, o.scale, o.offset_m, o.rng, o.noise_factor)
        return on_serial_line(head, lambda: head.uart.baud)

    return make


def _keyence(settings: Settings, o: Optics) -> Simulated:
    spec = AmplifierSpec(zero_m=o.middle_m, span_m=o.spec.range_m, noise_m=o.noise_m)
    amplifiers = [
        Amplifier(spec, o.beam, o.scale, o.offset_m, o.rng) for _ in range(int(settings["amplifiers"]))
    ]
    unit = DlRs1a(amplifiers, int(settings["baud"]))
    return on_serial_line(unit, lambda: unit.uart.baud)


def _gocator(settings: Settings, o: Optics) -> Simulated:
    jobs = (str(settings["job"]), "other")
    spec = GocatorSpec(zero_m=o.middle_m, span_m=o.spec.range_m, jobs=jobs, noise_m=o.noise_m)
    head = Gocator(spec, o.beam, o.scale, o.offset_m, o.rng)
    return Simulated(head, {"": head.connect}, restart=head.restart)


def _ams(settings: Settings, o: Optics) -> Simulated:
    spec = AmsSpec(int(settings["node"]), int(settings["serial_number"]), noise_m=o.noise_m)
    return on_can_bus(Ams335i(spec, o.beam, o.scale, o.offset_m, o.rng))


LASERS: Final = (
    DeviceKind(
        "optoncdt-1420",
        "Micro-Epsilon distance laser on RS-422",
        "serial",
        _optoncdt,
        _alone,
        settings={
            "model": "ILD1420-100",
            "serial_number": "1420100",
            "version": "001.010",
            "baud": 921600,
            "latency_ms": 4.0,
            "clock_drift": 20e-6,
            **_seen(50.0, 100.0, 0.0),
        },
        other={"serial_number": "1420999"},
    ),
    *(
        DeviceKind(
            f"riftek-{name}",
            f"RIFTEK RF60x distance laser, {words}",
            "serial",
            _riftek(protocol),
            _alone,
            settings={"serial_number": 17185, **_seen(80.0, 50.0)},
            other={"serial_number": 17999},
        )
        for name, words, protocol in (
            ("binary", "binary protocol", BINARY),
            ("ascii", "ASCII protocol", ASCII),
            ("modbus", "Modbus RTU", MODBUS_RTU),
        )
    ),
    DeviceKind(
        "keyence-il",
        "Keyence DL-RS1A with IL laser amplifiers, RS-232",
        "serial",
        _keyence,
        _alone,
        settings={"amplifiers": 1, "baud": 9600, **_seen(75.0, 50.0)},
        other={"amplifiers": 2},
    ),
    DeviceKind(
        "gocator",
        "LMI Gocator profile sensor, Modbus TCP; knows no identity but its jobs",
        "tcp",
        _gocator,
        _alone,
        settings={"job": "block", **_seen(200.0, 200.0)},
        other={"job": "foreign"},
        sockets={"": 502},
    ),
    DeviceKind(
        "ams-335i",
        "Leuze AMS 335i distance laser, CANopen",
        "can",
        _ams,
        _alone,
        settings={"node": 16, "serial_number": 335001, **_seen(1000.0, 10_000.0)},
        other={"serial_number": 335999},
    ),
)
