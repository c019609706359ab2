"""The MELFA driver against the simulated controller, in virtual time."""

from pathlib import Path

import numpy as np
import pytest

from drivers.capabilities import StopWay
from drivers.robots.melfa_codec import MelfaRefusal
from estimation.errors import DeviceError, IdentityMismatch
from tests.drivers.robots.rig import MELFA_SERIAL, MELFA_TCP, RobotRig

DEG = np.pi / 180


@pytest.fixture(params=[MELFA_TCP, MELFA_SERIAL], ids=["tcp", "serial"])
def rig(request: pytest.FixtureRequest, cache: Path) -> RobotRig:
    rig = RobotRig(cache, request.param)
    identity = rig.robot.connect()
    assert (identity.model, identity.serial_number) == ("RV-4FL-D", "AC0512034")
    return rig


def test_readings_while_moving_are_paced(rig: RobotRig) -> None:
    """100 ms between an answer and the next command while something runs: the driver keeps to it."""
    sent = list[tuple[float, bytes]]()
    link = rig.link()
    write = link.write
    link.write = lambda data: (sent.append((rig.clock.now_s(), data)), write(data))[1]  # type: ignore[method-assign]
    rig.robot.move_joints(rig.truth_rad() + 30 * DEG)
    moved = [time_s for time_s, data in sent if b"DSTATE" in data]
    assert len(moved) >= 3
    assert np.diff(moved[:-1]).min() >= 0.1


def test_the_way_to_stop_is_declared(cache: Path) -> None:
    assert RobotRig(cache, MELFA_TCP).robot.abilities.stop is StopWay.AT_ONCE
    one_session = {key: value for key, value in MELFA_TCP.items() if key != "stop_port"}
    assert RobotRig(cache, one_session).robot.abilities.stop is StopWay.NEXT
    assert RobotRig(cache, MELFA_SERIAL).robot.abilities.stop is StopWay.NEXT


def test_an_error_of_the_controller_is_named(rig: RobotRig) -> None:
    rig.arm.fault(0, 2603, rig.clock.now_s())
    with pytest.raises(DeviceError, match=r"error 2603 \(way leads beyond the limits\)"):
        rig.robot.move_joints(rig.truth_rad() + 1 * DEG)
    rig.robot.connect()  # resets
    rig.robot.move_joints(rig.truth_rad() + 1 * DEG)


def test_another_robot_is_refused(cache: Path) -> None:
    rig = RobotRig(cache, MELFA_TCP | {"model": "RV-7FRL-D"})
    with pytest.raises(IdentityMismatch, match=r"'RV-4FL-D', the cell file 'RV-7FRL-D'"):
        rig.robot.connect()


def test_the_right_that_somebody_else_holds_is_named(cache: Path) -> None:
    rig = RobotRig(cache, MELFA_TCP)
    other = rig.arm.connections()["stop"]()
    other.receive(b"1;1;CNTLON\r", 0.0)
    with pytest.raises(MelfaRefusal, match=r"CNTLON: error 6020 \(no operation right\)"):
        rig.robot.connect()


@pytest.mark.parametrize("end", ["CR LF", "none"])
def test_other_terminators(cache: Path, end: str) -> None:
    from dataclasses import replace

    rig = RobotRig(cache, MELFA_TCP | {"terminator": end})
    wire = b"\r\n" if end == "CR LF" else b""
    rig.arm.settings = replace(rig.arm.settings, terminator=wire)  # type: ignore[attr-defined]
    rig.robot.connect()
    rig.robot.move_joints(rig.truth_rad() + 1 * DEG)
    rig.robot.close()
    rig.robot.close()


def test_a_line_that_never_falls_silent_is_given_up(rig: RobotRig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise without an end in place of an answer keeps neither the question waiting nor a stop behind it."""
    link, asked = rig.link(), list[bytes]()

    def noisy(timeout_s: float) -> bytes:
        rig.clock.sleep(0.01)
        if rig.clock.now_s() > begun_s + 30.0:
            pytest.fail("still waiting after 30 s")
        return b"\x7f" if asked else b""

    monkeypatch.setattr(link, "write", asked.append)
    monkeypatch.setattr(link, "read", noisy)
    begun_s = rig.clock.now_s()
    with pytest.raises(DeviceError):
        rig.robot.read_joints(1)
    assert rig.clock.now_s() - begun_s < 10.0
