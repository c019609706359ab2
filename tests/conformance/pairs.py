"""The table of the conformance kit: one line for each driver and its simulator.

A line says how the driver is made, and what a piece of normal work is. `work` raises what the driver raises,
and asserts that every value it is given is true and was measured within the work.
"""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from controller.cellfile.robots import Robot as RobotTable
from controller.robots import make_robot
from drivers.capabilities import Device, ForceSensor, RangeSensor, Robot, TouchProbe
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.probes.adam6052 import AdamProbe, ProbeConfig
from drivers.probes.wago750 import WagoConfig, WagoProbe
from drivers.sensors.ams335i import Ams335i, AmsConfig
from drivers.sensors.dlrs1a import DlRs1a, DlRs1aConfig
from drivers.sensors.ft300 import Ft300, Ft300Config
from drivers.sensors.gocator import Gocator, GocatorConfig
from drivers.sensors.optoncdt import LaserConfig, OptoncdtLaser
from drivers.sensors.riftek import RiftekLaser
from drivers.sensors.riftek_ascii import RiftekAsciiLaser
from drivers.sensors.riftek_modbus import RiftekModbusLaser
from drivers.sensors.riftek_settings import RiftekConfig
from estimation.transform import FloatArray
from simulators.device_kind import Simulated
from tests.drivers.robots.rig import ABB, CELL, IGUS, MELFA_SERIAL, MELFA_TCP, OF_CANOPEN, UR, frozen

STREAMED = 40  # values of a stream in a piece of work, at most
Work = Callable[[Any, Simulated, Clock, np.random.Generator], None]


@dataclass(frozen=True)
class Pair:
    kind: str  # of simulators/registry.py
    driver: Callable[[Any, Clock], Device]  # from ports, as the cell has them
    work: Work
    boot_s: float = 5.0  # after which a restarted device must work again
    unseen: Mapping[str, str] = field(
        default_factory=dict
    )  # faults that nothing in the protocol reveals; why
    unseen_together: tuple[tuple[str, ...], ...] = ()  # groups; one of each in the same packet
    delay_s: float = 5.0  # longest time in which work ends, whatever the wire does
    skips_s: float = 0.0  # so long a stream is dropped at the start of work
    latest_s: float = 0.2  # after which the device answers late, as the driver is told
    budget_s: float = 0.25  # from a fault until it is noticed: STANDARDS B3, or as the driver declares


def fresh(values: FloatArray, device: Simulated, since_s: float, clock: Clock, tolerance: float) -> None:
    """Every value is that of an instant within [since_s, now], up to `tolerance` in its own unit."""
    signal = device.signal
    assert signal is not None
    now_s = clock.now_s()
    slack_s = tolerance / abs(signal.high - signal.low) * signal.period_s
    for value in values:
        instant_s = signal.instant_s(float(value), now_s)
        assert since_s - slack_s <= instant_s <= now_s + slack_s, (
            f"{value} was measured at {instant_s:.4f} s, asked in {since_s:.4f} to {now_s:.4f} s"
        )


def measure_range(
    tolerance_m: float, laser: RangeSensor, device: Simulated, clock: Clock, rng: Any, *, most: int = 8
) -> None:
    since_s = clock.now_s()
    laser.begin_window()
    fresh(laser.end_window(int(rng.integers(1, most))).distance_m, device, since_s, clock, tolerance_m)


def measure_force(sensor: ForceSensor, device: Simulated, clock: Clock, rng: Any) -> None:
    since_s = clock.now_s()
    sensor.begin_window()
    fresh(sensor.end_window(int(rng.integers(1, STREAMED))).force_n[:, 0], device, since_s, clock, 0.05)


def wait_for_touch(period_s: float, probe: TouchProbe, device: Simulated, clock: Clock, rng: Any) -> None:
    """The contact closes at every multiple of the period, for half of it."""
    clock.sleep((0.6 - clock.now_s() / period_s) % 1.0 * period_s)  # it is open now
    probe.arm()
    armed_s = clock.now_s()
    while (touched_s := probe.touched_at_s()) is None:
        assert clock.now_s() < armed_s + 2.0 * period_s, "the touch was never seen"
    late_s = touched_s % period_s
    assert late_s <= probe.poll_uncertainty_s and touched_s <= clock.now_s()


def move_and_read(tolerance_rad: float, robot: Robot, device: Simulated, clock: Clock, rng: Any) -> None:
    target_rad = rng.uniform(-0.1, 0.1, 6)
    robot.move_joints(target_rad)
    readings = robot.read_joints(2)
    assert np.max(np.abs(readings.joints_rad - device.model.joints_at(clock.now_s()))) < tolerance_rad
    assert np.max(np.abs(readings.joints_rad - target_rad)) < tolerance_rad


def on(make: Callable[[Any, Any, Clock], Device], config: object, ports: Any, clock: Clock) -> Device:
    """A driver with one link."""
    link: ByteLink = next(iter(ports.links.values()))
    return make(link, config, clock)


def arm(settings: dict[str, Any], ports: Any, clock: Clock) -> Device:
    table = tomllib.loads((CELL / "cell.toml").read_text())["robot"]
    if settings:
        table = {key: value for key, value in table.items() if key not in OF_CANOPEN} | settings
    robot: RobotTable = TypeAdapter(RobotTable).validate_python(frozen(table))
    return make_robot(robot, ports, clock, keep_alive_thread=False)


