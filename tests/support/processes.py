"""A whole cell as a person has it: simulators, daemon and console in processes of their own."""

import contextlib
import io
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final, Self

from controller.console.app import main
from controller.demo_cell import copy_bench_block
from controller.store import Store

ROOT: Final = Path(__file__).parents[2]
DEADLINE_S: Final = 60.0  # far more than anything takes, also on a busy machine
PATIENCE: Final = 8  # the processes of all tests share the computer
HASTE: Final = (  # what a simulated arm does not need
    ("\npatience = 1 ", f"\npatience = {PATIENCE} "),
    ('\nsettle_time = "150 ms"', '\nsettle_time = "20 ms"'),
    ('\nsync_period = "20 ms"', '\nsync_period = "10 ms"'),
    ('\ncruise_sync_period = "50 ms"', '\ncruise_sync_period = "10 ms"'),
    ('\nsearch_speed = "8 mm/s"', '\nsearch_speed = "20 mm/s"'),
)

# Forks daemons from a process that has imported everything: a restart within half a second. Reads command
# lines from its input and answers with the process number.
_NURSERY: Final = """
import os, shlex, signal, sys
from pathlib import Path
from controller.console.app import main
from controller.demo_cell import copy_bench_block
import controller.daemon.reports, controller.daemon.serve, controller.service
from controller.cellfile import load_cell
from controller.planning.feasibility import limit_mistakes
load_cell(Path(sys.argv[1]), feasibility=limit_mistakes)
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        log = os.open(sys.argv[2], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        for descriptor in (1, 2):
            os.dup2(log, descriptor)
        os.close(0)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        main(shlex.split(line))
    print(pid, flush=True)
"""


def wait_until(condition: Callable[[], object], what: str, within_s: float = DEADLINE_S) -> None:
    """Another process works meanwhile."""
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {within_s:g} s"
        time.sleep(0.01)


