"""Whole jobs in the deterministic cell: released when honest, never when something is wrong."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.packml import Command, State
from tests.support.deterministic import DeterministicCell, edited_cell

MM, DEG = 1e-3, np.pi / 180.0
TIGHT = ('limit = "0.40 mm"\ngated_points', 'limit = "0.08 mm"\ngated_points')


@pytest.fixture
def make(tmp_path: Path) -> Iterator[list[DeterministicCell]]:
    """Cells made by the test, closed at its end."""
    cells: list[DeterministicCell] = []
    yield cells
    for cell in cells:
        cell.close()


def _once(cell: DeterministicCell, phase: str, activity: str, step: int, act: Callable[[], None]) -> None:
    """Let something happen in the simulated world, once, at a progress event."""
    done: list[bool] = []

    def listen(event: dict[str, Any]) -> None:
        there = event.get("phase") == phase and event.get("activity") == activity
        if there and event.get("step", step) >= step and not done:
            done.append(True)
            act()

    cell.engine.subscribe(listen)


def _unplug_laser(cell: DeterministicCell) -> None:
    cell.world.laser_link.unplugged = True


BUMPS = {
    "x": (np.array([0.5 * MM, 0, 0]), np.zeros(3)),
    "y": (np.array([0, 0.5 * MM, 0]), np.zeros(3)),
    "z": (np.array([0, 0, 0.5 * MM]), np.zeros(3)),
    "tilt about x": (np.zeros(3), np.array([0.3 * DEG, 0, 0])),
    "tilt about y": (np.zeros(3), np.array([0, 0.3 * DEG, 0])),
}


@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("bump", BUMPS)
def test_a_bumped_laser_is_held_at_the_check_and_never_released(
    bump: str, seed: int, make: list[DeterministicCell]
) -> None:
    make.append(cell := DeterministicCell(seed))
    _once(cell, "hand-eye", "gated", 0, lambda: cell.world.world.bump_laser(*BUMPS[bump]))
    assert cell.run() is State.HELD
    results = cell.results()
    assert results["hand-eye"].verdict == "OK"
    assert results["hand-eye check"].verdict == "NotDecidable"
    assert "laser" in cell.engine.status()["fault"]["text"]
    assert "localize" not in results
    assert not cell.released


def test_a_noisy_joint_is_named(make: list[DeterministicCell]) -> None:
    make.append(cell := DeterministicCell(1, "noisy-joint"))
    assert cell.run() is State.HELD
    assert cell.results()["noise"].verdict == "NotDecidable"
    fault = cell.engine.status()["fault"]
    assert "joint 4" in fault["text"] and "deg" in fault["text"]
    assert fault["remedy"]


def test_a_pulled_cable_holds_and_the_job_goes_on_after_unhold(make: list[DeterministicCell]) -> None:
    make.append(cell := DeterministicCell(1))
    _once(cell, "localize", "acquiring", 20, lambda: _unplug_laser(cell))
    assert cell.run() is State.HELD
    assert cell.engine.status()["fault"]["code"].startswith(("L", "D"))
    before = [s.id for s in cell.store.samples(1)]
    assert cell.command(Command.UNHOLD) is State.HELD  # still unplugged: the reconnect says so
    cell.world.laser_link.unplugged = False
    assert cell.command(Command.UNHOLD) is State.COMPLETED
    assert cell.released
    after = cell.store.samples(1)
    assert [s.id for s in after][: len(before)] == before
    steps = [(s.phase, s.attempt, s.step) for s in after]
    assert len(steps) == len(set(steps))
    assert any(event.kind == "reference" for event in cell.store.events())


def test_a_sample_marked_while_the_job_runs_is_taken_again(make: list[DeterministicCell]) -> None:
    make.append(cell := DeterministicCell(1))

    def mark() -> None:
        third, fifth = (s for s in cell.store.samples(1, "localize") if s.step in (3, 5))
        cell.store.retake(third.id, "somebody leaned on the table", "Ada")
        cell.store.exclude(fifth.id, "chip on the face", "Ada")

    _once(cell, "localize", "acquiring", 20, mark)
    assert cell.run() is State.COMPLETED and cell.released
    attempts = [s for s in cell.store.samples(1, "localize", include_excluded=True) if s.step in (3, 5)]
    assert [(s.step, s.mark) for s in attempts] == [(3, "retake"), (5, "excluded"), (3, None)]
    used = cell.results()["localize"].sample_ids
    assert [s.id in used for s in attempts] == [False, False, True]


def test_a_missing_part_suspends_and_the_job_goes_on_when_it_is_there(make: list[DeterministicCell]) -> None:
    make.append(cell := DeterministicCell(1, "part-missing"))
    assert cell.run() is State.SUSPENDED
    fault = cell.engine.status()["fault"]
    assert fault["code"] == "P1" and "part" in fault["text"].lower()
    cell.world.world.part_present = True
    assert cell.command(Command.UNSUSPEND) is State.COMPLETED
    assert cell.released


def test_a_limit_that_cannot_be_met_is_refused_before_any_motion(
    tmp_path: Path, make: list[DeterministicCell]
) -> None:
    make.append(cell := DeterministicCell(1, cell_path=edited_cell(tmp_path / "cell", TIGHT)))
    assert cell.run() is State.HELD
    fault = cell.engine.status()["fault"]
    assert "best reachable" in fault["text"] and "0.08 mm" in fault["text"] and "%" in fault["text"]
    assert cell.motion_frames() == 0
    assert cell.world.clock.now_s() == 0.0


def test_an_expired_certificate_is_refused_before_any_motion(
    tmp_path: Path, make: list[DeterministicCell]
) -> None:
    expired = (
        'certificate = "BAR-0417"\ncertified = 2026-03-02\nvalid_to = 2028-03-01',
        'certificate = "BAR-0417"\ncertified = 2025-03-02\nvalid_to = 2026-03-01',
    )
    make.append(cell := DeterministicCell(1, cell_path=edited_cell(tmp_path / "cell", expired)))
    assert cell.run() is State.HELD
    fault = cell.engine.status()["fault"]
    assert "BAR-0417 of the bar held until 2026-03-01" in fault["text"]
    assert "calibrated again" in fault["remedy"]
    assert cell.motion_frames() == 0


@pytest.mark.parametrize(("expires", "attempts"), [("30 days", 1), ("30 s", 2)])
def test_an_expired_hand_eye_is_measured_again_and_all_that_rests_on_it(
    expires: str, attempts: int, tmp_path: Path, make: list[DeterministicCell]
) -> None:
    edit = ('expires = "30 days"', f'expires = "{expires}"')
    make.append(cell := DeterministicCell(1, cell_path=edited_cell(tmp_path / "cell", edit)))
    _once(cell, "part check", "acquiring", 3, lambda: cell.engine.submit(Command.HOLD, "test"))
    assert cell.run() is State.HELD
    assert cell.command(Command.UNHOLD) is State.COMPLETED
    assert cell.results()["noise"].attempt == 1
    assert [cell.results()[phase].attempt for phase in ("hand-eye", "hand-eye check", "localize")] == (
        [attempts] * 3
    )
    assert any(event.kind == "expired" for event in cell.store.events()) is (attempts == 2)
