"""The conformance kit on real ports: each device in a process of its own, through all that can befall it."""

import contextlib
from pathlib import Path

import pytest

from drivers.capabilities import Identity
from estimation.errors import DeviceError, IdentityMismatch
from tests.conformance.pairs import PAIRS, Pair
from tests.conformance.processes import ProcessRig, process_rig

pytestmark = pytest.mark.wire
QUICK = ("canopen-402", "melfa-tcp", "optoncdt-1420", "riftek-modbus", "adam-6052")


def by_name(pair: Pair) -> object:
    """One of each kind of link in CI."""
    return pytest.param(pair, id=pair.kind, marks=[] if pair.kind in QUICK else pytest.mark.campaign)


@pytest.fixture(params=[by_name(pair) for pair in PAIRS])
def pair(request: pytest.FixtureRequest) -> Pair:
    found: Pair = request.param
    return found


def test_a_day_of_a_device(pair: Pair, tmp_path: Path) -> None:
    with process_rig(pair, tmp_path) as rig:
        identity = normal_work(rig)
        restart_in_mid_session(rig, identity)
        unplugged_and_back(rig, identity)
        another_in_its_place(rig, identity)


def normal_work(rig: ProcessRig) -> Identity:
    identity = rig.connect()
    assert identity.model
    for _ in range(3):
        rig.work()
    health = rig.driver.health()
    assert health.frames > 0 and (health.bad_frames, health.timeouts) == (0, 0)
    return identity


def restart_in_mid_session(rig: ProcessRig, identity: Identity) -> None:
    """While it boots, a connection works or is refused; once it has booted, a new one heals."""
    rig.control("restart")
    with contextlib.suppress(DeviceError):
        rig.work()  # whether or not it can go on, no value is wrong
    with contextlib.suppress(DeviceError):
        rig.release()
        rig.connect()
    assert rig.heal() == identity


def unplugged_and_back(rig: ProcessRig, identity: Identity) -> None:
    """It is missed at once, and found again: at its address, or as another port that fits."""
    rig.control("unplug")
    with pytest.raises(DeviceError):
        rig.work()
    with pytest.raises(DeviceError, match=r"is there|refuses"):
        rig.connect()
    moved = {} if rig.search is None else {"port": renamed(rig)}
    rig.control("plug", **moved)
    assert rig.heal() == identity


def renamed(rig: ProcessRig) -> str:
    """What was laser0 is laser1 now."""
    return str(rig.control()["where"][""])[:-1] + "1"


def another_in_its_place(rig: ProcessRig, identity: Identity) -> None:
    rig.control("swap")
    try:
        assert rig.connect() != identity  # where no expected identity was given, the cell compares
    except IdentityMismatch:
        return
