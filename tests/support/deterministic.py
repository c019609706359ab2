"""A whole cell in one thread and virtual time: the real engine, drivers and store on in-memory links."""

import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from controller.cellfile import Cell, load_cell
from controller.devices import make_devices
from controller.engine import Engine
from controller.job import CellJob
from controller.packml import Command, State
from controller.store import Result, Store
from estimation.belief import Belief
from estimation.statistics import Outcome
from simulators.robots.canopen_arm import SimulatedArm
from simulators.virtual import SimulatedCell
from simulators.world.truth import Truth

BENCH_BLOCK = Path("cells/bench-block")


def edited_cell(folder: Path, *edits: tuple[str, str]) -> Path:
    """A copy of the bench-block cell with text replaced in its cell file; each old text must be there."""
    shutil.copytree(BENCH_BLOCK, folder, dirs_exist_ok=True)
    path = folder / "cell.toml"
    text = path.read_text()
    for old, new in edits:
        if old not in text:
            raise ValueError(f"{old!r} is not in {path}")
        text = text.replace(old, new)
    path.write_text(text)
    return path


@dataclass
class DeterministicCell:
    """Engine and simulated world of one seed, single-stepped by the test."""

    seed: int = 1
    scenario: str = "honest"
    cell_path: Path = BENCH_BLOCK / "cell.toml"
    store_path: str | Path = ":memory:"
    events: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.cell: Cell = load_cell(self.cell_path)
        self.world = SimulatedCell(
            self.cell_path.parent,
            self.seed,
            scenario=self.scenario,
            robot=self.cell.robot.driver,
            laser=self.cell.laser.driver,
            probe=self.cell.probe.driver,
        )
        self.sent_can_ids: list[int] = []
        if isinstance(self.world.arm, SimulatedArm):
            self._log_can_ids()
        self.store = Store.open(self.store_path, durable=False, clock=self.world.clock)
        self.devices = make_devices(self.cell, self.world.ports, self.world.clock, keep_alive_thread=False)
        self.job = CellJob(self.cell, self.devices, self.store, self.world.clock, "test")
        reopened = self.store.last_open_run() is not None
        self.engine = Engine(
            self.job,
            self.devices,
            self.world.clock,
            initial=State.ABORTED if reopened else State.STOPPED,
            reason="restarted" if reopened else "",
        )
        self.engine.subscribe(self.events.append)
        self.job.publish = self.engine.publish
        self.wall_s = 0.0

    def _log_can_ids(self) -> None:
        send = self.world.arm_link.send

        def logged(can_id: int, data: bytes) -> None:
            self.sent_can_ids.append(can_id)
            send(can_id, data)

        self.world.arm_link.send = logged  # type: ignore[method-assign]

    def motion_frames(self) -> int:
        """How many frames were sent that could move the arm: set-points and controlwords."""
        return sum(can_id & 0x780 in (0x200, 0x300) for can_id in self.sent_can_ids)

    @property
    def truth(self) -> Truth:
        return self.world.truth

    def command(self, *commands: Command) -> State:
        """Give commands one after the other, each until the machine waits again."""
        started = time.perf_counter()
        for command in commands:
            self.engine.submit(command, "test")
            self.engine.run_until_waiting()
        self.wall_s += time.perf_counter() - started
        return self.engine.state

    def run(self) -> State:
        """From Stopped to wherever the job gets."""
        return self.command(Command.RESET, Command.START)

    def results(self) -> dict[str, Result]:
        """The last result of each phase of the newest run."""
        runs = self.store.runs(1)
        return {result.phase: result for result in self.store.results(runs[0].id)} if runs else {}

    def belief(self, phase: str) -> Belief:
        stored = self.results()[phase].belief
        if stored is None:
            raise ValueError(f"{phase} has no belief")
        return Belief.from_dict(stored)

    @property
    def released(self) -> bool:
        """The job completed and every phase is OK."""
        return self.engine.state is State.COMPLETED and self.job.outcome() is Outcome.OK

    def close(self) -> None:
        self.store.close()
