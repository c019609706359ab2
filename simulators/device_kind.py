"""What the table of simulated devices says of each: how to make it, how it is wired, what it can be told."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from simulators.interfaces import ByteDevice, CanDevice
from simulators.signals import Signal

Setting = str | int | float
Settings = Mapping[str, Setting]
Surroundings = TypeVar("Surroundings")


@dataclass(frozen=True, slots=True)
class Simulated:
    """One device, ready for a wire."""

    model: Any  # the device itself, for tests and for those who know it
    connect: Mapping[str, Callable[[], ByteDevice]] = field(default_factory=dict)
    """What a client finds at each socket, "" being the main one: of TCP, a new connection."""
    can: CanDevice | None = None  # instead of `connect`, on a CAN bus
    signal: Signal | None = None  # what it measures, where it runs alone
    baud: Callable[[], int] | None = None  # line speed now, where a wrong one matters
    restart: Callable[[float], None] | None = None  # power off and on at that time
    update: Callable[[float], None] = lambda time_s: None  # lets everything happen that is due by then


@dataclass(frozen=True, slots=True)
class DeviceKind(Generic[Surroundings]):
    """One line of the table. A cell gives the device its surroundings; `alone` invents some."""

    name: str  # as in `truecell simulate --device NAME`, and `driver` in the cell file
    what: str  # in a few words
    link: Literal["serial", "can", "tcp"]
    make: Callable[[Settings, Surroundings], Simulated]
    alone: Callable[[Settings, np.random.Generator], tuple[Surroundings, Signal | None]]
    settings: Settings = field(default_factory=dict)  # defaults, for `--set KEY=VALUE`
    other: Settings = field(default_factory=dict)  # how another device of this kind differs
    sockets: Mapping[str, int] = field(default_factory=lambda: {"": 0})  # TCP, with the usual ports

    def simulated(self, seed: int = 0, **changed: Setting) -> Simulated:
        """One device alone, with these settings changed."""
        settings = {**self.settings, **changed}
        surroundings, signal = self.alone(settings, np.random.default_rng(seed))
        return replace(self.make(settings, surroundings), signal=signal)


def on_serial_line(model: Any, baud: Callable[[], int]) -> Simulated:
    """The same device for every client."""
    return Simulated(model, {"": lambda: model}, baud=baud, restart=model.restart)


def on_can_bus(model: Any) -> Simulated:
    """The only device on its bus."""
    return Simulated(model, can=model, restart=model.restart)
