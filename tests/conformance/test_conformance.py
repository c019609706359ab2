"""What every driver does with every device, in virtual time: the conformance kit. Its table is `pairs.py`."""

from pathlib import Path

import pytest

from estimation.errors import DeviceError, IdentityMismatch
from simulators.registry import DEVICES
from tests.conformance.pairs import PAIRS, Pair
from tests.conformance.refusals import REFUSALS, Refusal, says
from tests.conformance.rig import Rig
from tests.conformance.sessions import FAULTS, play

LATE_S = 0.05


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: pair.kind)
class TestConformance:
    def test_normal_work(self, pair: Pair) -> None:
        rig = Rig(pair)
        identity = rig.driver.connect()
        assert identity.model
        for _ in range(3):
            rig.work()
        health = rig.driver.health()
        assert health.frames > 0 and (health.bad_frames, health.timeouts) == (0, 0)
        rig.driver.close()
        rig.driver.close()

    def test_work_before_connect_is_refused(self, pair: Pair) -> None:
        with pytest.raises(DeviceError):
            Rig(pair).work()

    def test_a_restart_is_noticed_and_a_new_connection_heals_it(self, pair: Pair) -> None:
        rig = Rig(pair)
        rig.driver.connect()
        rig.work()
        assert rig.device.restart is not None
        rig.device.restart(rig.clock.now_s())
        rig.timed_work()  # whether or not it can go on, no value is wrong
        rig.heal()

    def test_unplugged_says_so_at_once_and_heals(self, pair: Pair) -> None:
        rig = Rig(pair)
        rig.driver.connect()
        rig.unplug(True)
        with pytest.raises(DeviceError, match="is gone"):
            rig.work()
        with pytest.raises(DeviceError, match="is gone"):
            rig.driver.connect()
        rig.unplug(False)
        rig.heal()

    def test_another_device_in_its_place_is_refused_or_has_another_identity(self, pair: Pair) -> None:
        rig = Rig(pair)
        identity = rig.driver.connect()
        rig.swap()
        try:
            other = rig.driver.connect()
        except IdentityMismatch:
            return
        assert other != identity  # where no expected identity was given, the cell compares

    def test_silence_is_found_within_the_budget(self, pair: Pair) -> None:
        rig = Rig(pair)
        rig.driver.connect()
        for link in rig.links:
            link.faults.add("drop")
        assert not rig.timed_work()
        for link in rig.links:
            link.faults.clear()
        rig.heal()

    @pytest.mark.parametrize("fault", FAULTS)
    def test_no_value_is_wrong_whatever_the_wire_does(self, pair: Pair, fault: str) -> None:
        if fault in pair.unseen:
            pytest.skip(f"{pair.kind}, {fault}: {pair.unseen[fault]}")
        play(pair, 7, [fault], 0.05, min(LATE_S, pair.latest_s))


@pytest.mark.parametrize(
    ("pair", "refusal"),
    [
        pytest.param(pair, refusal, id=f"{pair.kind}: {refusal.name}")
        for pair in PAIRS
        for refusal in REFUSALS[pair.kind]
    ],
)
def test_every_error_answer_is_said_and_heals(pair: Pair, refusal: Refusal) -> None:
    rig = Rig(pair)
    rig.driver.connect()
    rig.work()
    rig.refusal = refusal
    with pytest.raises(DeviceError) as raised:
        rig.driver.connect() if refusal.at_connect else rig.work()
    assert says(refusal, str(raised.value)), str(raised.value)
    rig.refusal = None
    rig.heal()


def test_the_guide_states_how_soon_faults_are_noticed() -> None:
    lines = Path("docs/devices.md").read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("| Device | Answers late"))
    rows = [line.strip("| ").split(" | ") for line in lines[start + 2 : start + 2 + len(PAIRS)]]
    assert rows == [[f"`{p.kind}`", f"{p.latest_s:g}", f"{p.budget_s:g}"] for p in PAIRS]
    assert not lines[start + 2 + len(PAIRS)]


def test_every_simulated_device_has_a_driver_in_the_table() -> None:
    assert {pair.kind for pair in PAIRS} == set(DEVICES)
