"""A simulated device and how it is wired."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from simulators.interfaces import ByteDevice, CanDevice


@dataclass(frozen=True, slots=True)
class Wired:
    """Either a byte stream, which each client finds by `connect`, or a CAN bus."""

    model: Any  # the device itself, for whoever knows its kind
    connect: Callable[[], ByteDevice] | None = None
    can: CanDevice | None = None


def on_serial_line(model: ByteDevice) -> Wired:
    """The same device for every client."""
    return Wired(model, connect=lambda: model)


def on_can_bus(model: CanDevice) -> Wired:
    """The only device on its bus."""
    return Wired(model, can=model)
