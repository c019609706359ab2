"""SDO without threads: worked frames, refusals, silence, and answers that come late."""

from collections.abc import Callable

import pytest

from drivers.links.canopen_sdo import SdoAbort, SdoPort
from estimation.errors import DeviceTimeout
from tests.drivers.fakes import FakeArmLink, VirtualClock


def port_on(link: FakeArmLink) -> SdoPort:
    """What the master does for its SDO port, and nothing else."""
    port: SdoPort

    def pump(timeout_s: float, done: Callable[[], bool]) -> None:
        deadline_s = link.clock.time_s + timeout_s
        while not done() and link.clock.time_s < deadline_s:
            for frame in link.receive(deadline_s - link.clock.time_s):
                if 0x580 < frame.can_id < 0x600:
                    port.deliver(frame.can_id, frame.data, frame.time_s)

    port = SdoPort(link, [3, 4], pump, 0.3)
    return port


def answering(answers: dict[str, str]) -> tuple[SdoPort, FakeArmLink]:
    link = FakeArmLink(VirtualClock(), nodes=(3,))
    link.drives[3].sdo = lambda request: bytes.fromhex(answers[request.hex(" ").upper()])  # type: ignore[method-assign]
    return port_on(link), link


def test_worked_write() -> None:
    port, link = answering({"2F 60 60 00 07 00 00 00": "60 60 60 00 00 00 00 00"})
    port.write(3, 0x6060, 0, 7, 1)
    assert link.sent == [(0x603, bytes.fromhex("2F 60 60 00 07 00 00 00"))]


def test_worked_read() -> None:
    port, link = answering({"40 41 60 00 00 00 00 00": "4B 41 60 00 37 02 00 00"})
    assert port.read_int(3, 0x6041) == 0x0237
    assert link.sent == [(0x603, bytes.fromhex("40 41 60 00 00 00 00 00"))]


def test_worked_abort() -> None:
    port, _ = answering({"40 99 60 00 00 00 00 00": "80 99 60 00 00 00 02 06"})
    with pytest.raises(
        SdoAbort, match=r"Node 3 object 6099h:0: .* 06020000h \(Object does not exist\)"
    ) as abort:
        port.read(3, 0x6099)
    assert abort.value.is_missing


def test_worked_network_commands() -> None:
    link = FakeArmLink(VirtualClock())
    port_on(link).send_nmt(0x01, 3)
    port_on(link).send_nmt(0x80)
    assert link.sent == [(0x000, b"\x01\x03"), (0x000, b"\x80\x00")]


def test_texts_come_in_segments() -> None:
    port, _ = answering(
        {
            "40 08 10 00 00 00 00 00": "41 08 10 00 0C 00 00 00",
            "60 00 00 00 00 00 00 00": "00 50 52 42 54 20 6A 6F",
            "70 00 00 00 00 00 00 00": "15 69 6E 74 20 31 00 00",
        }
    )
    assert port.read(3, 0x1008) == b"PRBT joint 1"


def test_silence_is_a_timeout_that_names_node_and_object() -> None:
    link = FakeArmLink(VirtualClock())
    link.drives[4].silent = True
    with pytest.raises(
        DeviceTimeout, match=r"Node 4 object 6041h:0: no valid answer within 0.3 s, 2 attempts"
    ):
        port_on(link).read(4, 0x6041)


def test_a_late_acknowledge_is_not_taken_for_the_next_write() -> None:
    """The library checks the object of an answer for reads only: our client checks it for writes too."""
    link = FakeArmLink(VirtualClock(), nodes=(3,))
    port, drive = port_on(link), link.drives[3]
    real = drive.sdo
    drive.sdo = lambda request: b""  # type: ignore[method-assign]
    stale = bytes.fromhex("60 60 60 00 00 00 00 00")  # of an earlier write to 6060h
    link.later(0.01, 0x583, stale)
    with pytest.raises(DeviceTimeout):
        port.write(3, 0x6083, 0, 1000, 4)
    drive.sdo = real  # type: ignore[method-assign]
    port.write(3, 0x6083, 0, 1000, 4)


def test_one_lost_answer_is_asked_for_again() -> None:
    link = FakeArmLink(VirtualClock(), nodes=(3,))
    real, asked = link.drives[3].sdo, list[bytes]()

    def lossy(request: bytes) -> bytes:
        asked.append(request)
        return real(request) if len(asked) > 1 else b""

    link.drives[3].sdo = lossy  # type: ignore[method-assign]
    assert port_on(link).read_int(3, 0x1000) == 0x20192
