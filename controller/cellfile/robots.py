"""The tables of the robots: one for each driver, told apart by `driver`."""

from typing import Annotated, Literal

from pydantic import Field

from controller.cellfile.arm import Arm
from controller.cellfile.tables import Text
from controller.quantities import Duration


class CanopenRobot(Arm):
    """An arm whose joints are CiA 402 drives on one CAN bus."""

    driver: Literal["canopen-402"]
    """Which driver speaks to it."""
    port: Text
    """Device such as `/dev/ttyACM0`, a path relative to this file, or the interface of `socketcan`."""
    interface: Literal["slcan", "socketcan"]
    """Kind of CAN interface."""
    bitrate: Literal[50_000, 125_000, 250_000, 500_000, 1_000_000]
    """Bit/s on the bus."""
    nodes: tuple[Annotated[int, Field(ge=1, le=127)], ...]
    """CANopen node of each joint, from the base outwards."""
    sync_period_s: Duration = Field(ge=0.001, le=1)
    """Time between two SYNC messages; one joint reading each."""
    cruise_sync_period_s: Duration = Field(0.05, ge=0.001, le=0.06)
    """The same far from the end of a free move, where less must be seen; at least `sync_period`."""


Robot = CanopenRobot