STALE_S = 0.06  # a stream does not tell its age: the driver is told how late it may be
RIFTEK = RiftekConfig(base_m=0.080, range_m=0.050, serial_number="17185", stale_s=STALE_S)
OPTO = LaserConfig(
    range_m=0.1, range_start_m=0.05, model="ILD1420-100", serial_number="1420100", stale_s=STALE_S
)
AMS = AmsConfig(16, serial_number="335001")
KEYENCE = DlRs1aConfig("IL", zero_m=0.1, towards=True)
GAUGE = DlRs1aConfig("GT2", response_s=0.003, baud=38400)
ROBOTIQ = Ft300Config(serial_number="FTD-0417", stale_s=STALE_S)
LMI = GocatorConfig(0.3, 200.0, job="block")
WAGO = WagoConfig(20, model="750-337", stale_s=0.1)
PERIOD_S = 0.5  # of contacts
FRAMED = {"corrupt": "the protocol has no check; TCP below it has one, which does not pass this on"}
BUS = dict.fromkeys(
    ("corrupt", "double-byte"), "the protocol has no check; CAN below it has one, which does not pass this on"
)
NO_CHECK = {"corrupt": "the protocol has no check: a flipped bit can leave another value"}
SWAPPED = NO_CHECK | {"reorder": "the protocol has no check: swapped digits are another number"}
NO_DIGITS = dict.fromkeys(
    ("lose-byte", "double-byte"), "numbers have no fixed width: one with a digit less or more is another"
)
# On a line the bytes come one by one, on TCP a message comes whole.
NO_WIDTH = SWAPPED | NO_DIGITS | dict.fromkeys(("drop", "truncate"), NO_DIGITS["lose-byte"])
TEXT = FRAMED | NO_DIGITS
RIFTEKS: tuple[tuple[str, Any, Mapping[str, str]], ...] = (
    ("binary", RiftekLaser, NO_CHECK),
    ("ascii", RiftekAsciiLaser, NO_WIDTH),
    ("modbus", RiftekModbusLaser, {}),
)
LOST_AND_DOUBLED = (("drop", "truncate", "lose-byte"), ("duplicate", "double-byte"))
motion = partial(move_and_read, 1e-3)
SLACK_S = 0.02  # of a budget: until the driver looks again
MOVE_REPLY_S = 6.5  # the server answers a move when it has ended: a lost answer is waited for so long

PAIRS = [
    Pair("canopen-402", partial(arm, {}), motion, delay_s=30.0, unseen=BUS, latest_s=0.02),
    Pair(
        "abb-open",
        partial(arm, ABB | {"serial_number": "14-21858"}),
        motion,
        delay_s=60.0,
        unseen=TEXT,
        latest_s=0.5,
        budget_s=MOVE_REPLY_S,
    ),
    Pair("igus-irc", partial(arm, IGUS), motion, delay_s=30.0, unseen=FRAMED),
    *(
        Pair(
            name,
            partial(arm, settings),
            motion,
            delay_s=30.0,
            unseen=unseen,
            latest_s=0.5,
            budget_s=0.5 + SLACK_S,
        )
        for name, settings, unseen in (
            ("melfa-serial", MELFA_SERIAL, NO_WIDTH),
            ("melfa-tcp", MELFA_TCP, TEXT),
        )
    ),
    Pair("ur", partial(arm, UR), motion, delay_s=30.0, unseen=FRAMED, latest_s=0.3, budget_s=0.3 + SLACK_S),
    Pair(
        "optoncdt-1420",
        partial(on, OptoncdtLaser, OPTO),
        partial(measure_range, 6e-5, most=STREAMED),
        unseen=NO_CHECK,
        skips_s=STALE_S,
        latest_s=STALE_S,
        budget_s=0.25 + SLACK_S,
    ),
    *(
        Pair(
            f"riftek-{name}",
            partial(on, make, RIFTEK),
            partial(measure_range, 1e-5, most=STREAMED if name == "binary" else 8),
            unseen=unseen,
            unseen_together=LOST_AND_DOUBLED if name == "binary" else (),
            skips_s=STALE_S if name == "binary" else 0.0,
            latest_s=STALE_S if name == "binary" else 0.1,
            budget_s=0.25 + SLACK_S,
        )
        for name, make, unseen in RIFTEKS
    ),
    Pair("ams-335i", partial(on, Ams335i, AMS), partial(measure_range, 2e-3), unseen=BUS, latest_s=0.05),
    *(
        Pair(
            name,
            partial(on, DlRs1a, config),
            partial(measure_range, tolerance_m),
            unseen=SWAPPED,
            delay_s=12.0,
            latest_s=1.0,
            budget_s=1.0 + SLACK_S,
        )
        for name, config, tolerance_m in (("keyence-il", KEYENCE, 3e-5), ("keyence-gt2", GAUGE, 1e-5))
    ),
    Pair("robotiq-ft300", partial(on, Ft300, ROBOTIQ), measure_force, skips_s=STALE_S, latest_s=STALE_S),
    Pair("gocator", partial(on, Gocator, LMI), partial(measure_range, 3e-5), boot_s=12.0, unseen=FRAMED),
    Pair(
        "adam-6052", partial(on, AdamProbe, ProbeConfig()), partial(wait_for_touch, PERIOD_S), unseen=FRAMED
    ),
    Pair(
        "wago-750-337",
        partial(on, WagoProbe, WAGO),
        partial(wait_for_touch, PERIOD_S),
        unseen=BUS,
        latest_s=0.1,
        budget_s=0.6 + SLACK_S,  # two attempts to read an object
    ),
]
