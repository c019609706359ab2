"""The drivers of laser and probe, from their tables in the cell file."""

from typing import Final

from controller.cellfile.lasers import (
    AmsLaser,
    AnyLaser,
    GocatorLaser,
    KeyenceLaser,
    OptoncdtLaser,
    RiftekLaser,
)
from controller.cellfile.probes import AdamProbe, AnyProbe, ForceProbe, GaugeProbe, WagoProbe
from drivers import capabilities
from drivers.clock import Clock
from drivers.links.interfaces import Ports
from drivers.probes import adam6052, wago750
from drivers.probes.dlrs1a import GaugePress
from drivers.probes.ft300 import Ft300Press
from drivers.probes.threshold import ThresholdConfig, ThresholdProbe
from drivers.sensors import ams335i, gocator, optoncdt, riftek_settings
from drivers.sensors.dlrs1a import DlRs1a, DlRs1aConfig
from drivers.sensors.ft300 import PERIOD_S, Ft300, Ft300Config
from drivers.sensors.riftek import RiftekLaser as RiftekStream
from drivers.sensors.riftek_ascii import RiftekAsciiLaser
from drivers.sensors.riftek_modbus import RiftekModbusLaser

# How long each link may be silent; times `patience` where simulated devices share a busy computer.
LASER_SILENCE_S: Final = 0.25
LASER_PROMPT_S: Final = 0.5
REPLY_TIMEOUT_S: Final = 0.2
ANSWER_S: Final = 0.1
SDO_TIMEOUT_S: Final = 0.3
SYNC_ANSWER_S: Final = 0.05

SEARCH_GAP_S: Final = 0.5  # between two polls of a search; `Acquisition` asks far more of a touch that counts

BURST_S: Final = 0.02  # serial converters hand over what they have within this
FRAME_LATENCY_S: Final = 0.02  # a force is so old when its frame has come


def make_laser(laser: AnyLaser, ports: Ports, clock: Clock, patience: float) -> capabilities.RangeSensor:
    """The driver of a laser, not connected yet."""
    match laser:
        case OptoncdtLaser():
            return _optoncdt(laser, ports, clock, patience)
        case RiftekLaser():
            return _riftek(laser, ports, clock, patience)
        case KeyenceLaser():
            unit = DlRs1aConfig(
                head="IL",
                amplifiers=laser.amplifiers,
                amplifier=laser.amplifier,
                zero_m=laser.zero_m,
                towards=laser.towards,
                noise_m=laser.reading_noise_m,
                response_s=laser.response_s,
                baud=laser.baud,
            )
            return DlRs1a(ports.serial("laser", laser.port, laser.baud), unit, clock)
        case GocatorLaser():
            head = gocator.GocatorConfig(
                zero_m=laser.zero_m,
                rate_hz=laser.rate_hz,
                measurement=laser.measurement,
                towards=laser.towards,
                job=laser.job,
                noise_m=laser.reading_noise_m,
                reply_timeout_s=REPLY_TIMEOUT_S * patience,
            )
            return gocator.Gocator(ports.tcp("laser", laser.host, laser.port), head, clock)
        case AmsLaser():
            bus = ports.can_bus("laser", laser.interface, laser.port, laser.bitrate)
            config = ams335i.AmsConfig(
                node=laser.node,
                step_m=laser.step_m,
                range_start_m=laser.range_start_m,
                serial_number=laser.serial_number,
                noise_m=laser.reading_noise_m,
                answer_s=SYNC_ANSWER_S * patience,
                sdo_timeout_s=SDO_TIMEOUT_S * patience,
            )
            return ams335i.Ams335i(bus, config, clock)


