"""Looks at each device of a cell without moving anything: who it is, what it measures, how its link does.

The robot is asked to stop before it is connected: motors stay as they are, and no motion is possible.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from drivers.capabilities import Device, Devices, Identity, LinkHealth, RangeSensor, Robot, TouchProbe
from estimation.errors import DeviceError

READINGS: Final = 5  # of the joints
CYCLES: Final = 20  # of the laser


@dataclass(frozen=True, slots=True)
class Seen:
    """One device: its identity and live values, or why there are none."""

    role: str
    driver: str
    port: str
    identity: Identity | None = None
    values: Mapping[str, Any] = field(default_factory=dict)  # names carry their units
    health: LinkHealth | None = None
    problem: str = ""
    remedy: str = ""

    @property
    def is_well(self) -> bool:
        """Whether it answered, is the one that was expected, and measures."""
        return not self.problem

    def as_json(self) -> dict[str, Any]:
        """As `truecell devices probe --json` prints it."""
        return {**asdict(self), "well": self.is_well}


def probe_devices(
    devices: Devices, drivers: Mapping[str, tuple[str, str]], tell: Callable[[str], None]
) -> Iterator[Seen]:
    """Connect, look at and close one device after the other; a fault of one does not keep the others.

    `drivers` has driver and port of each role, for the record; `tell` hears what comes next.
    """
    devices.robot.stop()
    for role, device in devices.by_role().items():
        driver, port = drivers[role]
        tell(f"{role}: {driver} at {port}")
        seen = Seen(role, driver, port)
        identity, values = None, dict[str, Any]()
        try:
            identity = devices.connect(device)
            values = _values(device, devices)
        except DeviceError as error:
            seen = Seen(role, driver, port, problem=error.problem, remedy=error.remedy)
        finally:
            health = device.health()
            device.close()
        yield Seen(role, driver, port, identity, values, health, seen.problem, seen.remedy)


def _values(device: Device, devices: Devices) -> dict[str, Any]:
    if device is devices.robot:
        return _joints(devices.robot)
    if device is devices.laser:
        return _distance(devices.laser)
    return _contact(devices.probe)


def _joints(robot: Robot) -> dict[str, Any]:
    readings = np.degrees(robot.read_joints(READINGS).joints_rad)
    return {
        "joints_deg": readings.mean(axis=0).round(4).tolist(),
        "scatter_deg": round(float(readings.std(axis=0, ddof=1).max()), 5),
    }


def _distance(laser: RangeSensor) -> dict[str, Any]:
    laser.begin_window()
    readings = laser.end_window(CYCLES)
    distance_mm = readings.distance_m * 1e3
    return {
        "distance_mm": round(float(distance_mm.mean()), 4) if distance_mm.size else None,
        "scatter_mm": round(float(distance_mm.std(ddof=1)), 4) if distance_mm.size > 1 else None,
        "cycles": int(distance_mm.size),
        "rejected": readings.rejected,
        "why": ", ".join(readings.rejected_kinds),
    }


def _contact(probe: TouchProbe) -> dict[str, Any]:
    return {"open": probe.is_open(), "latest_after_ms": round(probe.poll_uncertainty_s * 1e3, 2)}
