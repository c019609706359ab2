"""kill -9 of the daemon at seeded moments of a whole job: nothing is lost, used twice, or moves on."""

import contextlib
import random
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest

from controller.console.client import ConsoleError, DaemonClient
from controller.console.exit_codes import ExitCode
from controller.packml import State
from controller.store import Event, Store
from tests.support.deterministic import DeterministicCell
from tests.support.processes import PATIENCE, WireCell, wait_until

pytestmark = [pytest.mark.wire, pytest.mark.timeout(1500)]

KILLS: Final = 30
CAMPAIGN_SEEDS: Final = range(3000, 3006)
KILLS_IN_ONE_JOB: Final = 55
REST_S: Final = 0.2 * PATIENCE + 0.3  # the drives' watch of SYNC, and the ramp: then nothing moves
SEVERITY: Final = ("OK", "NotDecidable", "NotOK", "Undefined")

SMALL = (  # every kind of phase, with few measurements
    ("readings = 40\nposes = 3", "readings = 10\nposes = 2"),
    ("measurements = 80\nmost_measurements = 160", "measurements = 40\nmost_measurements = 120"),
    ('limit = "0.40 mm"\ngated_ranges', 'limit = "0.60 mm"\ngated_ranges'),
    ("points_per_sphere = 4\nplate_poses = 8", "points_per_sphere = 3\nplate_poses = 4"),
    ("measurements = 30\nmost_measurements = 60", "measurements = 20\nmost_measurements = 60"),
    ('limit = "0.40 mm"\ngated_points', 'limit = "0.60 mm"\ngated_points'),
)


@dataclass
class Journal:
    """What the daemon has acknowledged to a watcher: phase, attempt and how many of its steps."""

    acknowledged: dict[tuple[str, int], int] = field(default_factory=dict)
    samples: dict[int, str] = field(
        default_factory=dict
    )  # every sample ever seen in the store, with its digest
    references: int = 0
    slowest_rest_s: float = 0.0
    where: list[str] = field(default_factory=list)
    ending: str = ""

    def watch(self, cell: WireCell) -> threading.Thread:
        """Note every event until the daemon ends."""

        def listen() -> None:
            client = DaemonClient(cell.socket)
            with contextlib.suppress(ConsoleError), contextlib.closing(client):
                for event in client.events():
                    self.note(event)

        thread = threading.Thread(target=listen, daemon=True)
        thread.start()
        return thread

    def note(self, event: dict[str, Any]) -> None:
        if event["event"] == "progress" and event.get("activity") == "acquiring" and "step" in event:
            key = (str(event["phase"]), int(event["attempt"]))
            self.acknowledged[key] = max(self.acknowledged.get(key, 0), int(event["step"]))

    def compare(self, store: Store) -> None:
        """Nothing that was acknowledged is missing, altered or there twice."""
        run = store.runs(1)[0].id
        stored = store.samples(run, include_excluded=True)
        present = {sample.id: sample.digest for sample in stored}
        for number, digest in self.samples.items():
            assert present.get(number) == digest, f"sample {number} was acknowledged and is gone"
        places = [(s.phase, s.attempt, s.step) for s in stored if s.mark != "retake"]
        assert len(set(places)) == len(places), "a step was measured twice"
        for (phase, attempt), steps in self.acknowledged.items():
            found = sum(place[:2] == (phase, attempt) for place in places)
            assert found >= steps, f"{phase}: {steps} acknowledged, {found} stored"
        self.samples = present


def small_cell(folder: Path) -> WireCell:
    return WireCell(folder, SMALL)


def go(cell: WireCell) -> None:
    """From a fresh or killed daemon to a job that runs."""
    if cell.wait_for_state("Stopped", "Aborted", "Completed")["state"] == "Aborted":
        assert cell.console("clear").code == 0
        cell.wait_for_state("Stopped")
    assert cell.console("reset").code == 0
    cell.wait_for_state("Idle")
    assert cell.console("start").code == 0


def uninterrupted(folder: Path) -> tuple[list[str], dict[str, str]]:
    """The phase of every sample, and the verdicts, of the same job and seed when nobody disturbs it.

    In the deterministic cell: it has the same engine, drivers and store, and takes seconds.
    """
    with small_cell(folder) as cell:
        whole = DeterministicCell(seed=cell.seed, cell_path=cell.cell_file)
        assert whole.run() is State.COMPLETED
        run = whole.store.runs(1)[0].id
        phases = [sample.phase for sample in whole.store.samples(run)]
        verdicts = {result.phase: result.verdict for result in whole.store.results(run)}
        whole.close()
    return phases, verdicts


def kill_and_go_on(cell: WireCell, journal: Journal) -> None:
    """One kill -9; the arm comes to rest by itself, and the next daemon goes on."""
    progress = cell.status()["progress"]
    journal.where.append(str(progress.get("phase")))
    cell.kill_daemon()
    rest_s = cell.time_to_rest_s()
    journal.slowest_rest_s = max(journal.slowest_rest_s, rest_s)
    assert rest_s < REST_S, f"the arm moved on for {rest_s:.2f} s"
    with cell.store() as store:
        journal.compare(store)
    cell.fork_daemon()
    assert cell.status()["state"] == "Aborted"
    journal.watch(cell)
    go(cell)


