"""`truecell demo`: a whole cell on simulated devices, with wires, daemon and console as a real one has.

Simulators and daemon are processes of their own. This command plays the operator, and it alone may
compare the result with the hidden truth, which the simulators leave in a file.
"""

import contextlib
import json
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from controller.console.client import ConsoleError, DaemonClient
from controller.console.exit_codes import ExitCode, code_of_status
from controller.console.watch import WAITING, choose_view, updated
from controller.demo_cell import copy_bench_block
from controller.truth_table import TruthTable, compare
from estimation.errors import CellError, CellFileError

SCENARIOS: Final = ("honest", "bumped-laser", "noisy-joint", "cable-pulled", "part-missing", "tight-limit")
MOTION_SPEED: Final = 100.0
# A simulated arm does not swing, and its stylus does not break: what a real one needs would only be waiting.
HASTE: Final = (
    ("settle_time", "150 ms", "20 ms"),
    ("sync_period", "20 ms", "5 ms"),
    ("cruise_sync_period", "50 ms", "5 ms"),
    ("search_speed", "8 mm/s", "40 mm/s"),
    ("touch_speed", "1 mm/s", "1.25 mm/s"),
)
PATIENCE: Final = 8  # all of the cell shares this computer with whatever else runs on it
START_TIMEOUT_S: Final = 180.0  # on a computer that is busy with other things
UNPLUG_AT_STEP: Final = 20
TIGHT: Final = '"0.08 mm"'


@dataclass(frozen=True, slots=True)
class Place:
    """Where one demo keeps its files; the sockets lie elsewhere, because their paths must be short."""

    folder: Path
    sockets: Path

    @property
    def cell(self) -> Path:
        return self.folder / "cell" / "cell.toml"

    @property
    def run(self) -> Path:
        return self.folder / "cell" / "run"

    @property
    def state(self) -> Path:
        return self.folder / "state"

    @property
    def daemon(self) -> Path:
        return self.sockets / "daemon.sock"


def run_demo(
    seed: int = 1,
    scenario: str = "honest",
    folder: Path | None = None,
    as_json: bool = False,
    motion_speed: float = MOTION_SPEED,
    devices: Sequence[str] = (),
) -> int:
    """Play one scenario; returns the exit code of the job. Raises CellError.

    `devices` are variants of the cell, in place of its own robot, laser or probe.
    """
    if scenario not in SCENARIOS:
        raise CellFileError(f"No scenario {scenario!r}", f"Choose one of {', '.join(SCENARIOS)}")
    started = time.monotonic()

    def say(text: str) -> None:
        if not as_json:
            print(text, flush=True)

    with tempfile.TemporaryDirectory(prefix="truecell-") as sockets:
        place = Place(_fresh(folder, scenario, seed), Path(sockets))
        _make_cell(place, scenario, devices)
        other = f" with {', '.join(devices)}" if devices else ""
        say(f"Cell bench-block{other}, seed {seed}, scenario {scenario}, in {place.folder}")
        logs = place.folder / "simulators.log", place.folder / "daemon.log"
        world = _process(_simulator_command(place, seed, scenario, motion_speed), logs[0])
        with (
            world as simulators,
            _process(_daemon_command(place), logs[1]) as daemon,
            _client(place) as client,
        ):
            try:
                _await(daemon, logs[1], lambda: _answers(place), "daemon")
            except Refused as refused:
                print(refused, file=sys.stderr)
                say("Refused: the daemon opened nothing, nothing moved.")
                return ExitCode.BAD_INPUT
            _await(simulators, logs[0], (place.run / "simulator.json").exists, "simulators")
            status = _play(client, place, scenario, as_json)
            code = code_of_status(status)
            reports = client.get("/report")["files"] if status.get("run") else []
        table = _truth_table(place)
    if as_json:
        print(
            json.dumps(
                {"exit_code": int(code), "status": status, "truth": table.to_dict(), "reports": reports}
            )
        )
        return code
    say("")
    table.show()
    say(f"\nState {status['state']}: {status.get('message') or 'no message'}")
    say(f"Store  {place.state / 'cell.sqlite'}")
    for report in reports:
        say(f"Report {report}")
    say(f"{time.monotonic() - started:.0f} s; exit code {int(code)}: {code.meaning}")
    return code


def _truth_table(place: Place) -> TruthTable:
    """The last results of the newest run against truth.json."""
    from controller.cellfile import load_cell
    from controller.store import Store

    truth = json.loads((place.run / "truth.json").read_text())
    with Store.open(place.state / "cell.sqlite", read_only=True) as store:
        return compare(load_cell(place.cell), store.latest_results(), truth)


def _fresh(folder: Path | None, scenario: str, seed: int) -> Path:
    """A folder that does not exist yet."""
    base = folder or Path("truecell-demo")
    stamp = time.strftime("%Y%m%d-%H%M%S")
    for number in range(100):
        candidate = base / f"{scenario}-seed{seed}-{stamp}{f'-{number}' if number else ''}"
        with contextlib.suppress(FileExistsError):
            candidate.mkdir(parents=True)
            return candidate
    raise CellError(f"{base} holds 100 demos of this second", "Try again")


