"""The daemon over a real unix socket, with an engine that only knows its states."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from controller.daemon.address import default_socket, listen
from controller.daemon.feed import EventFeed, plain
from controller.daemon.serve import serve
from controller.packml import Command, State
from controller.store import Store
from estimation.errors import CellError
from tests.controller.fake_engine import FakeEngine


class Cell:
    """A daemon in a thread of this process, and a client of it."""

    def __init__(self, folder: Path) -> None:
        self.engine, self.store = FakeEngine(), Store.open()
        self.address = folder / "run" / "daemon.sock"
        self._server = threading.Thread(target=self._serve)
        self._ready = threading.Event()
        self._loop_end: Callable[[], None] = lambda: None
        self.ended_well: bool | None = None
        self._server.start()
        assert self._ready.wait(20)
        transport = httpx.HTTPTransport(uds=str(self.address))
        self.client = httpx.Client(transport=transport, base_url="http://cell", trust_env=False, timeout=10)

    def _serve(self) -> None:
        def report(run: int | None) -> list[Path]:
            return [Path(f"/reports/{run}.html")]

        self.ended_well = serve(self.engine, self.store, self.address, report, self._ready.set)

    def close(self) -> None:
        self.client.close()
        self.engine.die()  # without signals (this is not the main thread) the engine's end ends the daemon
        self._server.join(20)
        assert not self._server.is_alive()
        self.store.close()


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    cell = Cell(tmp_path)
    yield cell
    cell.close()


@pytest.fixture(scope="module")
def quiet_cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """One for all the requests that change nothing."""
    cell = Cell(tmp_path_factory.mktemp("quiet"))
    yield cell
    cell.close()


def begin(store: Store) -> int:
    return store.begin_run("[cell]", "d" * 64, "0.1.0", simulated=True).id


def test_a_command_reaches_the_engine_with_who_and_why(cell: Cell) -> None:
    answer = cell.client.post("/command/start", json={"who": "Kim", "reason": "batch 7"})
    assert (answer.status_code, answer.json()) == (
        200, {"command": "Start", "state": "Starting", "state_no": 3}
    )  # fmt: skip
    assert cell.engine.heard == [(Command.START, "Kim", "batch 7")]


def test_an_illegal_command_is_refused_with_what_is_allowed(cell: Cell) -> None:
    answer = cell.client.post("/command/Unhold", json={})
    assert (answer.status_code, answer.json()) == (
        409,
        {"problem": "Unhold while Idle", "remedy": "Allowed now: Start, Stop, Abort"},
    )
    assert cell.engine.machine.state is State.IDLE


@pytest.mark.parametrize(
    ("method", "path", "body", "status"),
    [
        ("POST", "/command/StateComplete", {}, 404),  # the engine's own event is no command
        ("POST", "/command/jump", {}, 404),
        ("POST", "/command/start", {"who": ""}, 422),
        ("POST", "/command/start", {"who": "\ud800"}, 422),
        ("POST", "/command/start", {"whom": "Kim"}, 422),
        ("POST", "/command/start", {"reason": "x" * 501}, 422),
        ("GET", "/command/start", None, 405),
        ("GET", "/nothing", None, 404),
        ("GET", "/results?run=7", None, 404),
        ("GET", "/results?run=x", None, 422),
        ("GET", "/report?run=7", None, 404),
        ("GET", "/history?limit=0", None, 422),
        ("POST", "/samples/5/exclude", {"reason": "chip", "who": "Kim"}, 404),
        ("POST", "/samples/99999999999999999999/exclude", {"reason": "chip"}, 422),
        ("POST", "/samples/0/retake", {"reason": "chip"}, 422),
    ],
)
def test_every_refusal_says_problem_and_remedy(
    quiet_cell: Cell, method: str, path: str, body: object, status: int
) -> None:
    content = None if body is None else json.dumps(body)
    headers = {"content-type": "application/json"}
    answer = quiet_cell.client.request(method, path, content=content, headers=headers)
    assert answer.status_code == status, answer.text
    assert set(answer.json()) == {"problem", "remedy"}
    assert all(answer.json().values())
    assert quiet_cell.engine.heard == []


def test_a_defect_is_answered_without_its_words(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> dict[str, Any]:
        raise RuntimeError("password is hunter2")

    monkeypatch.setattr(cell.engine, "status", broken)
    answer = cell.client.get("/status")
    assert answer.status_code == 500
    assert answer.json()["problem"] == "Internal error (RuntimeError)"


def test_status_carries_unknown_numbers_as_null(cell: Cell) -> None:
    assert cell.client.get("/status").json() == {
        "state": "Idle", "state_no": 4, "fault": None, "u_m": None
    }  # fmt: skip


def test_results_history_samples_and_audit_come_from_the_store(cell: Cell) -> None:
    run = begin(cell.store)
    sample = cell.store.add_sample(run, "hand-eye", 1, 0, "laser", {"reading_m": 0.1})
    cell.store.save_result(run, "hand-eye", 1, "OK", {"u_m": 1e-4}, belief={"big": 1}, sample_ids=[sample])
    (result,) = cell.client.get("/results").json()["results"]
    assert (result["verdict"], result["result"], "belief" in result) == ("OK", {"u_m": 1e-4}, False)
    assert cell.client.get(f"/results?run={run}").json()["results"] == [result]
    (shown,) = cell.client.get("/history").json()["runs"]
    assert (shown["verdicts"], shown["simulated"], "cell_text" in shown) == ({"hand-eye": "OK"}, True, False)
    assert cell.client.get("/report?run=1").json() == {"files": ["/reports/1.html"]}
    marked = cell.client.post(f"/samples/{sample}/exclude", json={"who": "Kim", "reason": "chip"})
    assert marked.json() == {"sample": sample, "mark": "excluded"}
    again = cell.client.post(f"/samples/{sample}/retake", json={"who": "Kim", "reason": "chip"})
    assert (again.status_code, again.json()["problem"]) == (409, "Sample 1 was marked excluded by Kim")
    (listed,) = cell.client.get("/samples?phase=hand-eye").json()["samples"]
    assert (listed["mark"], listed["mark_reason"]) == ("excluded", "chip")
    events = cell.client.get("/audit?since=1").json()["events"]
    assert [event["sequence"] for event in events] == [2, 3]


def test_watchers_get_a_snapshot_and_then_every_change(cell: Cell) -> None:
    with cell.client.stream("GET", "/events") as stream:
        lines = (json.loads(line[6:]) for line in stream.iter_lines() if line.startswith("data: "))
        assert next(lines)["event"] == "status"
        cell.client.post("/command/start", json={})
        assert next(lines) == {"event": "state", "state": "Starting", "message": ""}
        cell.engine.publish({"event": "progress", "step": 3, "steps": 80, "u_m": float("inf")})
        assert next(lines) == {"event": "progress", "step": 3, "steps": 80, "u_m": None}


def test_the_socket_lets_only_its_owner_in(cell: Cell) -> None:
    assert cell.address.parent.stat().st_mode & 0o777 == 0o700
    assert cell.address.stat().st_mode & 0o777 == 0o600


def test_when_the_engine_dies_the_daemon_ends_and_says_so(tmp_path: Path) -> None:
    cell = Cell(tmp_path)
    with cell.client.stream("GET", "/events") as stream:
        lines = stream.iter_lines()
        next(lines)
        cell.engine.die()
        assert list(lines)[-1] == ""  # the stream ends by itself
    cell.close()
    assert cell.ended_well is False
    assert cell.engine.was_shut_down
    assert not cell.address.exists()


def test_a_slow_watcher_is_cut_off_and_holds_up_nobody() -> None:
    async def scenario() -> int:
        engine = FakeEngine()
        feed = EventFeed(engine)
        slow = feed.stream(engine.status)
        await anext(slow)
        for number in range(2000):
            engine.publish({"event": "progress", "step": number})
        await asyncio.sleep(0)
        rest = [text async for text in slow]
        feed.close()
        return len(rest)

    assert asyncio.run(scenario()) == 0


def test_plain_keeps_what_json_can_carry() -> None:
    assert plain({"a": [1, 2.5, None, "x"], "b": float("nan"), "c": State.HELD}) == {
        "a": [1, 2.5, None, "x"], "b": None, "c": "Held"
    }  # fmt: skip


def test_a_dead_daemons_socket_is_replaced_and_a_live_ones_is_not(tmp_path: Path) -> None:
    address = tmp_path / "s" / "daemon.sock"
    listen(address).close()  # left behind, as after kill -9
    living = listen(address)
    living.listen()
    with pytest.raises(CellError, match="already answers"):
        listen(address)
    living.close()


def test_folders_that_others_may_enter_are_refused(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir(mode=0o755)
    with pytest.raises(CellError, match="mode 0755"):
        listen(tmp_path / "open" / "daemon.sock")
    (tmp_path / "mine").mkdir(mode=0o700)
    (tmp_path / "mine" / "daemon.sock").write_text("a file")
    with pytest.raises(CellError, match="no socket"):
        listen(tmp_path / "mine" / "daemon.sock")
    with pytest.raises(CellError, match="limit 107"):
        listen(tmp_path / ("x" * 120) / "daemon.sock")


def test_the_address_can_be_named_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRUECELL_SOCKET", "/somewhere/d.sock")
    assert default_socket() == Path("/somewhere/d.sock")
    monkeypatch.delenv("TRUECELL_SOCKET")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert default_socket() == Path("/run/user/7/truecell/daemon.sock")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert default_socket().parent.name == f"truecell-{os.getuid()}"


DAEMON = """
import sys
from pathlib import Path
from controller.daemon.serve import serve
from controller.store import Store
from tests.controller.fake_engine import FakeEngine
engine = FakeEngine()
with Store.open(Path(sys.argv[1]) / "cell.db") as store:
    address = Path(sys.argv[1]) / "run" / "d.sock"
    ended_well = serve(engine, store, address, lambda run: [], lambda: print("ready", flush=True))
sys.exit(0 if ended_well and engine.was_shut_down else 1)
"""


@pytest.mark.wire
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_arm_and_ends_the_daemon_in_order(tmp_path: Path, number: signal.Signals) -> None:
    daemon = subprocess.Popen(
        [sys.executable, "-c", DAEMON, tmp_path],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    assert daemon.stdout is not None
    assert daemon.stdout.readline() == "ready\n"
    with socket.socket(socket.AF_UNIX) as watcher:  # an open stream must not hold up the end
        watcher.connect(str(tmp_path / "run" / "d.sock"))
        watcher.sendall(b"GET /events HTTP/1.1\r\nhost: cell\r\n\r\n")
        assert watcher.recv(12) == b"HTTP/1.1 200"
        daemon.send_signal(number)
        assert daemon.wait(20) == 0
    daemon.stdout.close()
    assert not (tmp_path / "run" / "d.sock").exists()
    Store.open(tmp_path / "cell.db").close()
