"""Checks that compare values of a cell file with each other.

Every check asks for the tables it needs by the names of its parameters, and runs when these tables are in
order by themselves: a mistake in one table does not hide those in another.
"""

import inspect
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from controller.cellfile import job_checks, part_checks
from controller.cellfile.arm import Arm
from controller.cellfile.cell import Header
from controller.cellfile.lasers import Laser, OptoncdtLaser, RiftekLaser
from controller.cellfile.lines import KeyPath
from controller.cellfile.mistakes import Mistake, Source, nearest
from controller.cellfile.objects import Artefact, Bar, Part, Plate, Sphere
from controller.cellfile.probes import Probe
from controller.cellfile.robots import CanopenRobot
from controller.cellfile.tables import Placement
from controller.quantities import format_angle, format_duration, format_frequency, format_length

Finding = tuple[KeyPath, str, str]  # where, problem, remedy
Check = Callable[..., Iterator[Finding]]

SLCAN_FRAMES_PER_S: Final = 3000  # what a serial CAN dongle passes on without loss
SLCAN_MARGIN: Final = 1.2  # for heartbeats, emergencies and service data
CAN_FRAME_BITS: Final = 135  # 8 data bytes with stuffing and gap
CAN_LOAD: Final = 0.7  # above it, low priorities wait too long
OPTONCDT_BITS: Final = 3 * 10  # three bytes in each cycle, each with start and stop bit
RIFTEK_BITS: Final = 4 * 11  # four bytes, with parity as well
TOUCH_TRAVEL_M: Final = 5e-6  # largest travel between two polls
FULL_TURN_RAD: Final = 6.283185307179586
DRIVE_COUNTS: Final = 2**31  # positions are 32-bit integers
FRAMES: Final = ("base", "flange", "laser", "probe", "plate", "bar", "sphere", "part")
ROUNDING: Final = 1e-9  # relative


def find_inconsistencies(sections: dict[str, Any], source: Source, directory: Path) -> list[Mistake]:
    """Mistakes that only show when values are compared; `sections` are the tables in order by themselves."""
    available = {**sections, "directory": directory, "source": source}
    return [
        source.mistake(*finding)
        for check in (*CHECKS, *part_checks.CHECKS, *job_checks.CHECKS)
        if (wanted := inspect.signature(check).parameters.keys()) <= available.keys()
        for finding in check(**{name: available[name] for name in wanted})
    ]


def patience(cell: Header) -> Iterator[Finding]:
    """A real device that is late is a fault, however busy the computer is."""
    if cell.patience > 1.0 and not cell.simulated:
        yield ("cell", "patience"), f"{cell.patience:g} for real devices", "write 1, or simulated = true"


def joints(robot: Arm) -> Iterator[Finding]:
    """Limits and start of the joints."""
    if len(robot.start_joints_rad) != len(robot.joints):
        yield _one_for_each_joint("start_joints", robot.start_joints_rad, robot)
    for index, joint in enumerate(robot.joints):
        lower, upper = joint.limits_rad
        if lower >= upper:
            yield (
                ("robot", "joints", index, "limits"),
                "the lower limit is not below the upper",
                "swap them, or correct one",
            )
        elif index < len(robot.start_joints_rad) and not lower <= robot.start_joints_rad[index] <= upper:
            yield (
                ("robot", "start_joints", index),
                f"outside the limits of joint {index + 1}",
                f"write {format_angle(lower)} to {format_angle(upper)}",
            )


def _one_for_each_joint(key: str, values: Sequence[object], robot: Arm) -> Finding:
    count = len(robot.joints)
    return ("robot", key), f"{len(values)} values for {count} joints", f"write {count}"


def encoder(robot: Arm) -> Iterator[Finding]:
    """The smallest step of a reading, against a turn and against the window that is judged with it."""
    counts = FULL_TURN_RAD / robot.encoder_step_rad
    if abs(counts - round(counts)) > 1e-3:
        nearest = format_angle(FULL_TURN_RAD / round(counts))
        yield (
            ("robot", "encoder_step"),
            f"{counts:.6g} counts in a turn, which is not a whole number",
            f'write for example "{nearest}"',
        )
    if robot.in_position_rad < robot.encoder_step_rad:
        yield (
            ("robot", "in_position"),
            f"smaller than one encoder step ({format_angle(robot.encoder_step_rad)})",
            "write at least that",
        )


