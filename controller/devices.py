"""The drivers of a cell, from its file and from where links come: real ports or the deterministic cell."""

from controller.cellfile import Cell
from controller.robots import make_robot
from controller.sensors import make_laser, make_probe
from drivers.capabilities import Devices
from drivers.clock import Clock
from drivers.links.interfaces import Ports


def make_devices(cell: Cell, ports: Ports, clock: Clock, *, keep_alive_thread: bool) -> Devices:
    """Drivers that are not connected yet."""
    patience = cell.cell.patience
    return Devices(
        make_robot(cell.robot, ports, clock, patience=patience, keep_alive_thread=keep_alive_thread),
        make_laser(cell.laser, ports, clock, patience),
        make_probe(cell.probe, ports, clock, patience),
        ports.searches,
        ports.statistics,
    )
