"""Simulators, daemon and console as processes: what a person sees when all is well, and when it is not."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.console.exit_codes import ExitCode
from tests.support.processes import ROOT, Outcome, WireCell, wait_until

pytestmark = pytest.mark.wire

SHORT = (  # a job of some seconds: noise and hand-eye alone
    ("readings = 40\nposes = 3", "readings = 10\nposes = 2"),
    ("measurements = 80\nmost_measurements = 160", "measurements = 30\nmost_measurements = 60"),
    ('limit = "0.40 mm"\ngated_ranges', 'limit = "1.5 mm"\ngated_ranges'),
)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WireCell]:
    # In so few readings of seed 1 the noise of joint 3 lies 0.4 % over a limit that one honest cell of a
    # thousand exceeds: that cell is held.
    with WireCell(tmp_path_factory.mktemp("wires"), SHORT, seed=2, drop_phases_after="hand-eye") as cell:
        cell.simulate()
        yield cell


@pytest.fixture
def idle(cell: WireCell) -> Iterator[WireCell]:
    """The cell with a daemon in Idle; after the test nobody serves it."""
    cell.fork_daemon()
    make_idle(cell)
    yield cell
    cell.kill_daemon()


def make_idle(cell: WireCell) -> None:
    state = cell.wait_for_state("Stopped", "Aborted", "Completed", "Idle", "Held")["state"]
    for command, reached in {
        "Aborted": [("clear", "Stopped"), ("reset", "Idle")],
        "Held": [("stop", "Stopped"), ("reset", "Idle")],
        "Idle": [],
    }.get(state, [("reset", "Idle")]):
        assert cell.console(command).code == 0
        cell.wait_for_state(reached)


def assert_one_sentence(outcome: Outcome, code: ExitCode, *words: str) -> None:
    """A problem, a remedy, no traceback."""
    assert outcome.code == code, outcome
    text = outcome.err or outcome.out.splitlines()[-1]
    assert "Traceback" not in outcome.out + outcome.err
    assert len(text.strip().splitlines()) == 1
    for word in words:
        assert word in text


def test_a_job_from_the_console(idle: WireCell) -> None:
    """Two real processes serve; every question and every refusal of a working day."""
    told = idle.console("start --wait --who Ada --reason 'first of the day' --json")
    events = [json.loads(line) for line in told.out.splitlines()]
    assert told.code == ExitCode.OK, told
    steps = [(e["phase"], e["step"]) for e in events if e.get("activity") == "acquiring"]
    assert steps == sorted(set(steps), key=steps.index)  # each once
    status = idle.status()
    assert status["state"] == "Completed" and status["progress"]["outcome"] == "OK"

    results = idle.console("results --json --exit-code")
    assert results.code == ExitCode.OK
    assert [r["phase"] for r in results.json["results"]] == ["noise", "hand-eye"]
    run = idle.console("history --json").json["runs"][0]
    assert run["verdicts"] == {"noise": "OK", "hand-eye": "OK"} and run["simulated"]
    audit = idle.console("history --events --json").json["events"]
    start = next(e for e in audit if e["kind"] == "command" and e["data"]["who"] == "Ada")
    assert start["data"]["reason"] == "first of the day"
    identities = [e["text"] for e in audit if e["kind"] == "connected"]
    assert identities[0].startswith("PRBT 20260300,") and identities[1] == "ILD1420-100 1420100"
    report = idle.console(f"report --run {run['id']} --json")
    assert report.code == ExitCode.OK
    assert {Path(path).suffix for path in report.json["files"]} == {".html", ".pdf"}
    assert all(Path(path).stat().st_size > 1000 for path in report.json["files"])
    assert idle.console("watch --until-waiting --json").code == ExitCode.OK

    for command in ("hold", "unhold", "suspend", "unsuspend", "start", "clear", "complete"):
        refused = idle.console(command)
        assert_one_sentence(refused, ExitCode.REFUSED, "while Completed. Allowed now: Reset")
    assert_one_sentence(idle.console("results --run 999"), ExitCode.BAD_INPUT, "No run 999")
    assert_one_sentence(
        idle.console("samples exclude 999999 --reason x"), ExitCode.BAD_INPUT, "No sample 999999"
    )
    assert idle.console("status --json --nonsense").code == ExitCode.BAD_INPUT
    assert idle.console("abort --json").json["state"] in ("Aborting", "Aborted")
    idle.wait_for_state("Aborted")
    assert_one_sentence(idle.console("reset"), ExitCode.REFUSED, "Reset while Aborted", "Clear")
    assert idle.console("clear").code == ExitCode.OK
    idle.wait_for_state("Stopped")


def test_hold_in_mid_phase_and_the_known_point_comes_first(idle: WireCell) -> None:
    assert idle.console("start").code == ExitCode.OK
    idle.wait_for_step("hand-eye", 5)
    assert idle.console("hold --who Ada --reason 'clean the lens'").code == ExitCode.OK
    held = idle.wait_for_state("Held")
    assert held["fault"] is None and not idle.moves()
    with idle.store() as store:
        run = store.runs(1)[0].id
        before = {sample.id for sample in store.samples(run)}
        sequence = store.events()[-1].sequence
    assert idle.console("watch --until-waiting").code == ExitCode.STOPPED
    done = idle.console("unhold --wait")
    assert done.code == ExitCode.OK, done
    with idle.store() as store:
        since = store.events(sequence)
        kinds = [event.kind for event in since]
        assert kinds.count("reference") == 2
        last_reference = max(event.utc_s for event in since if event.kind == "reference")
        new = [sample for sample in store.samples(run) if sample.id not in before]
        assert new and all(sample.utc_s > last_reference for sample in new)
        assert store.verify_chain() is None


def test_stop_while_the_arm_moves_ends_the_run_without_verdict(idle: WireCell) -> None:
    assert idle.console("start").code == ExitCode.OK
    idle.wait_for_step("noise", 2)
    stopped = idle.console("stop --json")
    assert stopped.code == ExitCode.OK and stopped.json["state"] in ("Stopping", "Stopped")
    assert idle.time_to_rest_s() < 0.5
    idle.wait_for_state("Stopped")
    assert idle.console("history --json").json["runs"][0]["end_state"] == "Stopped"
    assert idle.console("watch --until-waiting").code == ExitCode.STOPPED


# The console; shells let what they start in the background, such as these tests, ignore Ctrl-C.
HEEDING = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from controller.console.app import main
main()
"""


