"""The drivers of a cell, from its file and three links: real ports or the deterministic cell's."""

import math
from typing import Final

from controller.cellfile import Cell
from drivers.capabilities import Devices
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink, CanLink
from drivers.probes.adam6052 import AdamProbe, ProbeConfig
from drivers.robots.canopen_arm import CanopenArm
from drivers.robots.canopen_arm_setup import ArmConfig
from drivers.sensors.optoncdt import LaserConfig, OptoncdtLaser

# How long each link may be silent; times `patience` where simulated devices share a busy computer.
HEARTBEAT_TIMEOUT_S: Final = 0.25  # of a drive
MASTER_TIMEOUT_S: Final = 0.5  # of this controller, as the drives see it
LATEST_ANSWER_S: Final = 0.02  # to a SYNC
SDO_TIMEOUT_S: Final = 0.3
LASER_SILENCE_S: Final = 0.25
LASER_PROMPT_S: Final = 0.5
REPLY_TIMEOUT_S: Final = 0.2
SILENCE_S: Final = 0.2  # so long drives move on without SYNC, and may leave SYNCs unanswered

SEARCH_GAP_S: Final = 0.5  # between two polls of a search; `Acquisition` asks far more of a touch that counts

BURST_S: Final = 0.02  # serial converters hand over what they have within this


def make_devices(
    cell: Cell,
    clock: Clock,
    robot_link: CanLink,
    laser_link: ByteLink,
    probe_link: ByteLink,
    *,
    keep_alive_thread: bool,
) -> Devices:
    """Drivers that are not connected yet."""
    robot, laser, probe, patience = cell.robot, cell.laser, cell.probe, cell.cell.patience
    silence_s = SILENCE_S * patience
    arm = CanopenArm(
        robot_link,
        ArmConfig(
            node_ids=robot.nodes,
            lower_rad=tuple(joint.limits_rad[0] for joint in robot.joints),
            upper_rad=tuple(joint.limits_rad[1] for joint in robot.joints),
            speed_limit_rad_s=(robot.speed_rad_s,) * len(robot.joints),
            acceleration_limit_rad_s2=(robot.acceleration_rad_s2,) * len(robot.joints),
            in_position_rad=robot.in_position_rad,
            sync_period_s=robot.sync_period_s,
            cruise_sync_period_s=robot.cruise_sync_period_s,
            counts_per_rad=1.0 / robot.encoder_step_rad,
            most_missed_syncs=max(3, math.ceil(silence_s / (2.0 * robot.sync_period_s))),  # each costs two
            sync_timeout_factor=min(255, max(3, math.ceil(silence_s / robot.sync_period_s))),
            latest_answer_s=LATEST_ANSWER_S * patience,
            heartbeat_timeout_s=HEARTBEAT_TIMEOUT_S * patience,
            master_timeout_s=MASTER_TIMEOUT_S * patience,
            sdo_timeout_s=SDO_TIMEOUT_S * patience,
            model=robot.model,
        ),
        clock,
        keep_alive_thread=keep_alive_thread,
    )
    range_sensor = OptoncdtLaser(
        laser_link,
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
        probe_link,
        ProbeConfig(
            channel=probe.channel,
            poll_period_s=probe.poll_period_s,
            model=probe.model,
            longest_gap_s=SEARCH_GAP_S * patience,
            reply_timeout_s=REPLY_TIMEOUT_S * patience,
        ),
        clock,
    )
    return Devices(arm, range_sensor, touch_probe)
