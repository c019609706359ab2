"""The driver of a robot, from its table in the cell file."""

import math
from pathlib import Path
from typing import Any, Final

from controller.cellfile.arm import Arm
from controller.cellfile.robots import (
    AbbRobot,
    CanopenRobot,
    IgusRobot,
    MelfaSerialRobot,
    MelfaTcpRobot,
    Robot,
    UrRobot,
)
from drivers import capabilities
from drivers.clock import Clock, RealClock
from drivers.links.interfaces import Ports
from drivers.links.ports import RealPorts
from drivers.robots.abb import AbbConfig, AbbController
from drivers.robots.canopen_arm import CanopenArm
from drivers.robots.canopen_arm_setup import ArmConfig
from drivers.robots.controller_arm import ControllerArm
from drivers.robots.igus_irc import IgusConfig, IgusController
from drivers.robots.melfa import MelfaConfig, MelfaController
from drivers.robots.robot_controller import ControllerArmConfig
from drivers.robots.ur import UrConfig, UrController, UrLinks

# How long each link may be silent; times `patience` where simulated devices share a busy computer.
HEARTBEAT_TIMEOUT_S: Final = 0.25  # of a drive
MASTER_TIMEOUT_S: Final = 0.5  # of this controller, as the drives see it
LATEST_ANSWER_S: Final = 0.02  # to a SYNC
SDO_TIMEOUT_S: Final = 0.3
ABB_REPLY_S: Final = 0.5
IGUS_REPLY_S: Final = 0.2
MELFA_REPLY_S: Final = 0.5
SILENCE_S: Final = 0.2  # so long drives move on without SYNC, and may leave SYNCs unanswered

UR_REPLY_S: Final = 0.3
UR_START_S: Final = 1.0  # from a program sent to its first statement

IGUS_START_GAP_S: Final = 0.3  # between the edge that starts a move and "moving"


def make_robot(
    robot: Robot, ports: Ports, clock: Clock, *, patience: float = 1.0, keep_alive_thread: bool = True
) -> capabilities.Robot:
    """The driver of a robot, not connected yet."""
    match robot:
        case AbbRobot():
            config = _arm_config(robot, start_gap_s=0.0, step_rad=robot.step_rad)
            return ControllerArm(_abb(robot, ports, clock, patience), config, clock)
        case CanopenRobot():
            return _canopen(robot, ports, clock, patience, keep_alive_thread)
        case IgusRobot():
            config = _arm_config(robot, start_gap_s=IGUS_START_GAP_S)
            return ControllerArm(_igus(robot, ports, clock, patience), config, clock)
        case MelfaTcpRobot() | MelfaSerialRobot():
            return ControllerArm(_melfa(robot, ports, clock, patience), _arm_config(robot), clock)
        case UrRobot():
            return ControllerArm(
                _ur(robot, ports, clock, patience), _arm_config(robot, start_gap_s=0.0), clock
            )


def abilities_of(robot: Robot) -> capabilities.RobotAbilities:
    """What the driver of a robot declares; nothing is opened."""
    clock = RealClock()
    return make_robot(robot, RealPorts(Path(), clock), clock).abilities


def abilities_as_words(abilities: capabilities.RobotAbilities) -> dict[str, Any]:
    """For a plan: how this arm stops, and how well its link knows where it was when the probe touched."""
    return {
        "stop": abilities.stop.value,
        "stop_delay_ms": round(abilities.stop_delay_s * 1e3, 1),
        "contact_delay_ms": round(abilities.contact_delay_s * 1e3, 1),
        "joint_step_deg": float(f"{math.degrees(abilities.joint_resolution_rad):.3g}"),
        "linear_moves": abilities.linear_moves,
        "reports_pose": abilities.reports_pose,
    }


def _canopen(
    robot: CanopenRobot, ports: Ports, clock: Clock, patience: float, keep_alive_thread: bool
) -> CanopenArm:
    silence_s = SILENCE_S * patience
    config = ArmConfig(
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
        touch_probe=robot.touch_probe,
    )
    link = ports.can_bus("robot", robot.interface, robot.port, robot.bitrate)
    return CanopenArm(link, config, clock, keep_alive_thread=keep_alive_thread)


def _arm_config(robot: Arm, **settings: float) -> ControllerArmConfig:
    """What every arm behind a controller of its own is told."""
    return ControllerArmConfig(
        lower_rad=tuple(joint.limits_rad[0] for joint in robot.joints),
        upper_rad=tuple(joint.limits_rad[1] for joint in robot.joints),
        speed_limit_rad_s=robot.speed_rad_s,
        acceleration_limit_rad_s2=robot.acceleration_rad_s2,
        in_position_rad=robot.in_position_rad,
        reading_noise_rad=robot.joint_noise_rad,
        **settings,
    )


def _melfa(
    robot: MelfaTcpRobot | MelfaSerialRobot, ports: Ports, clock: Clock, patience: float
) -> MelfaController:
    config = MelfaConfig(
        max_speed_rad_s=robot.max_speed_rad_s,
        model=robot.model,
        robot=robot.robot_number,
        slot=robot.slot,
        terminator=robot.terminator,
        program=robot.program,
        reply_timeout_s=MELFA_REPLY_S * patience,
        stop_delay_s=robot.stop_delay_s,
    )
    if isinstance(robot, MelfaSerialRobot):
        return MelfaController(ports.serial("robot", robot.port, robot.baud, robot.framing), config, clock)
    stop = None if robot.stop_port is None else ports.tcp("robot.stop", robot.host, robot.stop_port)
    return MelfaController(ports.tcp("robot", robot.host, robot.port), config, clock, stop)


def _igus(robot: IgusRobot, ports: Ports, clock: Clock, patience: float) -> IgusController:
    config = IgusConfig(
        max_speed_rad_s=robot.max_speed_rad_s,
        model=robot.model,
        reply_timeout_s=IGUS_REPLY_S * patience,
        stop_delay_s=robot.stop_delay_s,
        euler=robot.euler,
    )
    return IgusController(ports.tcp("robot", robot.host, robot.port), config, clock)


def _ur(robot: UrRobot, ports: Ports, clock: Clock, patience: float) -> UrController:
    config = UrConfig(
        acceleration_rad_s2=robot.acceleration_rad_s2,
        joint_step_rad=robot.encoder_step_rad,
        model=robot.model,
        serial_number=robot.serial_number,
        rate_hz=robot.rate_hz,
        register=robot.first_register,
        reply_timeout_s=UR_REPLY_S * patience,
        start_timeout_s=UR_START_S * patience,
        stop_delay_s=robot.stop_delay_s,
    )
    links = UrLinks(
        rtde=ports.tcp("robot", robot.host, robot.port),
        script=ports.tcp("robot.script", robot.host, robot.script_port),
        dashboard=ports.tcp("robot.dashboard", robot.host, robot.dashboard_port),
    )
    return UrController(links, config, clock)


def _abb(robot: AbbRobot, ports: Ports, clock: Clock, patience: float) -> AbbController:
    ramps_s = robot.speed_rad_s / robot.acceleration_rad_s2
    config = AbbConfig(
        reach_m=robot.reach_m,
        touch_step_s=robot.touch_step_s,
        stop_delay_s=robot.step_rad / robot.speed_rad_s + ramps_s,
        model=robot.model,
        serial_number=robot.serial_number,
        decimals=robot.decimals,
        quaternion_decimals=robot.quaternion_decimals,
        reply_timeout_s=ABB_REPLY_S * patience,
    )
    return AbbController(ports.tcp("robot", robot.host, robot.port), config, clock)
