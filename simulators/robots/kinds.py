"""Which robots can be simulated, by the name of their driver in the cell file: the same arm behind each."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import cycle
from typing import Final

import numpy as np

from estimation.transform import FloatArray
from simulators.device_kind import DeviceKind, Setting, Settings, Simulated
from simulators.robots.abb import AbbRobot, AbbSettings
from simulators.robots.canopen_arm import COUNT_RAD, SimulatedArm
from simulators.robots.igus_irc import IgusRobot, IgusSettings
from simulators.robots.mechanism import MechanicalArm
from simulators.robots.melfa import MelfaRobot, MelfaSettings
from simulators.robots.ur import UrRobot, UrSettings
from simulators.world.world_file import ArmSpec, LinkSpec

# The published dimensions of an IRB 1400: theta, alpha in degrees; d, a in metres.
GEOMETRY: Final = (
    (0.0, 0.475, 0.150, -90.0),
    (-90.0, 0.0, 0.600, 0.0),
    (0.0, 0.0, 0.120, -90.0),
    (0.0, 0.720, 0.0, 90.0),
    (0.0, 0.0, 0.0, -90.0),
    (180.0, 0.085, 0.0, 0.0),
)
ALONE: Final[Settings] = {"noise_deg": 0.0, "limit_deg": 170.0, "motion_speed": 1.0}
NODES: Final = "3,4,5,6,7,8"


@dataclass(frozen=True, slots=True, eq=False)
class Mechanics:
    """The arm that a controller or its drives move; as the constructors of all robots take it."""

    spec: ArmSpec
    rng: np.random.Generator
    noise_factors: FloatArray | None = None
    motion_speed: float = 1.0


def _alone(settings: Settings, rng: np.random.Generator) -> tuple[Mechanics, None]:
    """An arm of GEOMETRY; the settings give its noise and its limits."""
    nodes = tuple(int(node) for node in str(settings.get("nodes", NODES)).split(","))
    limit_rad = math.radians(float(settings["limit_deg"]))
    links = tuple(
        LinkSpec(
            {"theta": math.radians(theta), "d": d, "a": a, "alpha": math.radians(alpha), "beta": 0.0},
            {},
            -limit_rad,
            limit_rad,
        )
        for _, (theta, d, a, alpha) in zip(nodes, cycle(GEOMETRY), strict=False)
    )
    spec = ArmSpec(
        nodes=nodes,
        device_name=str(settings.get("device_name", "")),
        serial_number=int(settings["serial_number"]) if "nodes" in settings else 0,
        speed_limit_rad_s=math.radians(90),
        acceleration_rad_s2=math.radians(200),
        quick_stop_rad_s2=math.radians(800),
        enable_delay_s=float(settings.get("enable_delay_s", 0.05)),
        boot_time_s=float(settings.get("boot_time_s", 0.4)),
        fast_move_rad_s=math.radians(10),
        noise_rad=math.radians(float(settings["noise_deg"])),
        encoder_step_rad=COUNT_RAD,
        start_joints_rad=np.zeros(len(links)),
        links=links,
    )
    return Mechanics(spec, rng, None, float(settings["motion_speed"])), None


def _on_network(robot: MechanicalArm) -> Simulated:
    return Simulated(robot, robot.connections(), restart=robot.restart, update=robot.advance)


def _canopen(settings: Settings, m: Mechanics) -> Simulated:
    arm = SimulatedArm(m.spec, m.rng, m.noise_factors, m.motion_speed)
    return Simulated(arm, can=arm, restart=arm.restart, update=arm.advance)


def _melfa_serial(settings: Settings, m: Mechanics) -> Simulated:
    baud = int(settings["baud"])
    own = MelfaSettings(robot=str(settings["robot"]), baud=baud)
    robot = MelfaRobot(m.spec, m.rng, m.noise_factors, m.motion_speed, own)
    line = {"": robot.connections()[""]}
    return Simulated(robot, line, baud=lambda: baud, restart=robot.restart, update=robot.advance)


def _melfa_tcp(settings: Settings, m: Mechanics) -> Simulated:
    own = MelfaSettings(robot=str(settings["robot"]))
    return _on_network(MelfaRobot(m.spec, m.rng, m.noise_factors, m.motion_speed, own))


def _igus(settings: Settings, m: Mechanics) -> Simulated:
    own = IgusSettings(software=int(settings["software"]))
    return _on_network(IgusRobot(m.spec, m.rng, m.noise_factors, m.motion_speed, own))


def _ur(settings: Settings, m: Mechanics) -> Simulated:
    own = UrSettings(model=str(settings["model"]), serial_number=str(settings["serial_number"]))
    return _on_network(UrRobot(m.spec, m.rng, m.noise_factors, m.motion_speed, own))


def _abb(settings: Settings, m: Mechanics) -> Simulated:
    own = AbbSettings(model=str(settings["model"]), serial_number=str(settings["serial_number"]))
    return _on_network(AbbRobot(m.spec, m.rng, m.noise_factors, m.motion_speed, own))


def _on_tcp(
    name: str,
    what: str,
    make: Callable[[Settings, Mechanics], Simulated],
    own: Mapping[str, Setting],
    other: Mapping[str, Setting],
    sockets: Mapping[str, int],
) -> DeviceKind[Mechanics]:
    return DeviceKind(name, what, "tcp", make, _alone, {**own, **ALONE}, other, sockets)


ROBOTS: Final = (
    DeviceKind(
        "canopen-402",
        "six-axis arm, CANopen CiA 402, behind an slcan dongle",
        "can",
        _canopen,
        _alone,
        settings={
            "nodes": NODES,
            "device_name": "PRBT",
            "serial_number": 20260300,
            "enable_delay_s": 0.05,
            "boot_time_s": 0.4,
            **ALONE,
            "noise_deg": 0.0015,
        },
        other={"serial_number": 20269900},
    ),
    _on_tcp(
        "abb-open",
        "ABB controller with the open_abb server",
        _abb,
        {"model": "IRB 1400", "serial_number": "14-21858"},
        {"serial_number": "14-99999"},
        {"": 5000},
    ),
    _on_tcp("igus-irc", "igus iRC, Modbus TCP", _igus, {"software": 902}, {"software": 900}, {"": 502}),
    DeviceKind(
        "melfa-serial",
        "Mitsubishi MELFA, R-protocol on RS-232 (8E2)",
        "serial",
        _melfa_serial,
        _alone,
        settings={"robot": "RV-4FL-D", "baud": 9600, **ALONE},
        other={"robot": "RV-7FL-D"},
    ),
    _on_tcp(
        "melfa-tcp",
        "Mitsubishi MELFA, R-protocol on TCP; the second session is for a stop",
        _melfa_tcp,
        {"robot": "RV-4FL-D"},
        {"robot": "RV-7FL-D"},
        {"": 10001, "stop": 10002},
    ),
    _on_tcp(
        "ur",
        "Universal Robots: RTDE, URScript and dashboard",
        _ur,
        {"model": "UR5", "serial_number": "20235500123"},
        {"serial_number": "20235509999"},
        {"": 30004, "script": 30002, "dashboard": 29999},
    ),
)