def make_probe(probe: AnyProbe, ports: Ports, clock: Clock, patience: float) -> capabilities.TouchProbe:
    """The driver of a probe, not connected yet."""
    gap_s = SEARCH_GAP_S * patience
    match probe:
        case AdamProbe():
            module = adam6052.ProbeConfig(
                channel=probe.channel,
                poll_period_s=probe.poll_period_s,
                model=probe.model,
                longest_gap_s=gap_s,
                reply_timeout_s=REPLY_TIMEOUT_S * patience,
            )
            return adam6052.AdamProbe(ports.tcp("probe", probe.host, probe.port), module, clock)
        case WagoProbe():
            bus = ports.can_bus("probe", probe.interface, probe.port, probe.bitrate)
            station = wago750.WagoConfig(
                node=probe.node,
                channel=probe.channel,
                model=probe.model,
                event_timer_s=probe.poll_period_s,
                longest_gap_s=gap_s,
                sdo_timeout_s=SDO_TIMEOUT_S * patience,
            )
            return wago750.WagoProbe(bus, station, clock)
        case ForceProbe():
            sensor = Ft300(
                ports.serial("probe", probe.port, 19200),
                Ft300Config(probe.serial_number, worst_answer_s=ANSWER_S * patience),
                clock,
            )
            limits = ThresholdConfig(
                probe.threshold_newton,
                probe.release_newton,
                probe.free_newton,
                "N",
                period_s=PERIOD_S,
                latency_s=FRAME_LATENCY_S,
                longest_gap_s=gap_s,
            )
            return ThresholdProbe(Ft300Press(sensor), limits, clock)
        case GaugeProbe():
            return _gauge(probe, ports, clock, gap_s)


def _optoncdt(laser: OptoncdtLaser, ports: Ports, clock: Clock, patience: float) -> capabilities.RangeSensor:
    config = optoncdt.LaserConfig(
        range_m=laser.range_m,
        range_start_m=laser.range_start_m,
        rate_hz=laser.rate_hz,
        baud=laser.baud,
        model=laser.model,
        serial_number=laser.serial_number,
        noise_m=laser.reading_noise_m,
        drain_silence_s=BURST_S,
        silence_s=LASER_SILENCE_S * patience,
        prompt_timeout_s=LASER_PROMPT_S * patience,
    )
    return optoncdt.OptoncdtLaser(ports.serial("laser", laser.port, laser.baud), config, clock)


def _riftek(laser: RiftekLaser, ports: Ports, clock: Clock, patience: float) -> capabilities.RangeSensor:
    config = riftek_settings.RiftekConfig(
        base_m=laser.range_start_m,
        range_m=laser.range_m,
        serial_number=laser.serial_number,
        address=laser.address,
        baud=laser.baud,
        rate_hz=laser.rate_hz,
        averages=laser.averages,
        noise_m=laser.reading_noise_m,
        first_register=laser.first_register,
        worst_answer_s=ANSWER_S * patience,
        silence_s=LASER_SILENCE_S * patience,
        echo=laser.echo,
    )
    link = ports.serial("laser", laser.port, laser.baud, riftek_settings.FRAMING)
    match laser.driver:
        case "riftek-ascii":
            return RiftekAsciiLaser(link, config, clock)
        case "riftek-binary":
            return RiftekStream(link, config, clock)
        case "riftek-modbus":
            return RiftekModbusLaser(link, config, clock)


def _gauge(probe: GaugeProbe, ports: Ports, clock: Clock, gap_s: float) -> capabilities.TouchProbe:
    unit = DlRs1aConfig(
        head="GT2",
        amplifiers=probe.amplifiers,
        amplifier=probe.amplifier,
        response_s=probe.response_s,
        baud=probe.baud,
    )
    gauge = DlRs1a(ports.serial("probe", probe.port, probe.baud), unit, clock)
    limits = ThresholdConfig(
        probe.threshold_m,
        probe.release_m,
        probe.free_m,
        "m",
        period_s=gauge.period_s,
        latency_s=gauge.period_s + probe.response_s,
        longest_gap_s=gap_s,
    )
    return ThresholdProbe(GaugePress(gauge, clock, probe.response_s), limits, clock)