def test_sigterm_while_the_arm_moves(cell: WireCell) -> None:
    """Also: Ctrl-C of a console that waits leaves the job alone, and a cell has one daemon."""
    daemon = cell.serve()
    make_idle(cell)
    command = [sys.executable, "-c", HEEDING, "start", "--wait", "--socket", str(cell.socket)]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as console:
        cell.wait_for_step("noise", 1)
        console.send_signal(signal.SIGINT)
        _, complaint = console.communicate(timeout=30)
    assert console.returncode == ExitCode.INTERRUPTED and "Traceback" not in complaint
    assert cell.status()["state"] == "Execute"

    others = ([*cell.serve_arguments[:-1], str(cell.socket.with_name("other.sock"))], cell.serve_arguments)
    for arguments in others:
        second = subprocess.run(
            [sys.executable, "-m", "controller", *arguments],
            cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert second.returncode == ExitCode.FAULT
        assert "Traceback" not in second.stderr
        assert f"process {daemon.pid} since" in second.stderr.splitlines()[-1]
    assert cell.status()["state"] in ("Execute", "Completing", "Completed")

    make_idle_again(cell)
    wait_until(cell.moves, "the arm moves")
    daemon.send_signal(signal.SIGTERM)
    assert daemon.wait(20) == ExitCode.OK
    cell.daemon_pid = 0
    assert not cell.moves()
    assert_one_sentence(cell.console("status"), ExitCode.NO_DAEMON, "No daemon answers", "truecell serve")
    with cell.store() as store:
        assert store.verify_chain() is None


def make_idle_again(cell: WireCell) -> None:
    """From wherever a job is, to a job that has just begun."""
    if cell.status()["state"] != "Completed":
        cell.console("stop")
    cell.wait_for_state("Stopped", "Completed")
    make_idle(cell)
    assert cell.console("start").code == ExitCode.OK
    cell.wait_for_step("noise", 1)


def refusal_of_start(cell: WireCell, *edits: tuple[str, str]) -> Outcome:
    """What `start --wait` says with another cell file."""
    text = cell.cell_file.read_text()
    cell.edit(*edits)
    try:
        cell.fork_daemon()
        make_idle(cell)
        outcome = cell.console("start --wait")
        assert not cell.moves()
        assert cell.status()["state"] == "Held"
        cell.console("stop")
        cell.wait_for_state("Stopped")
        return outcome
    finally:
        cell.kill_daemon()
        cell.cell_file.write_text(text)


def test_a_missing_device(cell: WireCell) -> None:
    outcome = refusal_of_start(cell, ('port = "run/arm"', 'port = "run/nowhere"'))
    assert_one_sentence(outcome, ExitCode.FAULT, "run/nowhere cannot be opened", "Plug the device in")


def test_a_port_that_is_a_file(cell: WireCell) -> None:
    (cell.home / "notes.txt").write_text("not a port")
    outcome = refusal_of_start(cell, ('port = "run/laser"', 'port = "notes.txt"'))
    assert_one_sentence(outcome, ExitCode.FAULT, "notes.txt cannot be opened", "Check the port")


def test_a_port_with_nobody_behind_it(cell: WireCell) -> None:
    master, slave = os.openpty()
    try:
        outcome = refusal_of_start(cell, ('port = "run/laser"', f'port = "{os.ttyname(slave)}"'))
        assert_one_sentence(outcome, ExitCode.FAULT, "Laser: no valid answer at 921600 8N1", "cable")
    finally:
        os.close(master)
        os.close(slave)


def test_a_wrong_tcp_port(cell: WireCell) -> None:
    outcome = refusal_of_start(cell, (f"port = {cell.port}\n", "port = 9\n"))
    assert_one_sentence(outcome, ExitCode.FAULT, "127.0.0.1 refuses connections to port 9")


def test_a_wrong_baud_rate(cell: WireCell) -> None:
    outcome = refusal_of_start(cell, ("baud = 921600", "baud = 115200"))
    assert_one_sentence(outcome, ExitCode.FAULT, "Laser: no valid answer at 115200 8N1", "baud rate")


def test_another_sensor_than_the_one_that_was_calibrated(cell: WireCell) -> None:
    outcome = refusal_of_start(cell, ('serial_number = "1420100"', 'serial_number = "1420099"'))
    assert_one_sentence(outcome, ExitCode.FAULT, "1420100", "1420099", "calibrate again")


def test_a_cell_file_with_a_mistake(cell: WireCell) -> None:
    text = cell.cell_file.read_text()
    cell.edit(('settle_time = "20 ms"', 'settle_time = "20"'))
    try:
        refused = subprocess.run(
            [sys.executable, "-m", "controller", *cell.serve_arguments],
            cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    finally:
        cell.cell_file.write_text(text)
    assert refused.returncode == ExitCode.BAD_INPUT
    assert "settle_time" in refused.stderr and "Traceback" not in refused.stderr


def test_the_devices_vanish_in_mid_job(cell: WireCell) -> None:
    cell.fork_daemon()
    make_idle(cell)
    assert cell.console("start").code == ExitCode.OK
    cell.wait_for_step("hand-eye", 3)
    cell.control(do="quit")
    held = cell.wait_for_state("Held")
    assert held["fault"]["text"] and held["fault"]["remedy"]
    assert_one_sentence(cell.console("watch --until-waiting"), ExitCode.FAULT)
    assert_one_sentence(
        cell.console("unhold --wait"), ExitCode.FAULT, "cannot be opened", "Plug the device in"
    )
    cell.kill_daemon(signal.SIGTERM)
    assert "Traceback" not in cell.daemon_log.read_text()
