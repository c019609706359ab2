"""One simulated device on a port of its own, for people who write their own software against it."""

import math
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from estimation.errors import CellFileError
from simulators import faults, signals
from simulators.control import STATION_COMMANDS, ControlSocket, happen
from simulators.device_kind import DeviceKind, Setting, Settings
from simulators.faults import Fault, parse_fault
from simulators.outlets import Loop
from simulators.registry import DEVICES
from simulators.robots.mechanism import MechanicalArm
from simulators.station import Endpoint, Station

EVENTS: Final = {
    "restart": "the device loses its power for a moment, at START",
    "unplug": "the port vanishes at START, and is back at END",
    "swap": "at START, another device of the same kind takes its place",
}


@dataclass(frozen=True, slots=True)
class _Event:
    at_s: float
    act: Callable[[], None]


class DeviceServer:
    """One device in real time, with its faults. `control` is a path for a socket by which more can happen.

    Raises CellFileError.
    """

    def __init__(
        self,
        kind: DeviceKind[Any],
        settings: Settings,
        endpoint: Endpoint,
        schedule: Iterable[Fault] = (),
        seed: int = 0,
        control: Path | None = None,
    ) -> None:
        self._kind, self._settings, self._seed = kind, dict(settings), seed
        self.loop = Loop(self._update)
        self.station = Station(self.loop, kind, kind.simulated(seed, **settings), endpoint)
        self._events = list[_Event]()
        for number, outlet in enumerate(self.station.outlets.values()):
            outlet.faults.reseed(seed + number)
        for fault in schedule:
            self._schedule(fault)
        self._control = None if control is None else ControlSocket(self.loop, control, self._do)

    def run(self) -> None:
        """Serve until the loop quits."""
        try:
            self.loop.run()
        finally:
            if self._control is not None:
                self._control.close()

    def _update(self, time_s: float) -> None:
        self.station.device.update(time_s)
        while self._events and self._events[0].at_s <= time_s:
            self._events.pop(0).act()

    def _schedule(self, fault: Fault) -> None:
        if fault.kind in EVENTS:
            self._schedule_event(fault)
        elif fault.kind in ALL_FAULTS:
            self.station.schedule(fault)
        else:
            raise CellFileError(f"No fault {fault.kind!r}", f"Choose one of {', '.join(ALL_FAULTS)}")

    def _schedule_event(self, fault: Fault) -> None:
        if math.isinf(fault.from_s):
            raise CellFileError(f"When is {fault.kind} to happen?", f"Add a time: {fault.kind}@5s")
        station = self.station
        acts = {"restart": station.restart, "unplug": station.unplug, "swap": self._swap}
        self._events.append(_Event(fault.from_s, acts[fault.kind]))
        if fault.kind == "unplug" and math.isfinite(fault.until_s):
            self._events.append(_Event(fault.until_s, station.plug))
        self._events.sort(key=lambda event: event.at_s)

    def _swap(self) -> None:
        settings = {**self._settings, **self._kind.other}
        self.station.swap(self._kind.simulated(self._seed, **settings))

    def _do(self, request: dict[str, Any]) -> dict[str, Any]:
        match request["do"]:
            case "swap":
                self._swap()
            case "fault":
                self._schedule(parse_fault(str(request["fault"])))
            case "quit":
                self.loop.quit()
            case what if what in STATION_COMMANDS:
                happen({self._kind.name: self.station}, {"device": self._kind.name, **request})
            case what if what != "status":
                raise ValueError(f"{what!r} is not known")
        model, now_s = self.station.device.model, self.loop.now_s
        joints = model.joints_at(now_s).tolist() if isinstance(model, MechanicalArm) else None
        return {
            "time_s": now_s,
            "stalled_s": self.loop.stalled_s,
            "plugged": self.station.plugged,
            "where": self.station.where,
            "joints_rad": joints,
        }


ALL_FAULTS: Final = {**faults.KINDS, **signals.KINDS, **EVENTS}


def read_settings(kind: DeviceKind[Any], assignments: Iterable[str]) -> dict[str, Setting]:
    """Settings from KEY=VALUE texts. Raises CellFileError."""
    settings = dict[str, Setting]()
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals or key not in kind.settings:
            raise CellFileError(
                f"{kind.name} has no setting {text!r}",
                f"Write KEY=VALUE with one of {', '.join(kind.settings) or 'none'}",
            )
        try:
            settings[key] = type(kind.settings[key])(value)
        except ValueError as error:
            raise CellFileError(f"{key} of {kind.name} cannot be {value!r}", "Give a number") from error
    return settings


def read_ports(texts: Iterable[str]) -> dict[str, str]:
    """PORT or SOCKET=PORT; a path holds no "="."""
    named = (text.rpartition("=") for text in texts)
    return {name: port for name, _, port in named}


def read_schedule(texts: Iterable[str], file: Path | None) -> list[Fault]:
    """Faults from texts, and from the list `faults` of a TOML file. Raises CellFileError."""
    entries = list(texts)
    if file is not None:
        try:
            content = tomllib.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:  # ValueError: not TOML, or not even UTF-8
            raise CellFileError(f"{file}: {error}", 'Write faults = ["late:0.3@5s", ...]') from error
        listed = content.get("faults")
        if not isinstance(listed, list) or len(content) != 1:
            raise CellFileError(f"{file} is no list of faults", 'Write faults = ["late:0.3@5s", ...]')
        entries += [str(entry) for entry in listed]
    return [parse_fault(entry) for entry in entries]


def list_devices() -> str:
    """All devices with their sockets and settings, and all faults, for people."""
    lines = ["Devices:"]
    for kind in DEVICES.values():
        lines.append(f"  {kind.name:16} {kind.what}")
        if kind.link == "tcp":
            sockets = ", ".join(f"{name} {port}".strip() for name, port in kind.sockets.items())
            lines.append(f"  {'':16} TCP: {sockets}")
        settings = " ".join(f"{key}={value}" for key, value in kind.settings.items())
        lines.append(f"  {'':16} --set {settings}")
    lines += ["", "Faults, as --fault KIND[:VALUE][@START[-END]][%PERCENT]; a message that is struck"]
    lines += [f"  {name:16} {what}" for name, what in faults.KINDS.items()]
    lines += ["what is measured"]
    lines += [f"  {name:16} {what}" for name, what in signals.KINDS.items()]
    lines += ["and at a time"]
    lines += [f"  {name:16} {what}" for name, what in EVENTS.items()]
    lines += ["", "Examples: late:0.3@5s one message; corrupt%2 two in a hundred; stuck@10s-20s; swap@30s"]
    return "\n".join(lines)
