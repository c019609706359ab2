"""One simulated device on a port of its own, for people who write their own software against it."""

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from estimation.errors import CellFileError
from simulators import faults, signals
from simulators.device_kind import DeviceKind, Setting
from simulators.faults import Fault, parse_fault
from simulators.interfaces import ByteDevice
from simulators.outlets import Loop, SerialOutlet, TcpOutlet
from simulators.registry import DEVICES
from simulators.slcan import SlcanDevice

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
    """One device behind its outlets, in real time, with its faults. Raises CellFileError, OSError.

    `ports` are a path for a serial line or slcan dongle; for TCP a number per socket ("": the main one).
    """

    def __init__(
        self,
        kind: DeviceKind,
        settings: Mapping[str, Setting],
        ports: Mapping[str, str],
        schedule: Iterable[Fault] = (),
        seed: int = 0,
        host: str = "127.0.0.1",
    ) -> None:
        self._kind, self._settings, self._seed = kind, {**kind.settings, **settings}, seed
        self.device = kind.make(self._settings, seed)
        self.loop = Loop(self._update)
        self.where = dict[str, str]()  # socket -> path or host:port
        self._outlets = list[SerialOutlet | TcpOutlet]()
        self._events = list[_Event]()
        if kind.link == "tcp":
            self._listen(host, ports)
        else:
            self._open_line(ports)
        for number, outlet in enumerate(self._outlets):
            outlet.faults.reseed(seed + number)
        for fault in schedule:
            self._schedule(fault)

    def _open_line(self, ports: Mapping[str, str]) -> None:
        path = Path(ports.get("", self._kind.name))
        if path.exists() and not path.is_symlink():
            raise CellFileError(
                f"{path} is there already", "Name a path for the port that does not exist yet"
            )
        outlet = SerialOutlet(self.loop, path, lambda: self._find(""), self._baud())
        self.where[""] = str(path)
        self._outlets.append(outlet)

    def _listen(self, host: str, ports: Mapping[str, str]) -> None:
        names = tuple(self._kind.sockets)
        given = {(names[0] if name == "" else name): number for name, number in ports.items()}
        for name in given:
            if name not in names:
                raise CellFileError(f"{self._kind.name} has no socket {name!r}", f"It has {', '.join(names)}")
        for name, default in self._kind.sockets.items():
            text = given.get(name, str(default))
            if not text.isdigit() or int(text) > 65535:
                raise CellFileError(f"{text!r} is no TCP port", "Give a number, 0 for any free one")
            try:
                outlet = TcpOutlet(self.loop, host, int(text), lambda name=name: self._find(name))  # type: ignore[misc]
            except PermissionError as error:
                raise CellFileError(
                    f"Port {text} is reserved for the system",
                    f"Choose one above 1023: --port {name}=5{text:0>3}",
                ) from error
            except OSError as error:
                raise CellFileError(f"Port {text}: {error.strerror}", "Choose a free port, or 0") from error
            self.where[name] = f"{host}:{outlet.port.port}"
            self._outlets.append(outlet)

    def _find(self, socket: str) -> ByteDevice:
        """What a client finds at a socket now."""
        device = self.device
        return SlcanDevice(device.can) if device.can is not None else device.connect[socket]()

    def _baud(self) -> Callable[[], int] | None:
        return None if self.device.baud is None else lambda: self.device.baud() if self.device.baud else 0

    def _update(self, time_s: float) -> None:
        self.device.update(time_s)
        while self._events and self._events[0].at_s <= time_s:
            self._events.pop(0).act()

    # -- faults ----------------------------------------------------------------------------------

    def _schedule(self, fault: Fault) -> None:
        if fault.kind in faults.KINDS:
            for outlet in self._outlets:
                outlet.faults.schedule(fault)
        elif fault.kind in signals.KINDS:
            if self.device.signal is None:
                raise CellFileError(f"{self._kind.name} measures no signal: no {fault.kind}", "Leave it out")
            # A signal is continuous: without an end, the fault lasts.
            self.device.signal.schedule(replace(fault, once=False))
        elif fault.kind in EVENTS:
            self._schedule_event(fault)
        else:
            raise CellFileError(f"No fault {fault.kind!r}", f"Choose one of {', '.join(ALL_FAULTS)}")

    def _schedule_event(self, fault: Fault) -> None:
        if math.isinf(fault.from_s):
            raise CellFileError(f"When is {fault.kind} to happen?", f"Add a time: {fault.kind}@5s")
        acts = {"restart": self._restart, "unplug": self._unplug, "swap": self._swap}
        self._events.append(_Event(fault.from_s, acts[fault.kind]))
        if fault.kind == "unplug" and math.isfinite(fault.until_s):
            self._events.append(_Event(fault.until_s, self._plug))
        self._events.sort(key=lambda event: event.at_s)

    def _restart(self) -> None:
        if self.device.restart is not None:
            self.device.restart(self.loop.now_s)
        self._hang_up()

    def _hang_up(self) -> None:
        for outlet in self._outlets:
            if isinstance(outlet, TcpOutlet):
                outlet.hang_up()

    def _unplug(self) -> None:
        for outlet in self._outlets:
            outlet.unplug()

    def _plug(self) -> None:
        for outlet in self._outlets:
            outlet.plug()

    def _swap(self) -> None:
        self._unplug()
        self.device = self._kind.make({**self._settings, **self._kind.other}, self._seed)
        self._plug()


ALL_FAULTS: Final = {**faults.KINDS, **signals.KINDS, **EVENTS}


def read_settings(kind: DeviceKind, assignments: Iterable[str]) -> dict[str, Setting]:
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
        except (OSError, tomllib.TOMLDecodeError) as error:
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
            sockets = ", ".join(f"{name} {port}" for name, port in kind.sockets.items())
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
