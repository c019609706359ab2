"""The drivers of a cell, from its file and from where links come: real ports or the deterministic cell."""

from typing import Final

from controller.cellfile import Cell
from controller.robots import make_robot
from drivers.capabilities import Devices
from drivers.clock import Clock
from drivers.links.interfaces import Ports
from drivers.probes.adam6052 import AdamProbe, ProbeConfig
from drivers.sensors.optoncdt import LaserConfig, OptoncdtLaser

# How long each link may be silent; times `patience` where simulated devices share a busy computer.
LASER_SILENCE_S: Final = 0.25
LASER_PROMPT_S: Final = 0.5
REPLY_TIMEOUT_S: Final = 0.2

SEARCH_GAP_S: Final = 0.5  # between two polls of a search; `Acquisition` asks far more of a touch that counts

BURST_S: Final = 0.02  # serial converters hand over what they have within this


def make_devices(cell: Cell, ports: Ports, clock: Clock, *, keep_alive_thread: bool) -> Devices:
    """Drivers that are not connected yet."""
    laser, probe, patience = cell.laser, cell.probe, cell.cell.patience
    robot = make_robot(cell.robot, ports, clock, patience=patience, keep_alive_thread=keep_alive_thread)
    range_sensor = OptoncdtLaser(
        ports.serial("laser", laser.port, laser.baud),
        LaserConfig(
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
        ),
        clock,
    )
    touch_probe = AdamProbe(
        ports.tcp("probe", probe.host, probe.port),
        ProbeConfig(
            channel=probe.channel,
            poll_period_s=probe.poll_period_s,
            model=probe.model,
            longest_gap_s=SEARCH_GAP_S * patience,
            reply_timeout_s=REPLY_TIMEOUT_S * patience,
        ),
        clock,
    )
    return Devices(robot, range_sensor, touch_probe)