def drives(robot: Arm) -> Iterator[Finding]:
    """The CiA 402 drives of an arm: nodes, counts, and SYNC against the time to settle."""
    if not isinstance(robot, CanopenRobot):
        return
    if len(robot.nodes) != len(robot.joints):
        yield _one_for_each_joint("nodes", robot.nodes, robot)
    for position, node in enumerate(robot.nodes):
        if node in robot.nodes[:position]:
            first = robot.nodes.index(node) + 1
            yield (
                ("robot", "nodes", position),
                f"joint {first} has this node too",
                "give each drive its own node",
            )
    for index, joint in enumerate(robot.joints):
        counts = max(abs(limit) for limit in joint.limits_rad) / robot.encoder_step_rad
        if counts >= DRIVE_COUNTS:
            yield (
                ("robot", "joints", index, "limits"),
                f"{counts:.3g} encoder steps",
                f"a drive counts to {DRIVE_COUNTS - 1}; check encoder_step",
            )
    if robot.settle_time_s < robot.sync_period_s:
        yield (
            ("robot", "settle_time"),
            f"shorter than the SYNC period ({format_duration(robot.sync_period_s)})",
            "write at least that, so that standstill is seen",
        )


def can_bus(robot: Arm) -> Iterator[Finding]:
    """Whether dongle and bus can carry a joint reading of all drives at each SYNC."""
    if not isinstance(robot, CanopenRobot):
        return
    answers = 1 + len(robot.joints)
    if robot.interface == "slcan":
        frames_per_s = answers * SLCAN_MARGIN / robot.sync_period_s
        if frames_per_s > SLCAN_FRAMES_PER_S * (1 + ROUNDING):
            yield (
                ("robot", "sync_period"),
                f"{frames_per_s:.0f} frames/s, an slcan dongle passes {SLCAN_FRAMES_PER_S}",
                f"write at least {format_duration(answers * SLCAN_MARGIN / SLCAN_FRAMES_PER_S)}",
            )
    bits = (1 + 2 * len(robot.joints)) * CAN_FRAME_BITS  # SYNC, and to and from each drive
    shortest_s = bits / (CAN_LOAD * robot.bitrate)
    if robot.sync_period_s < shortest_s:
        yield (
            ("robot", "bitrate"),
            f"too slow for {answers - 1} drives at a SYNC period of {format_duration(robot.sync_period_s)}",
            f"set sync_period to {format_duration(shortest_s, 1)} or more, or use a faster bus",
        )


def interface(robot: Arm) -> Iterator[Finding]:
    """The port fits the kind of interface."""
    if isinstance(robot, CanopenRobot) and robot.interface == "socketcan" and "/" in robot.port:
        yield ("robot", "port"), "a path, but the interface is socketcan", 'write its name, such as "can0"'


def ports(robot: Arm, laser: Laser, probe: Probe, source: Source) -> Iterator[Finding]:
    """One device on each port. A bus of SocketCAN can be shared, and a pattern finds each its own."""
    taken = dict[object, str]()
    for name, device in (("robot", robot), ("laser", laser), ("probe", probe)):
        port = getattr(device, "port", None)
        shared = getattr(device, "interface", "") == "socketcan"
        if port is None or shared or (isinstance(port, str) and any(sign in port for sign in "*?[")):
            continue
        address = Path(port) if isinstance(port, str) else (getattr(device, "host", ""), port)
        if address in taken:
            line = source.index.line_of((taken[address], "port"))
            yield (
                (name, "port"),
                f"the {taken[address]} is on this port (line {line})",
                "give each device its own port",
            )
        taken.setdefault(address, name)


def laser_ranges(laser: Laser) -> Iterator[Finding]:
    """The working range lies within the measuring range."""
    start_m, end_m = laser.range_start_m, laser.range_start_m + laser.range_m
    shortest_m, longest_m = laser.working_range_m
    path = ("laser", "working_range")
    if shortest_m >= longest_m:
        yield path, "the shortest distance is not below the longest", "swap them, or correct one"
    elif shortest_m < start_m * (1 - ROUNDING) or longest_m > end_m * (1 + ROUNDING):
        yield (
            path,
            "outside the measuring range",
            f"which is {format_length(start_m)} to {format_length(end_m)} (range_start, range)",
        )


