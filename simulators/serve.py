"""The simulated cell in real time: its devices on ports that another process opens, in one loop."""

import json
import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simulators.cell import CellModel
from simulators.control import STATION_COMMANDS, ControlSocket, happen
from simulators.endpoints import NamedDevice
from simulators.outlets import Loop
from simulators.registry import device_kind
from simulators.station import Station


class CellServer:
    """Devices of a `CellModel` at their ports; simulator.json, truth.json and control are in `run_dir`.

    Raises CellFileError.
    """

    def __init__(self, model: CellModel, devices: Mapping[str, NamedDevice], run_dir: Path) -> None:
        self._model, self._run_dir = model, run_dir
        self._loop = loop = Loop(model.contact.update)
        run_dir.mkdir(parents=True, exist_ok=True)
        self._stations = {
            name: Station(loop, device_kind(named.driver), model.devices[name], named.endpoint)
            for name, named in devices.items()
        }
        self._control = ControlSocket(loop, run_dir / "simulator.sock", self._do)

    def describe(self) -> dict[str, Any]:
        """Who we are and where the devices are; also written to simulator.json."""
        return {
            "pid": os.getpid(),
            "seed": self._model.truth.seed,
            "scenario": self._model.scenario.name,
            "devices": {name: station.where for name, station in self._stations.items()},
            "control": str(self._control.path),
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
            (self._run_dir / "simulator.json").unlink(missing_ok=True)

    def _do(self, request: dict[str, Any]) -> dict[str, Any]:
        what, model, now = request["do"], self._model, self._loop.now_s
        if what in STATION_COMMANDS:
            happen(self._stations, request)
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
            "plugged": {name: station.plugged for name, station in self._stations.items()},
        }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=2), encoding="utf-8")
    partial.replace(path)