def references_came_first(events: list[Event], sample_utc_s: list[float], plate_utc_s: list[float]) -> int:
    """After each restart two known points were measured before anything new counted; how often."""
    resumed = [event for event in events if event.kind == "resumed"]
    checked = 0
    for place, event in enumerate(resumed):
        until = resumed[place + 1].utc_s if place + 1 < len(resumed) else float("inf")
        new = [utc_s for utc_s in sample_utc_s if event.utc_s < utc_s < until]
        if not new or sum(utc_s < event.utc_s for utc_s in plate_utc_s) < 2:
            continue
        before = [e for e in events if e.kind == "reference" and event.utc_s <= e.utc_s <= min(new)]
        assert len(before) >= 2, f"{event.text}: new points before the reference"
        checked += 1
    return checked


def killed(folder: Path, samples: list[str], kills: int, seed: int) -> tuple[Journal, dict[str, str]]:
    """One job with so many kills, spread over its samples and at random between them."""
    draw = random.Random(seed)
    numbers = sorted(draw.sample(range(1, len(samples)), min(kills, len(samples) - 1)))
    journal = Journal()
    with small_cell(folder) as cell:
        cell.simulate()
        cell.fork_daemon()
        journal.watch(cell)
        go(cell)
        for number in numbers:
            wait_until(partial(reached, cell, number), f"sample {number}", 120.0)
            if finished(cell):
                break
            time.sleep(
                draw.uniform(0.0, 0.4)
            )  # another process works meanwhile: in a move, a window, a touch
            kill_and_go_on(cell, journal)
        status = cell.wait_for_state("Completed", "Held", "Aborted", within_s=300.0)
        journal.ending = f"{status['state']}: {status['message']}"
        assert status["state"] in ("Completed", "Held"), journal.ending
        assert cell.console("watch --until-waiting").code != ExitCode.DEFECT
        with cell.store() as store:
            journal.compare(store)
            assert store.verify_chain() is None
            run = store.runs(1)[0]
            assert [r.id for r in store.runs()] == [run.id], "the killed run went on as one run"
            stored = store.samples(run.id)
            for result in store.results(run.id):
                mine = [s.id for s in stored if (s.phase, s.attempt) == (result.phase, result.attempt)]
                assert list(result.sample_ids) == mine, f"{result.phase}: each sample once, and all of them"
            plate = [s.utc_s for s in stored if s.kind == "laser" and s.payload["object"] == "plate"]
            journal.references = references_came_first(
                store.events(), [sample.utc_s for sample in stored], plate
            )
            verdicts = {result.phase: result.verdict for result in store.results(run.id)}
    return journal, verdicts


def reached(cell: WireCell, samples: int) -> bool:
    return finished(cell) or count(cell) >= samples


def finished(cell: WireCell) -> bool:
    return cell.status()["state"] in ("Completed", "Held", "Aborted")


def count(cell: WireCell) -> int:
    with cell.store() as store:
        runs = store.runs(1)
        return len(store.samples(runs[0].id)) if runs else 0


def not_better(verdicts: dict[str, str], reference: dict[str, str]) -> bool:
    return all(
        SEVERITY.index(verdicts.get(phase, "Undefined")) >= SEVERITY.index(verdict)
        for phase, verdict in reference.items()
    )


@pytest.fixture(scope="module")
def undisturbed(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[list[str], dict[str, str]]]:
    yield uninterrupted(tmp_path_factory.mktemp("whole"))


def test_thirty_kills(tmp_path: Path, undisturbed: tuple[list[str], dict[str, str]]) -> None:
    samples, reference = undisturbed
    journal, verdicts = killed(tmp_path, samples, KILLS, seed=20261)
    assert len(journal.where) >= KILLS - 2, journal.ending
    assert set(journal.where) >= set(samples), "every phase was hit"
    assert journal.references >= KILLS // 2
    assert not_better(verdicts, reference)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", CAMPAIGN_SEEDS)
def test_three_hundred_kills(
    tmp_path: Path, undisturbed: tuple[list[str], dict[str, str]], seed: int
) -> None:
    """Six jobs of 55 kills each; prints what docs/evidence.md tells. Minutes each: pick some with -k."""
    samples, reference = undisturbed
    journal, verdicts = killed(tmp_path, samples, KILLS_IN_ONE_JOB, seed)
    places = ", ".join(f"{phase} {journal.where.count(phase)}" for phase in dict.fromkeys(journal.where))
    print(
        f"seed {seed}: {len(journal.where)} kills ({places}); {len(journal.samples)} samples acknowledged, "
        f"none lost or twice; at rest within {journal.slowest_rest_s:.2f} s, allowed {REST_S:g} s; "
        f"{journal.references} restarts with the known points first"
    )
    assert len(journal.where) >= KILLS_IN_ONE_JOB - 5, journal.ending
    assert not_better(verdicts, reference)
