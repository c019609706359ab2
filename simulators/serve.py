"""The simulated cell in real time: its devices on ports that another process opens, in one loop."""

import contextlib
import json
import os
import signal
import socket
from pathlib import Path
from typing import Any, Final

import numpy as np

from estimation.errors import CellFileError
from simulators.cell import CellModel
from simulators.modbus_server import ModbusConnection
from simulators.outlets import Loop, SerialOutlet, TcpOutlet
from simulators.robots.canopen_arm import SimulatedArm
from simulators.slcan import SlcanDevice

DEVICES: Final = ("arm", "laser", "probe")


class CellServer:
    """Devices of a `CellModel` on `run_dir`/arm, `run_dir`/laser and a TCP port; control by a unix socket.

    The socket takes one JSON object per line, such as {"do": "unplug", "device": "laser"}, and answers one.
    """

    def __init__(self, model: CellModel, run_dir: Path, probe_port: int | None = None) -> None:
        wires = model.file.wires
        self._model, self._run_dir = model, run_dir
        self._loop = loop = Loop(model.contact.update)
        run_dir.mkdir(parents=True, exist_ok=True)
        bus = model.arm
        if not isinstance(bus, SimulatedArm):
            raise CellFileError(
                "Only the CANopen arm has a port here", "Simulate the robot alone: --device NAME"
            )
        arm = SerialOutlet(loop, run_dir / wires.arm, lambda: SlcanDevice(bus))
        laser = SerialOutlet(loop, run_dir / wires.laser, lambda: model.laser, lambda: model.laser.baud)
        port = wires.probe_port if probe_port is None else probe_port
        probe = TcpOutlet(loop, wires.probe_host, port, lambda: ModbusConnection(model.probe))
        self._outlets: dict[str, SerialOutlet | TcpOutlet] = {"arm": arm, "laser": laser, "probe": probe}
        self._where = {
            "arm": str(arm.port.path),
            "laser": str(laser.port.path),
            "probe": [probe.port.host, probe.port.port],
        }
        self._control_path = run_dir / "simulator.sock"
        self._control_path.unlink(missing_ok=True)
        self._control = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._control.bind(_short(self._control_path))
        self._control.listen()
        self._control.setblocking(False)
        loop.watch(self._control, self._accept_control)

    def describe(self) -> dict[str, Any]:
        """Who we are and where the devices are; also written to simulator.json."""
        return {
            "pid": os.getpid(),
            "seed": self._model.truth.seed,
            "scenario": self._model.scenario.name,
            **self._where,
            "control": str(self._control_path),
        }

    def run(self) -> None:
        """Serve until `quit`, SIGTERM or SIGINT."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._loop.quit())
        _write_json(self._run_dir / "truth.json", self._model.truth_json())
        _write_json(self._run_dir / "simulator.json", self.describe())
        print("ready", flush=True)
        try:
            self._loop.run()
        finally:
            self._control.close()
            for name in ("simulator.sock", "simulator.json"):
                (self._run_dir / name).unlink(missing_ok=True)

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
                self._loop.forget(connection)
                stream.close()
                connection.close()
                return
            with contextlib.suppress(OSError):
                stream.write(json.dumps(self._control_line(line)).encode() + b"\n")
                stream.flush()

        self._loop.watch(connection, answer)

    def _control_line(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            return {"ok": True, **self._do(request)}
        except (ValueError, KeyError, TypeError, OSError) as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}

    def _do(self, request: dict[str, Any]) -> dict[str, Any]:
        what, model, now = request["do"], self._model, self._loop.now_s
        if what in ("unplug", "plug", "silence"):
            device = request["device"]
            if device not in DEVICES:
                raise ValueError(f"{device!r} is not one of {', '.join(DEVICES)}")
            outlet = self._outlets[device]
            if what == "silence":
                outlet.faults.add("drop", from_s=now, until_s=now + float(request["seconds"]))
            elif what == "unplug":
                outlet.unplug()
            else:
                outlet.plug()
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
            model.arm.permit(bool(request["permitted"]), now)
        elif what == "fault":
            model.arm.fault(int(request["joint"]) - 1, int(request.get("code", 0x8611)), now)
        elif what == "restart_laser":
            model.laser.restart(now)
        elif what == "quit":
            self._loop.quit()
        elif what != "status":
            raise ValueError(f"{what!r} is not known")
        return self._status()

    def _status(self) -> dict[str, Any]:
        model, now = self._model, self._loop.now_s
        model.contact.update(now)
        return {
            "time_s": now,
            "stalled_s": self._loop.stalled_s,
            "joints_rad": model.arm.joints_at(now).tolist(),
            "moving": model.arm.standstill(now) is None,
            "touches": model.contact.count,
            "deepest_touch_m": model.contact.deepest_m,
            "part_present": model.world.part_present,
            "plugged": {name: outlet.plugged for name, outlet in self._outlets.items()},
        }


def _short(path: Path) -> str:
    """A unix socket's path has room for about 100 characters only."""
    relative = os.path.relpath(path)
    return relative if len(relative) < len(str(path)) else str(path)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=2), encoding="utf-8")
    partial.replace(path)