def laser_line(laser: Laser) -> Iterator[Finding]:
    """The line of a laser that streams carries all bytes of each measuring cycle."""
    if isinstance(laser, OptoncdtLaser):
        bits = OPTONCDT_BITS
    elif isinstance(laser, RiftekLaser) and laser.driver == "riftek-binary":
        bits = RIFTEK_BITS
    else:
        return
    bits_per_s = laser.rate_hz * bits
    if bits_per_s > laser.baud:
        yield (
            ("laser", "rate"),
            f"{bits_per_s:.0f} bit/s on a line of {laser.baud} baud",
            f"write at most {format_frequency(laser.baud / bits)}, or raise the baud rate",
        )


def touch_speed(probe: Probe) -> Iterator[Finding]:
    """How far the ball travels unseen between two polls, and that the second touch is the slow one."""
    travel_m = probe.touch_speed_m_s * probe.poll_period_s
    if travel_m > TOUCH_TRAVEL_M * (1 + ROUNDING):
        yield (
            ("probe", "touch_speed"),
            f"{format_length(travel_m)} of travel between two polls, limit {format_length(TOUCH_TRAVEL_M)}",
            "touch more slowly, or poll faster",
        )
    if probe.search_speed_m_s < probe.touch_speed_m_s:
        yield ("probe", "search_speed"), "slower than touch_speed", "search faster than you touch"


def parents(
    laser: Laser, probe: Probe, plate: Plate, bar: Bar, sphere: Sphere, part: Part
) -> Iterator[Finding]:
    """The frames form a tree: what the arm carries hangs on the flange, what stands on the base."""
    placements: dict[str, tuple[KeyPath, Placement]] = {
        placement.FRAME: (path, placement)
        for path, placement in (
            (("laser", "mount"), laser.mount),
            (("probe", "mount"), probe.mount),
            (("plate",), plate),
            (("bar",), bar),
            (("sphere",), sphere),
            (("part",), part),
        )
    }
    for frame, (path, placement) in placements.items():
        chain = [frame]
        while chain[-1] in placements and chain.count(chain[-1]) == 1:
            chain.append(placements[chain[-1]][1].parent)
        place = (*path, "parent")
        if placement.parent not in FRAMES:
            yield place, "no such frame", nearest(placement.parent, FRAMES)
        elif chain.count(chain[-1]) > 1 and chain[-1] == frame:
            yield place, f"a loop of frames ({' in '.join(chain)})", f'write "{placement.PARENT}"'
        elif placement.parent != placement.PARENT:
            kind = "is carried by the arm" if placement.PARENT == "flange" else "stands in the cell"
            yield place, f"the {frame} {kind}", f'write "{placement.PARENT}"'


def certificates(plate: Plate, bar: Bar, sphere: Sphere) -> Iterator[Finding]:
    """A certificate ends after it began."""
    artefacts: tuple[Artefact, ...] = (plate, bar, sphere)
    for artefact in artefacts:
        if artefact.certified and artefact.valid_to and artefact.valid_to <= artefact.certified:
            yield (
                (artefact.FRAME, "valid_to"),
                f"not after the day of calibration ({artefact.certified})",
                "correct one of them",
            )


def artefact_sizes(plate: Plate, bar: Bar) -> Iterator[Finding]:
    """Artefacts that can exist."""
    if bar.length_m <= 2 * bar.sphere_radius_m:
        yield (
            ("bar", "length"),
            "the spheres overlap",
            f"it is the distance of the centres, more than {format_length(2 * bar.sphere_radius_m)}",
        )
    if 2 * plate.margin_m >= min(plate.size_m):
        yield (
            ("plate", "margin"),
            f"nothing is left of {format_length(min(plate.size_m))}",
            f"write less than {format_length(min(plate.size_m) / 2)}",
        )


CHECKS: Final[tuple[Check, ...]] = (
    patience,
    joints,
    encoder,
    drives,
    can_bus,
    interface,
    ports,
    laser_ranges,
    laser_line,
    touch_speed,
    parents,
    certificates,
    artefact_sizes,
)
