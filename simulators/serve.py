"""The simulated cell in real time: its devices on ports that another process opens, in one loop."""

import contextlib
import json
import math
import os
import selectors
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from simulators.cell import CellModel
from simulators.ports import PtyPort, TcpPort, garbled
from simulators.probes.adam6052 import ModbusConnection
from simulators.slcan import SlcanDongle, encode_frame

LONGEST_WAIT_S: Final = 0.02
LONGEST_STEP_S: Final = 0.03  # what passes beyond it, the machine was busy with something else
DEVICES: Final = ("arm", "laser", "probe")


class ForgivingClock:
    """Real time less the time in which this process could not run.

    Without it, a busy machine looks to the simulated drives like a silent master.
    """

    def __init__(self) -> None:
        self._last_s = time.monotonic()
        self._now_s = 0.0
        self.stalled_s = 0.0

    def tick(self, at_most_s: float) -> float:
        """The present, at most so much later than at the last tick."""
        real_s = time.monotonic()
        passed_s, self._last_s = real_s - self._last_s, real_s
        granted_s = min(passed_s, at_most_s)
        self.stalled_s += passed_s - granted_s
        self._now_s += granted_s
        return self._now_s


class CellServer:
    """Devices of a `CellModel` on `run_dir`/arm, `run_dir`/laser and a TCP port; control by a unix socket.

    The socket takes one JSON object per line, such as {"do": "unplug", "device": "laser"}, and answers one.
    """

    def __init__(self, model: CellModel, run_dir: Path, probe_port: int | None = None) -> None:
        wires = model.file.wires
        self._model, self._run_dir = model, run_dir
        self._clock = ForgivingClock()
        self._now_s = 0.0
        self._running = True
        run_dir.mkdir(parents=True, exist_ok=True)
        self._arm_port = PtyPort(run_dir / wires.arm)
        self._laser_port = PtyPort(run_dir / wires.laser)
        self._probe_port = TcpPort(wires.probe_host, wires.probe_port if probe_port is None else probe_port)
        self._ports: dict[str, PtyPort | TcpPort] = dict(
            zip(DEVICES, (self._arm_port, self._laser_port, self._probe_port), strict=True)
        )
        self._silent_until_s = dict.fromkeys(DEVICES, -math.inf)
        self._dongle = SlcanDongle()
        self._clients: dict[socket.socket, ModbusConnection] = {}
        self._selector = selectors.SelectSelector()  # to the microsecond; epoll waits whole milliseconds
        self._control_path = run_dir / "simulator.sock"
        self._control_path.unlink(missing_ok=True)
        self._control = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._control.bind(_short(self._control_path))
        self._control.listen()
        self._control.setblocking(False)
        self._watch(self._control, self._accept_control)
        self._watch_ports()

    # -- loop ------------------------------------------------------------------------------------

    def describe(self) -> dict[str, Any]:
        """Who we are and where the devices are; also written to simulator.json."""
        return {
            "pid": os.getpid(),
            "seed": self._model.truth.seed,
            "scenario": self._model.scenario.name,
            "arm": str(self._arm_port.path),
            "laser": str(self._laser_port.path),
            "probe": [self._probe_port.host, self._probe_port.port],
            "control": str(self._control_path),
        }

    def run(self) -> None:
        """Serve until `quit`, SIGTERM or SIGINT."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._quit())
        _write_json(self._run_dir / "truth.json", self._model.truth_json())
        _write_json(self._run_dir / "simulator.json", self.describe())
        print("ready", flush=True)
        try:
            while self._running:
                self._step()
        finally:
            self._close()

    def _step(self) -> None:
        due_s = min(
            self._model.arm.next_output_s(),
            self._model.laser.next_output_s() if self._laser_port.plugged else math.inf,
            *[connection.next_output_s() for connection in self._clients.values()],
        )
        wait_s = min(max(due_s - self._now_s, 0.0), LONGEST_WAIT_S)
        events = self._selector.select(wait_s)
        self._now_s = self._clock.tick(LONGEST_STEP_S)
        for key, _ in events:
            key.data()
        # Followed as it goes: a probe that is asked after a minute of motion must answer at once.
        self._model.contact.update(self._now_s)
        self._serve_arm_output()
        self._serve_laser_output()
        self._serve_probe_output()

    def _quit(self) -> None:
        self._running = False

    def _close(self) -> None:
        for port in self._ports.values():
            port.unplug()
        for client in self._clients:
            client.close()
        self._control.close()
        for name in ("simulator.sock", "simulator.json"):
            (self._run_dir / name).unlink(missing_ok=True)

    def _watch(self, thing: Any, action: Callable[[], None]) -> None:
        self._selector.register(thing, selectors.EVENT_READ, action)

    def _watch_ports(self) -> None:
        actions = (self._arm_input, self._laser_input, self._accept_probe)
        for port, action in zip(self._ports.values(), actions, strict=True):
            if port.plugged and port.fileno() not in self._selector.get_map():
                self._watch(port, action)

    def _silent(self, device: str) -> bool:
        return self._now_s < self._silent_until_s[device]

    # -- arm -------------------------------------------------------------------------------------

    def _arm_input(self) -> None:
        answers = self._dongle.receive(self._arm_port.read())
        for can_id, data in self._dongle.sent:
            self._model.arm.receive(can_id, data, self._now_s)
        self._dongle.sent.clear()
        if answers:
            self._arm_port.write(answers)

    def _serve_arm_output(self) -> None:
        lines = []
        while (frame := self._model.arm.take(self._now_s)) is not None:
            lines.append(encode_frame(frame))
        if lines and self._dongle.open and self._arm_port.plugged and not self._silent("arm"):
            self._arm_port.write(b"".join(lines))

    # -- laser -----------------------------------------------------------------------------------

    def _wrong_baud(self) -> bool:
        return self._laser_port.client_baud() != self._model.laser.baud

    def _laser_input(self) -> None:
        data = self._laser_port.read()
        if data:
            data = garbled(data) if self._wrong_baud() else data
            self._model.laser.receive(data, self._now_s)

    def _serve_laser_output(self) -> None:
        laser = self._model.laser
        if laser.next_output_s() > self._now_s:
            return
        if not self._laser_port.plugged or self._silent("laser"):
            laser.discard(self._now_s)
            return
        data = laser.take(self._now_s)
        if data:
            self._laser_port.write(garbled(data) if self._wrong_baud() else data)

    # -- probe -----------------------------------------------------------------------------------

    def _accept_probe(self) -> None:
        client = self._probe_port.accept()
        if client is not None:
            self._clients[client] = ModbusConnection(self._model.probe)
            self._watch(client, lambda: self._probe_input(client))

    def _probe_input(self, client: socket.socket) -> None:
        try:
            data = client.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._clients[client].receive(data, self._now_s)
        else:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._selector.unregister(client)
        del self._clients[client]
        client.close()

    def _serve_probe_output(self) -> None:
        for client, connection in list(self._clients.items()):
            data = connection.take(self._now_s)
            if data and not self._silent("probe"):
                try:
                    client.sendall(data)
                except OSError:
                    self._drop(client)

    # -- control ---------------------------------------------------------------------------------

    def _accept_control(self) -> None:
        connection, _ = self._control.accept()
        connection.settimeout(1.0)
        stream = connection.makefile("rwb")

        def answer() -> None:
            line = b""
            with contextlib.suppress(OSError):
                line = stream.readline()
            if not line:
                self._selector.unregister(connection)
                stream.close()
                connection.close()
                return
            with contextlib.suppress(OSError):
                stream.write(json.dumps(self._control_line(line)).encode() + b"\n")
                stream.flush()

        self._watch(connection, answer)

    def _control_line(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            return {"ok": True, **self._do(request)}
        except (ValueError, KeyError, TypeError, OSError) as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}

    def _do(self, request: dict[str, Any]) -> dict[str, Any]:
        what, model = request["do"], self._model
        if what in ("unplug", "plug", "silence"):
            device = request["device"]
            if device not in DEVICES:
                raise ValueError(f"{device!r} is not one of {', '.join(DEVICES)}")
            if what == "silence":
                self._silent_until_s[device] = self._now_s + float(request["seconds"])
            elif what == "unplug":
                self._unplug(device)
            else:
                self._ports[device].plug()
                self._watch_ports()
        elif what == "bump":
            if "translation_m" in request or "rotation_rad" in request:
                model.world.bump_laser(
                    np.array(request.get("translation_m", [0, 0, 0]), dtype=float),
                    np.array(request.get("rotation_rad", [0, 0, 0]), dtype=float),
                )
            else:
                model.bump()
        elif what == "part":
            model.world.part_present = bool(request["present"])
        elif what == "permit":
            model.arm.permit(bool(request["permitted"]), self._now_s)
        elif what == "fault":
            model.arm.fault(int(request["joint"]) - 1, int(request.get("code", 0x8611)), self._now_s)
        elif what == "restart_laser":
            model.laser.restart(self._now_s)
        elif what == "quit":
            self._quit()
        elif what != "status":
            raise ValueError(f"{what!r} is not known")
        return self._status()

    def _unplug(self, device: str) -> None:
        port = self._ports[device]
        if not port.plugged:
            return
        self._selector.unregister(port)
        port.unplug()
        if device == "arm":
            self._dongle = SlcanDongle()
        elif device == "probe":
            for client in list(self._clients):
                self._drop(client)

    def _status(self) -> dict[str, Any]:
        model, now = self._model, self._now_s
        model.contact.update(now)
        return {
            "time_s": now,
            "stalled_s": self._clock.stalled_s,
            "joints_rad": model.arm.joints_at(now).tolist(),
            "moving": model.arm.standstill(now) is None,
            "touches": model.contact.count,
            "deepest_touch_m": model.contact.deepest_m,
            "part_present": model.world.part_present,
            "plugged": {name: port.plugged for name, port in self._ports.items()},
        }


def _short(path: Path) -> str:
    """A unix socket's path has room for about 100 characters only."""
    relative = os.path.relpath(path)
    return relative if len(relative) < len(str(path)) else str(path)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=2), encoding="utf-8")
    partial.replace(path)
