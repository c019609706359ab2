"""Robots behind a controller of their own, without a cell around them. In all of them is the same arm."""

import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from simulators.device_kind import DeviceKind, Setting, Simulated
from simulators.robots.abb import AbbRobot, AbbSettings
from simulators.robots.igus_irc import IgusRobot, IgusSettings
from simulators.robots.melfa import MelfaRobot, MelfaSettings
from simulators.robots.ur import UrRobot, UrSettings
from simulators.world.world_file import ArmSpec, LinkSpec

LoneRobot = AbbRobot | IgusRobot | MelfaRobot | UrRobot
Make = Callable[[ArmSpec, np.random.Generator, float, Mapping[str, Setting]], LoneRobot]

# The published dimensions of an IRB 1400: theta, alpha in degrees; d, a in metres.
GEOMETRY: Final = (
    (0.0, 0.475, 0.150, -90.0),
    (-90.0, 0.0, 0.600, 0.0),
    (0.0, 0.0, 0.120, -90.0),
    (0.0, 0.720, 0.0, 90.0),
    (0.0, 0.0, 0.0, -90.0),
    (180.0, 0.085, 0.0, 0.0),
)
SETTINGS: Final[Mapping[str, Setting]] = {"noise_deg": 0.0, "limit_deg": 170.0, "motion_speed": 1.0}


def arm_spec(settings: Mapping[str, Setting]) -> ArmSpec:
    """An arm of this geometry; the settings give its noise and its limits."""
    limit_rad = math.radians(float(settings["limit_deg"]))
    links = tuple(
        LinkSpec(
            {"theta": math.radians(theta), "d": d, "a": a, "alpha": math.radians(alpha), "beta": 0.0},
            {},
            -limit_rad,
            limit_rad,
        )
        for theta, d, a, alpha in GEOMETRY
    )
    return ArmSpec(
        nodes=tuple(range(1, len(links) + 1)),
        device_name="",
        serial_number=0,
        speed_limit_rad_s=math.radians(90),
        acceleration_rad_s2=math.radians(200),
        quick_stop_rad_s2=math.radians(800),
        enable_delay_s=0.05,
        boot_time_s=0.4,
        fast_move_rad_s=math.radians(10),
        noise_rad=math.radians(float(settings["noise_deg"])),
        encoder_step_rad=0.0,
        start_joints_rad=np.zeros(len(links)),
        links=links,
    )


def _kind(
    name: str,
    what: str,
    make: Make,
    own: Mapping[str, Setting],
    other: Mapping[str, Setting],
    sockets: Mapping[str, int] | None = None,
) -> DeviceKind:
    """`sockets` as the robot names its connections; None for a serial line."""

    def alone(settings: Mapping[str, Setting], seed: int) -> Simulated:
        rng, speed = np.random.default_rng(seed), float(settings["motion_speed"])
        robot = make(arm_spec(settings), rng, speed, settings)
        connect = robot.connections()
        if sockets is None:
            baud = int(settings["baud"])
            return Simulated(
                robot,
                {"": connect["robot"]},
                baud=lambda: baud,
                restart=robot.restart,
                update=robot.advance,
            )
        return Simulated(robot, connect, restart=robot.restart, update=robot.advance)

    return DeviceKind(
        name=name,
        what=what,
        link="serial" if sockets is None else "tcp",
        make=alone,
        settings={**own, **SETTINGS},
        other=other,
        sockets=sockets or {"": 0},
    )


def _melfa(spec: ArmSpec, rng: np.random.Generator, speed: float, own: Mapping[str, Setting]) -> MelfaRobot:
    settings = MelfaSettings(robot=str(own["robot"]), baud=int(own.get("baud", 0)))
    return MelfaRobot(spec, rng, None, speed, settings)


def _igus(spec: ArmSpec, rng: np.random.Generator, speed: float, own: Mapping[str, Setting]) -> IgusRobot:
    return IgusRobot(spec, rng, None, speed, IgusSettings(software=int(own["software"])))


def _ur(spec: ArmSpec, rng: np.random.Generator, speed: float, own: Mapping[str, Setting]) -> UrRobot:
    settings = UrSettings(model=str(own["model"]), serial_number=str(own["serial_number"]))
    return UrRobot(spec, rng, None, speed, settings)


def _abb(spec: ArmSpec, rng: np.random.Generator, speed: float, own: Mapping[str, Setting]) -> AbbRobot:
    settings = AbbSettings(model=str(own["model"]), serial_number=str(own["serial_number"]))
    return AbbRobot(spec, rng, None, speed, settings)


KINDS: Final = (
    _kind(
        "abb-open",
        "ABB controller with the open_abb server",
        _abb,
        {"model": "IRB 1400", "serial_number": "14-21858"},
        {"serial_number": "14-99999"},
        {"robot": 5000},
    ),
    _kind(
        "igus-irc",
        "igus iRC, Modbus TCP",
        _igus,
        {"software": 902},
        {"software": 900},
        {"robot": 502},
    ),
    _kind(
        "melfa-serial",
        "Mitsubishi MELFA, R-protocol on RS-232 (8E2)",
        _melfa,
        {"robot": "RV-4FL-D", "baud": 9600},
        {"robot": "RV-7FL-D"},
    ),
    _kind(
        "melfa-tcp",
        "Mitsubishi MELFA, R-protocol on TCP; the second session is for a stop",
        _melfa,
        {"robot": "RV-4FL-D"},
        {"robot": "RV-7FL-D"},
        {"robot": 10001, "robot.stop": 10002},
    ),
    _kind(
        "ur",
        "Universal Robots: RTDE, URScript and dashboard",
        _ur,
        {"model": "UR5", "serial_number": "20235500123"},
        {"serial_number": "20235509999"},
        {"robot": 30004, "robot.script": 30002, "robot.dashboard": 29999},
    ),
)
