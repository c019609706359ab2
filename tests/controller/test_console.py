"""The console as a person and a script meet it: what is printed, and what is returned."""

import json
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from controller.console.app import app, main
from controller.console.client import ConsoleError, DaemonClient
from controller.console.exit_codes import ExitCode, code_of_status, code_of_verdicts
from controller.console.watch import LiveView, PlainView, follow, updated
from controller.daemon.serve import serve
from controller.packml import PackMLMachine, State
from controller.store import Store
from tests.controller.fake_engine import FakeEngine

REPOSITORY = Path(__file__).parents[2]


class Outcome:
    """What one call of `truecell` returned and printed."""

    def __init__(self, code: object, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    @property
    def json(self) -> Any:
        return json.loads(self.out)


class Terminal:
    """Calls `truecell` in this process, at one daemon."""

    def __init__(self, capture: pytest.CaptureFixture[str], socket: Path) -> None:
        self._capture, self._socket = capture, socket

    def __call__(self, line: str) -> Outcome:
        self._capture.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(shlex.split(line))
        return Outcome(ended.value.code, *self._capture.readouterr())


@pytest.fixture
def socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    address = tmp_path / "run" / "daemon.sock"
    monkeypatch.setenv("TRUECELL_SOCKET", str(address))
    monkeypatch.setenv("COLUMNS", "200")
    return address


@pytest.fixture
def truecell(capsys: pytest.CaptureFixture[str], socket: Path) -> Terminal:
    return Terminal(capsys, socket)


class Cell:
    """A daemon in a thread, around an engine without devices."""

    def __init__(self, address: Path) -> None:
        self.engine, self.store = FakeEngine(), Store.open()
        ready = threading.Event()
        arguments = (self.engine, self.store, address, lambda run: [Path("/reports/run-1.html")], ready.set)
        self._thread = threading.Thread(target=serve, args=arguments)
        self._thread.start()
        assert ready.wait(20)

    def close(self) -> None:
        self.engine.die()
        self._thread.join(20)
        self.store.close()


@pytest.fixture
def cell(socket: Path) -> Iterator[Cell]:
    cell = Cell(socket)
    yield cell
    cell.close()


COMMANDS = [c.name or (c.callback.__name__ if c.callback else "") for c in app.registered_commands]
PATHS = [*COMMANDS, "samples list", "samples exclude", "samples retake"]


@pytest.mark.parametrize("command", PATHS)
def test_every_command_explains_itself_with_an_example(truecell: Terminal, command: str) -> None:
    answer = truecell(f"{command} --help")
    assert answer.code == 0
    assert f"Example: truecell {command}" in answer.out
    assert "--json" in answer.out or command == "simulate"


def test_the_documentation_has_all_commands_and_exit_codes() -> None:
    text = (REPOSITORY / "docs" / "console.md").read_text()
    rows = {int(n): (name, meaning) for n, name, meaning in re.findall(r"\| (\d+) \| (\w+) \| (.*) \|", text)}
    assert rows == {int(code): (code.name, code.meaning) for code in ExitCode}
    assert all(re.search(rf"`{command}[ `]", text) for command in PATHS)


DAEMON_COMMANDS = [
    "start", "start --wait", "hold", "unhold", "suspend", "unsuspend", "stop", "abort", "clear", "reset",
    "complete", "status", "watch", "results", "report", "history", "samples list",
    "samples exclude 1 --reason x", "samples retake 1 --reason x",
]  # fmt: skip


@pytest.mark.parametrize("command", DAEMON_COMMANDS)
def test_without_a_daemon_there_is_one_clear_sentence(truecell: Terminal, socket: Path, command: str) -> None:
    answer = truecell(command)
    assert answer.code == ExitCode.NO_DAEMON
    assert answer.out == ""
    assert answer.err == (
        f"No daemon answers at {socket}. "
        "Start one with `truecell serve CELL`, or name its socket with --socket.\n"
    )
    refusal = truecell(f"{command} --json").json
    assert refusal["exit_code"] == ExitCode.NO_DAEMON and set(refusal) == {"problem", "remedy", "exit_code"}


def test_a_daemon_that_was_killed_is_no_daemon(truecell: Terminal, cell: Cell) -> None:
    cell.close()
    assert truecell("status").code == ExitCode.NO_DAEMON


def test_commands_say_the_new_state_and_reach_the_engine_with_a_name(truecell: Terminal, cell: Cell) -> None:
    answer = truecell("start --who Kim --reason 'batch 7'")
    assert (answer.code, answer.out) == (ExitCode.OK, "Start: now Starting\n")
    assert truecell("hold --json").json == {"command": "Hold", "state": "Holding", "state_no": 10}
    first, second = cell.engine.heard
    assert first == ("Start", "Kim", "batch 7")
    assert second[1] != ""  # the user of this computer


def test_clear_and_reset_return_when_the_next_command_may_follow(truecell: Terminal, cell: Cell) -> None:
    cell.engine.machine = PackMLMachine(State.ABORTED)
    cell.engine.script = [State.STOPPED]
    answer = truecell("clear")
    assert (answer.code, answer.out, answer.err) == (ExitCode.OK, "Clear: now Stopped\n", "")
    cell.engine.script = [State.IDLE]
    assert truecell("reset --json").json == {"command": "Reset", "state": "Idle", "state_no": 4}
    assert truecell("reset").code == ExitCode.REFUSED  # already Idle


def test_a_clear_that_fails_says_what_is_wrong(truecell: Terminal, cell: Cell) -> None:
    cell.engine.machine = PackMLMachine(State.ABORTED)
    cell.engine.extra = {"fault": {"code": "L4", "text": "Port laser is gone", "remedy": "Check the cable"}}
    cell.engine.script = [State.ABORTED]
    answer = truecell("clear")
    assert answer.code == ExitCode.ABORTED
    assert (answer.out, answer.err) == (
        "Clear: now Aborted\n",
        "L4: Port laser is gone. Check the cable.\n",
    )


def test_a_refused_command_names_the_allowed_ones(truecell: Terminal, cell: Cell) -> None:
    answer = truecell("unhold")
    assert (answer.code, answer.err) == (
        ExitCode.REFUSED,
        "Unhold while Idle. Allowed now: Start, Stop, Abort.\n",
    )
    assert truecell("unhold --wait").code == ExitCode.REFUSED
    assert truecell("unhold --json").json["exit_code"] == ExitCode.REFUSED


def test_status_shows_fault_and_remedy(truecell: Terminal, cell: Cell) -> None:
    cell.engine.extra = {
        "cell": "bench-block",
        "run": 3,
        "progress": {"phase": "hand-eye", "activity": "acquiring", "step": 12, "steps": 80},
        "fault": {"code": "L4", "text": "Laser silent for 0.2 s", "remedy": "Check power and port"},
        "devices": {"laser": {"frames": 10, "bad_frames": 0, "timeouts": 2, "reconnects": 1}},
        "allowed": ["Start", "Stop", "Abort"],
    }
    text = truecell("status").out
    for expected in (
        "bench-block", "Idle (4)", "hand-eye acquiring 12/80", "Start, Stop, Abort", "2 timeouts",
        "L4: Laser silent for 0.2 s. Check power and port.",
    ):  # fmt: skip
        assert expected in text
    assert truecell("status --json").json["run"] == 3


def test_links_are_shown_with_their_answer_times(truecell: Terminal, cell: Cell) -> None:
    answers = [0, 0, 90, 9, 1, 0, 0, 0, 0, 0, 0]
    laser = {
        "port": "/dev/ttyUSB0", "opened": 2, "broken": 1, "sent": 800, "received": 9000, "late": 3,
        "answers": answers, "longest_answer_s": 0.0173,
    }  # fmt: skip
    cell.engine.extra = {
        "devices": {"laser": {"frames": 10, "bad_frames": 4, "timeouts": 2, "reconnects": 1}},
        "links": {"laser": laser, "robot.stop": {**laser, "answers": [0] * 11}},
    }
    lines = [line.split() for line in truecell("status --links").out.splitlines()]
    assert ["laser", "10", "4", "2", "1", "3", "5", "10", "17.3"] in lines
    assert ["robot.stop", *"–" * 8] in lines


def test_results_history_samples_and_report(truecell: Terminal, cell: Cell) -> None:
    assert truecell("results").out == "No results yet.\n"
    assert truecell("results --exit-code").code == ExitCode.FAULT
    run = cell.store.begin_run("[cell]", "d" * 64, "0.1.0", simulated=True).id
    sample = cell.store.add_sample(run, "hand-eye", 1, 0, "laser", {"quality": "good"})
    proof = {
        "name": "expanded uncertainty",
        "value": 0.5,
        "limit": 0.4,
        "unit": "mm",
        "outcome": "NotDecidable",
    }
    verdict = {"message": "U is 0.50 mm [90 mm]", "remedy": "Add poses", "proofs": [proof]}
    cell.store.save_result(run, "hand-eye", 1, "NotDecidable", {"verdict": verdict}, sample_ids=[sample])
    shown = truecell("results").out
    for expected in ("hand-eye", "NotDecidable", "0.5 mm", "0.4 mm", "U is 0.50 mm [90 mm]", "Add poses"):
        assert expected in shown
    assert truecell("results --exit-code --run 1").code == ExitCode.NOT_DECIDABLE
    assert truecell("results --run 9").code == ExitCode.BAD_INPUT
    assert "(simulated)" in truecell("history").out
    assert "hand-eye, attempt 1: NotDecidable" in truecell("history --events").out
    assert truecell("samples exclude 1 --reason chip --who Kim").out == "Sample 1: excluded\n"
    assert truecell("samples retake 1 --reason chip").code == ExitCode.REFUSED
    assert "excluded by Kim: chip" in truecell("samples list --phase hand-eye").out
    assert truecell("report").out == "/reports/run-1.html\n"
    for command in ("results", "history", "history --events", "samples list", "report"):
        assert truecell(f"{command} --json").json


def test_start_and_wait_follows_the_job_to_its_end(truecell: Terminal, cell: Cell) -> None:
    cell.engine.script = [
        {"event": "progress", "phase": "hand-eye", "activity": "acquiring", "step": 1, "steps": 2},
        {"event": "fault", "code": "G", "text": "Phase hand-eye: U is 0.5 mm", "remedy": "Add poses"},
        State.HELD,
    ]
    cell.engine.extra = {"progress": {"activity": "gated", "outcome": "NotDecidable"}, "fault": {"code": "G"}}
    answer = truecell("start --wait")
    assert answer.code == ExitCode.NOT_DECIDABLE
    assert answer.out.splitlines() == [
        "Idle",
        "Starting",
        "hand-eye acquiring 1/2",
        "fault G: Phase hand-eye: U is 0.5 mm. Add poses.",
        "Held",
    ]


def test_the_live_panel_follows_state_and_allowed_commands(
    socket: Path, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    cell.engine.extra = {"cell": "bench [A]", "allowed": ["Start"]}
    progress = {"event": "progress", "phase": "hand-eye", "activity": "acquiring", "step": 40, "steps": 80}
    cell.engine.script = [progress, State.HELD]
    client = DaemonClient(socket)
    follow(client, LiveView(), True, lambda: client.post("/command/start", "Kim", ""))
    client.close()
    panel = capsys.readouterr().out
    for expected in ("bench [A]", "Held (11)", "hand-eye acquiring 40/80", "Stop, Unhold, Abort, Complete"):
        assert expected in panel


def test_watch_as_json_is_one_document_per_event(truecell: Terminal, cell: Cell) -> None:
    answer = truecell("watch --until-waiting --json")
    assert answer.code == ExitCode.STOPPED
    assert [json.loads(line)["event"] for line in answer.out.splitlines()] == ["status"]


def test_watching_a_daemon_that_ends_says_so(socket: Path, cell: Cell) -> None:
    client = DaemonClient(socket)
    with pytest.raises(ConsoleError, match="The daemon has ended") as ended:
        follow(client, PlainView(), until_waiting=False, once_connected=cell.engine.die)
    assert ended.value.code is ExitCode.NO_DAEMON
    client.close()


@pytest.mark.parametrize(
    ("status", "code"),
    [
        ({"state": "Completed", "progress": {"outcome": "OK"}}, ExitCode.OK),
        ({"state": "Completed", "progress": {"outcome": "NotOK"}}, ExitCode.NOT_OK),
        ({"state": "Completed", "progress": {}}, ExitCode.FAULT),
        ({"state": "Held", "fault": None}, ExitCode.STOPPED),
        ({"state": "Held", "fault": {"code": "L4"}, "progress": {"activity": "acquiring"}}, ExitCode.FAULT),
        (
            {"state": "Held", "fault": {"code": "G"}, "progress": {"activity": "gated", "outcome": "NotOK"}},
            ExitCode.NOT_OK,
        ),
        (
            {"state": "Held", "fault": {"code": "L4"}, "progress": {"activity": "gated", "outcome": "OK"}},
            ExitCode.FAULT,
        ),
        ({"state": "Suspended"}, ExitCode.SUSPENDED),
        ({"state": "Stopped"}, ExitCode.STOPPED),
        ({"state": "Aborted"}, ExitCode.ABORTED),
        ({"state": "Execute"}, ExitCode.DEFECT),
    ],
)
def test_the_exit_code_of_a_waiting_cell(status: dict[str, Any], code: ExitCode) -> None:
    assert code_of_status(status) == code


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [
        ([], ExitCode.FAULT),
        (["OK", "OK"], ExitCode.OK),
        (["OK", "NotDecidable"], ExitCode.NOT_DECIDABLE),
        (["NotDecidable", "NotOK", "OK"], ExitCode.NOT_OK),
        (["NotOK", "Undefined"], ExitCode.FAULT),
        (["OK", "something new"], ExitCode.FAULT),
    ],
)
def test_the_exit_code_of_verdicts_is_that_of_the_worst(verdicts: list[str], code: ExitCode) -> None:
    assert code_of_verdicts(verdicts) == code


def test_a_latched_fault_is_shown_until_it_is_gone() -> None:
    status: dict[str, Any] = {"state": "Execute"}
    for event in (
        {"event": "fault", "code": "L4"},
        {"event": "state", "state": "Holding"},
        {"event": "state", "state": "Held"},
    ):
        status = updated(status, event)
    assert status["fault"]["code"] == "L4"
    assert updated(status, {"event": "state", "state": "Execute"})["fault"] is None


@pytest.mark.parametrize(
    "line",
    ["", "jump", "start --speed 3", "check", "samples exclude x", "samples exclude 3", "results --run 0"],
)
def test_wrong_usage_is_bad_input(truecell: Terminal, line: str) -> None:
    assert truecell(line).code == ExitCode.BAD_INPUT


def test_check_names_mistakes_with_their_line(truecell: Terminal, tmp_path: Path) -> None:
    good = truecell(f"check {REPOSITORY / 'cells' / 'bench-block'}")
    assert (good.code, good.err) == (ExitCode.OK, "")
    (tmp_path / "cell.toml").write_text('[cell]\nname = "x"\nsimulatd = true\n')
    bad = truecell(f"check {tmp_path}")
    assert bad.code == ExitCode.BAD_INPUT
    assert "cell.toml:3: cell.simulatd" in bad.err
    assert truecell(f"check {tmp_path} --json").json["mistakes"][0]["line"] >= 1
    assert truecell(f"check {tmp_path / 'missing.toml'}").code == ExitCode.BAD_INPUT


def test_serve_runs_what_the_cell_file_says_until_its_end(
    truecell: Terminal, tmp_path: Path, socket: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Path, Path]] = []

    def build_engine(cell: Path, state_dir: Path) -> tuple[FakeEngine, Store]:
        asked.append((cell, state_dir))
        engine = FakeEngine()
        engine.die()
        return engine, Store.open(state_dir / "cell.db")

    service = ModuleType("controller.service")
    service.build_engine = build_engine  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "controller.service", service)
    answer = truecell(f"serve {tmp_path} --json")
    assert asked == [(tmp_path, tmp_path / ".truecell")]
    assert answer.code == ExitCode.DEFECT  # the engine was dead from the start
    assert answer.json == {"socket": str(socket), "state_dir": str(tmp_path / ".truecell"), "state": "Idle"}
    Store.open(tmp_path / ".truecell" / "cell.db").close()  # it was let go


def test_a_defect_is_one_sentence_and_its_own_code(
    truecell: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_path: Path, **_options: object) -> list[object]:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr("controller.cellfile.check_cell", broken)
    answer = truecell("check .")
    assert answer.code == ExitCode.DEFECT
    assert answer.err == (
        "Unexpected defect: ZeroDivisionError: oh. "
        "Set TRUECELL_DEBUG=1, run it again and report what it prints.\n"
    )


def test_ctrl_c_ends_the_console_only(truecell: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_self: object, _path: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(DaemonClient, "get", interrupt)
    assert truecell("status").code == ExitCode.INTERRUPTED


def test_help_needs_no_heavy_library() -> None:
    program = (
        "import sys; from controller.console import app; "
        "heavy = ('numpy', 'scipy', 'pydantic', 'httpx', 'sqlalchemy', 'rich'); "
        "print([name for name in heavy if name in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert printed.stdout == "[]\n"


def test_errors_survive_pickling() -> None:
    import pickle

    error = pickle.loads(
        pickle.dumps(ConsoleError(ExitCode.REFUSED, "Start while Held", "Allowed now: Stop"))
    )
    assert (error.code, error.problem) == (ExitCode.REFUSED, "Start while Held")