def _make_cell(place: Place, scenario: str, devices: Sequence[str]) -> None:
    """The bench-block cell in a hurry."""
    text = copy_bench_block(place.cell.parent, devices).read_text()
    for name, before, after in HASTE:
        text = text.replace(f'\n{name} = "{before}"', f'\n{name} = "{after}"')
    text = text.replace("\npatience = 1 ", f"\npatience = {PATIENCE} ")
    if scenario == "tight-limit":
        text = re.sub(
            r'(name = "localize"(?:(?!\[\[).)*?\nlimit = )"[^"]*"', rf"\g<1>{TIGHT}", text, flags=re.S
        )
    place.cell.write_text(text)


@contextlib.contextmanager
def _process(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is gone when left; `_await` says when it is ready."""
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(15)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _await(process: subprocess.Popen[bytes], log: Path, ready: Callable[[], bool], what: str) -> None:
    """Until the process is ready. Raises Refused if it found the cell file wrong, CellError if it fails."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while not ready():
        if process.poll() is not None or time.monotonic() > deadline:
            said = log.read_text(errors="replace").strip()
            if process.poll() == ExitCode.BAD_INPUT:
                raise Refused(said)
            raise CellError(
                f"The {what} did not start: {(said.splitlines() or ['no output'])[-1]}", f"See {log}"
            )
        time.sleep(0.05)


class Refused(Exception):
    """The daemon found mistakes in the cell file, and opened nothing."""


def _simulator_command(place: Place, seed: int, scenario: str, motion_speed: float) -> list[str]:
    return [
        sys.executable, "-m", "simulators", str(place.cell.parent), "--seed", str(seed),
        "--scenario", scenario, "--motion-speed", f"{motion_speed:g}",
    ]  # fmt: skip


def _daemon_command(place: Place) -> list[str]:
    return [
        sys.executable, "-m", "controller", "serve", str(place.cell),
        "--state-dir", str(place.state), "--socket", str(place.daemon),
    ]  # fmt: skip


def _answers(place: Place) -> bool:
    try:
        with _client(place) as client:
            client.get("/status")
    except ConsoleError:
        return False
    return True


@contextlib.contextmanager
def _client(place: Place) -> Iterator[DaemonClient]:
    client = DaemonClient(place.daemon)
    try:
        yield client
    finally:
        client.close()


def _control(place: Place, **request: Any) -> None:
    """Something happens in the simulated world."""
    described = json.loads((place.run / "simulator.json").read_text())
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
        line.connect(_reachable(Path(described["control"])))
        line.sendall(json.dumps(request).encode() + b"\n")
        answer = json.loads(line.makefile().readline())
    if not answer.get("ok"):
        raise CellError(
            f"The simulators refused {request}: {answer.get('error')}", "This is a defect: report it"
        )


def _reachable(path: Path) -> str:
    """A path short enough for a socket address."""
    with contextlib.suppress(ValueError):
        relative = path.absolute().relative_to(Path.cwd())
        return str(relative)
    return str(path)


class _Operator:
    """What the person at the console does in each scenario."""

    def __init__(self, client: DaemonClient, place: Place, scenario: str) -> None:
        self._client, self._place, self._scenario = client, place, scenario
        self._acted = False

    def see(self, event: dict[str, Any]) -> None:
        """Something happened; the world or the operator may react, once."""
        if self._acted or event["event"] != "progress":
            return
        if self._scenario == "bumped-laser" and _gated(event, "hand-eye"):
            self._acted = True
            _control(self._place, do="bump")
        elif self._scenario == "cable-pulled" and _acquiring(event, "localize", UNPLUG_AT_STEP):
            self._acted = True
            _control(self._place, do="unplug", device="laser")

    def may_cure(self, status: dict[str, Any]) -> bool:
        """The cell waits: put right what can be put right, and go on."""
        if self._scenario == "cable-pulled" and self._acted and status["state"] == "Held":
            self._scenario = "cable-back"
            _control(self._place, do="plug", device="laser")
            self._client.post("/command/unhold", "demo operator", "the laser's cable is plugged in again")
            return True
        return False


def _acquiring(event: dict[str, Any], phase: str, step: int) -> bool:
    at_work = event.get("phase") == phase and event.get("activity") == "acquiring"
    return at_work and int(event.get("step", 0)) >= step


def _gated(event: dict[str, Any], phase: str) -> bool:
    return event.get("phase") == phase and event.get("activity") == "gated"


def _play(client: DaemonClient, place: Place, scenario: str, as_json: bool) -> dict[str, Any]:
    """Reset, start, and follow the job until the cell waits for good."""
    operator = _Operator(client, place, scenario)
    client.post("/command/reset", "demo operator", "")
    _wait_for(client, "Idle")
    events = client.events()
    client.post("/command/start", "demo operator", f"demo, scenario {scenario}")
    status: dict[str, Any] = client.get("/status")
    silent = contextlib.nullcontext()
    with silent if as_json else choose_view(False) as view:
        for event in events:
            status = updated(status, event)
            if view is not None:
                view.show(status, event)
            operator.see(event)
            if status["state"] in WAITING and status["state"] != "Idle":
                status = client.get("/status")
                if status["state"] in WAITING and not operator.may_cure(status):
                    return status
    raise ConsoleError(
        ExitCode.NO_DAEMON, "The daemon ended during the demo", f"See {place.folder / 'daemon.log'}"
    )


def _wait_for(client: DaemonClient, state: str) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while client.get("/status")["state"] != state:
        if time.monotonic() > deadline:
            raise CellError(f"The cell does not reach {state}", "See the daemon's log")
        time.sleep(0.02)
