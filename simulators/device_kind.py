"""What a table of simulated devices says of each: how to make it, how it is wired, what it can be told."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from simulators.interfaces import ByteDevice, CanDevice
from simulators.signals import Signal

Setting = str | int | float


@dataclass(frozen=True, slots=True)
class Simulated:
    """One device that runs alone, ready for a wire."""

    model: Any  # the device itself, for tests and for those who know it
    connect: Mapping[str, Callable[[], ByteDevice]] = field(default_factory=dict)
    """What a client finds at each socket: a serial device is always the same, TCP makes connections."""
    can: CanDevice | None = None  # instead of `connect`, on a CAN bus
    signal: Signal | None = None  # what it measures
    baud: Callable[[], int] | None = None  # line speed now, where a wrong one matters
    restart: Callable[[float], None] | None = None  # power off and on at that time
    update: Callable[[float], None] = lambda time_s: None  # lets everything happen that is due by then


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """One line of the table."""

    name: str  # as in `truecell simulate --device NAME`
    what: str  # in a few words
    link: Literal["serial", "can", "tcp"]
    make: Callable[[Mapping[str, Setting], int], Simulated]  # from settings and a seed
    settings: Mapping[str, Setting] = field(default_factory=dict)  # defaults, for `--set KEY=VALUE`
    other: Mapping[str, Setting] = field(default_factory=dict)  # how another device of this kind differs
    sockets: Mapping[str, int] = field(default_factory=lambda: {"": 0})  # TCP, main one first

    def simulated(self, seed: int = 0, **changed: Setting) -> Simulated:
        """One device with these settings changed."""
        return self.make({**self.settings, **changed}, seed)