@dataclass(frozen=True)
class Outcome:
    """What one call of `truecell` returned and printed."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


@dataclass
class WireCell:
    """A copy of bench-block under `folder`; its processes end with it."""

    folder: Path
    edits: Sequence[tuple[str, str]] = ()
    seed: int = 1
    motion_speed: float = 100.0
    scenario: str = "honest"
    drop_phases_after: str = ""
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._short = Path(tempfile.mkdtemp(prefix="tc-"))
        self.home = self.folder / "cell"
        text = copy_bench_block(self.home).read_text()
        self.port = tomllib.loads(text)["probe"]["port"]
        if self.drop_phases_after:
            end = text.index(f'name = "{self.drop_phases_after}"')
            following = text.find("[[job.phases]]", end)
            text = text[:following] if following > 0 else text
        self.cell_file.write_text(text)
        self.edit(*HASTE, *self.edits)
        self.simulators: subprocess.Popen[str] | None = None
        self.daemon_pid = 0
        self._nursery: subprocess.Popen[str] | None = None

    @property
    def cell_file(self) -> Path:
        return self.home / "cell.toml"

    @property
    def run_dir(self) -> Path:
        return self.home / "run"

    @property
    def socket(self) -> Path:
        return self._short / "daemon.sock"

    @property
    def state(self) -> Path:
        return self.folder / "state"

    @property
    def daemon_log(self) -> Path:
        return self.folder / "daemon.log"

    def edit(self, *edits: tuple[str, str]) -> None:
        """Replace text of the cell file; each old text must be there."""
        text = self.cell_file.read_text()
        for old, new in edits:
            assert old in text, f"{old!r} is not in the cell file"
            text = text.replace(old, new)
        self.cell_file.write_text(text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill_daemon(signal.SIGTERM)
        for process in reversed(self.processes):
            if process.stdin is not None:
                process.stdin.close()
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(15)
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        shutil.rmtree(self._short, ignore_errors=True)

    # Processes

    def start(self, *arguments: str, log: Path) -> subprocess.Popen[str]:
        """`python -m controller ARGUMENTS` as a process of its own."""
        with log.open("a") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "controller", *arguments],
                cwd=ROOT, stdin=subprocess.DEVNULL, stdout=output, stderr=output, text=True,
            )  # fmt: skip
        self.processes.append(process)
        return process

    def simulate(self) -> None:
        """`truecell simulate`, ready when this returns."""
        options = ["--seed", str(self.seed), "--motion-speed", f"{self.motion_speed:g}"]
        options += ["--scenario", self.scenario]
        log = self.folder / "simulators.log"
        self.simulators = self.start("simulate", str(self.home), *options, log=log)
        wait_until(self._simulates, "simulators ready")

    def _simulates(self) -> bool:
        assert self.simulators is not None and self.simulators.poll() is None, "the simulators ended"
        return (self.run_dir / "simulator.json").exists()

    @property
    def serve_arguments(self) -> list[str]:
        return ["serve", str(self.cell_file), "--state-dir", str(self.state), "--socket", str(self.socket)]

    def serve(self) -> subprocess.Popen[str]:
        """`truecell serve`, answering when this returns."""
        process = self.start(*self.serve_arguments, log=self.daemon_log)
        self.daemon_pid = process.pid
        wait_until(lambda: self.answers() or process.poll() is not None, "daemon answers")
        assert process.poll() is None, self.daemon_log.read_text()
        return process

    def fork_daemon(self) -> None:
        """The same, from a process that has imported everything already."""
        if self._nursery is None:
            command = [sys.executable, "-c", _NURSERY, str(self.cell_file), str(self.daemon_log)]
            pipe = subprocess.PIPE
            self._nursery = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True)
            self.processes.append(self._nursery)
        source, sink = _pipes(self._nursery)
        sink.write(shlex.join(self.serve_arguments) + "\n")
        sink.flush()
        self.daemon_pid = int(source.readline())
        wait_until(self.answers, "daemon answers")

    def kill_daemon(self, number: int = signal.SIGKILL) -> None:
        """Send a signal and wait until the process is gone."""
        pid, self.daemon_pid = self.daemon_pid, 0
        if pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
            wait_until(lambda: not _alive(pid), "daemon gone")

    def answers(self) -> bool:
        return self.console("status --json").code == 0

    # What a person does

    def console(self, line: str) -> Outcome:
        """`truecell LINE`, in this process because starting one takes seconds."""
        out, err = io.StringIO(), io.StringIO()
        code: object = 0
        arguments = [*shlex.split(line), "--socket", str(self.socket)]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main(arguments)
            except SystemExit as ended:
                code = ended.code
        return Outcome(int(code or 0), out.getvalue(), err.getvalue())

    def status(self) -> dict[str, Any]:
        answer: dict[str, Any] = self.console("status --json").json
        return answer

    def wait_for_state(self, *states: str, within_s: float = DEADLINE_S) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def reached() -> bool:
            found.update(self.status())
            return found["state"] in states

        wait_until(reached, f"state {' or '.join(states)}", within_s)
        return found

    def wait_for_step(self, phase: str, step: int) -> None:
        """Until so many measurements of a phase are acknowledged."""

        def reached() -> bool:
            progress = self.status()["progress"]
            return bool(progress.get("phase") == phase and progress.get("step", 0) >= step)

        wait_until(reached, f"{phase} step {step}")

    # What happens in the world

    def control(self, **request: Any) -> dict[str, Any]:
        """One request to the simulators."""
        described = json.loads((self.run_dir / "simulator.json").read_text())
        with socket.socket(socket.AF_UNIX) as line:
            line.connect(os.path.relpath(described["control"]))
            line.sendall(json.dumps(request).encode() + b"\n")
            answer: dict[str, Any] = json.loads(line.makefile().readline())
        assert answer["ok"], answer
        return answer

    def moves(self) -> bool:
        return bool(self.control(do="status")["moving"])

    def time_to_rest_s(self) -> float:
        """How long the simulated arm still moves, in its own time."""
        first = self.control(do="status")
        last = first
        deadline = time.monotonic() + DEADLINE_S
        while last["moving"]:
            assert time.monotonic() < deadline, "the arm does not come to rest"
            last = self.control(do="status")
        return float(last["time_s"] - first["time_s"])

    def store(self) -> Store:
        """The store, for reading alone."""
        return Store.open(self.state / "cell.sqlite", read_only=True)


def _pipes(process: subprocess.Popen[str]) -> tuple[IO[str], IO[str]]:
    assert process.stdout is not None and process.stdin is not None
    return process.stdout, process.stdin


def _alive(pid: int) -> bool:
    """A thread of it runs, and does not merely wait for somebody to note its end.

    The first thread may have ended before the others, which still hold the files and locks of the process.
    """
    states, gone = list[str](), (FileNotFoundError, ProcessLookupError)
    with contextlib.suppress(*gone):  # the process goes while its threads are listed
        for thread in Path(f"/proc/{pid}/task").glob("*/stat"):
            with contextlib.suppress(*gone):
                states.append(thread.read_text().rpartition(")")[2].split()[0])
    return any(state not in "ZX" for state in states)
