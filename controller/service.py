"""From a cell file to an engine on real ports."""

import sys
from importlib.metadata import version
from pathlib import Path
from typing import Final

from controller.cellfile import load_cell
from controller.devices import make_devices
from controller.engine import Engine
from controller.job import CellJob
from controller.packml import State
from controller.planning.feasibility import limit_mistakes
from controller.store import Store
from drivers.clock import RealClock
from drivers.links.ports import RealPorts

STORE_NAME = "cell.sqlite"
SWITCH_INTERVAL_S: Final = 0.0005  # at Python's 5 ms, each answer of a device waits for the other threads


def build_engine(cell_path: Path, state_dir: Path) -> tuple[Engine, Store]:
    """The engine of a cell and its store; no port is opened, and nothing moves, before Start.

    Raises CellFileError with all mistakes, StoreError when the store is in use or damaged.
    """
    cell = load_cell(cell_path, feasibility=limit_mistakes)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    clock = RealClock()
    store = Store.open(state_dir / STORE_NAME)
    ports = RealPorts(cell.directory, clock)
    devices = make_devices(cell, ports, clock, keep_alive_thread=True)
    job = CellJob(cell, devices, store, clock, version("truecell"))
    open_run = store.last_open_run()
    if open_run is None:
        engine = Engine(job, devices, clock)
    else:
        reason = f"The daemon ended during run {open_run.id}; what was measured is kept"
        engine = Engine(job, devices, clock, initial=State.ABORTED, reason=reason)
    job.publish = engine.publish
    return engine, store
