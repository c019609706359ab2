"""Real links on pseudo-terminals and loopback TCP."""

import gc
import socket
import threading
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest

from drivers.capabilities import Devices, Identity, LinkHealth
from drivers.clock import RealClock
from drivers.links.can_bus import PythonCanLink, is_whole
from drivers.links.ports import RealPorts
from drivers.links.serial_port import SerialLink
from drivers.links.tcp import TcpLink
from drivers.probes.adam6052 import AdamProbe, ProbeConfig
from drivers.robots.canopen_arm import CanopenArm
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch, MotionStopped
from tests.drivers.robots.test_canopen_arm import CONFIG, DEG
from tests.drivers.wires import SlcanDongle, pseudo_terminal, tcp_device

pytestmark = pytest.mark.wire


def read_exactly(link: SerialLink | TcpLink, count: int) -> bytes:
    received = b""
    while len(received) < count and (data := link.read(5.0)):
        received += data
    return received


def test_serial_carries_bytes_both_ways() -> None:
    with pseudo_terminal() as port:
        port.on_data = lambda data: port.write(data.upper())
        link = SerialLink(port.path, 921600)
        link.reopen()
        link.write(b"getinfo")
        assert read_exactly(link, 7) == b"GETINFO"
        assert link.read(0.0) == b""
        link.close()
        link.close()


def test_serial_keeps_more_than_the_kernel_does() -> None:
    with pseudo_terminal() as port:
        link = SerialLink(port.path, 921600)
        link.reopen()
        sent = bytes(range(256)) * 200  # 50 kB, nobody reads yet
        for start in range(0, len(sent), 1024):
            port.write(sent[start : start + 1024])
        assert read_exactly(link, len(sent)) == sent
        link.close()


def test_serial_port_has_one_user() -> None:
    with pseudo_terminal() as port:
        first, second = SerialLink(port.path, 9600), SerialLink(port.path, 9600)
        first.reopen()
        with pytest.raises(DeviceError, match="cannot be opened") as refused:
            second.reopen()
        assert "Another program uses it" in refused.value.remedy
        first.close()
        second.reopen()
        second.close()


def test_missing_port_is_named_with_a_remedy() -> None:
    for link in (SerialLink("run/nowhere", 9600), PythonCanLink("slcan", "run/nowhere")):
        with pytest.raises(DeviceError, match="Port run/nowhere cannot be opened") as missing:
            link.reopen()
        assert "Plug the device in" in missing.value.remedy
        with pytest.raises(DeviceError, match="not open"):
            link.read(0.0) if isinstance(link, SerialLink) else link.receive(0.0)


def test_unplugged_serial_port_is_told_and_can_be_opened_again() -> None:
    with pseudo_terminal() as port, pseudo_terminal() as other:
        link = SerialLink(port.path, 9600)
        link.reopen()
        port.unplug()
        link.discard_input()  # the flush fails with an error of its own kind: not ours to raise here
        with pytest.raises(DeviceError, match="is gone"):
            link.read(5.0)
        link.port = other.path
        link.reopen()
        other.write(b"back")
        assert read_exactly(link, 4) == b"back"
        link.close()


def test_slcan_carries_frames_and_counts_malformed_lines() -> None:
    with pseudo_terminal() as port:
        sent, complete = bytearray(), threading.Event()

        def take(data: bytes) -> None:
            sent.extend(data)
            if b"t60384041600000000000\r" in sent:
                complete.set()

        port.on_data = take
        link = PythonCanLink("slcan", port.path)
        link.reopen()
        link.send(0x603, bytes.fromhex("4041600000000000"))
        assert complete.wait(5.0)
        for line in (b"t1836371", b"tXYZ1", b"t\xff\xfe", b"z", b"t18363712"):
            port.write(line + b"\r")
        port.write(b"\x07" + b"t1836371200010000\r")
        (frame,) = link.receive(5.0)
        assert (frame.can_id, frame.data) == (0x183, bytes.fromhex("371200010000"))
        assert link.bad_frames == 4
        assert not link.receive(0.0)
        port.unplug()
        with pytest.raises(DeviceError, match="is gone"):
            while True:
                link.receive(1.0)
        link.close()


def test_a_dongle_in_use_hears_nothing_of_a_second_master(caplog: pytest.LogCaptureFixture) -> None:
    """It would close the bus of the first one, under a moving arm."""
    with pseudo_terminal() as port:
        heard, opened, sent = bytearray(), threading.Event(), threading.Event()

        def take(data: bytes) -> None:
            heard.extend(data)
            for end, event in ((b"O\rO\r", opened), (b"t0800\r", sent)):  # python-can opens twice
                if heard.endswith(end):
                    event.set()

        port.on_data = take
        first, second = PythonCanLink("slcan", port.path), PythonCanLink("slcan", port.path)
        first.reopen()
        assert opened.wait(5.0)
        before = bytes(heard)
        with pytest.raises(DeviceError, match="Another program uses it"):
            second.reopen()
        gc.collect()
        first.send(0x80, b"")
        assert sent.wait(5.0)
        assert bytes(heard) == before + b"t0800\r"
        assert not caplog.records
        first.close()


def test_no_slcan_line_with_a_lost_or_doubled_byte_is_taken() -> None:
    for frame in ("t1830\r", "t194101\r", "t1836371200010000\r", "t59484F00600101000000\r"):
        assert is_whole(frame)
        assert not is_whole(frame[:-1] + frame)  # the CR between two lines
        for at in range(1, len(frame) - 1):
            assert not is_whole(frame[:at] + frame[at + 1 :])
            assert not is_whole(frame[:at] + frame[at] + frame[at:])


def test_unknown_can_interface_is_refused() -> None:
    with pytest.raises(DeviceError, match="'pcan'"):
        PythonCanLink("pcan", "x")


def test_arm_behind_a_dongle_moves_and_its_heart_beats_meanwhile() -> None:
    with pseudo_terminal() as port:
        dongle = SlcanDongle(port)
        arm = CanopenArm(PythonCanLink("slcan", port.path), CONFIG, RealClock())
        arm.connect()
        target = np.full(6, 1.0) * DEG
        arm.move_joints(target)
        assert arm.read_joints(2).joints_rad == pytest.approx(np.tile(target, (2, 1)), abs=0.01 * DEG)
        with dongle.lock:
            before, beat = dongle.arm.syncs, threading.Event()
            dongle.arm.on_sync = lambda number: beat.set() if number > before + 20 else None
            dongle.arm.sent.clear()
        assert beat.wait(10.0)  # nobody asks the driver for anything: the keeper does it
        with dongle.lock:
            assert (0x701, b"\x05") in dongle.arm.sent
            assert dongle.arm.drives[3].objects[0x1016, 1] != bytes(4)
        port.write(b"t18G\r")
        arm.read_joints(5)
        assert arm.health().bad_frames >= 1
        arm.close()
        with dongle.lock:
            assert all(drive.statusword & 0x6F == 0x40 for drive in dongle.arm.drives.values())


def test_stop_from_another_thread_ends_a_real_move() -> None:
    with pseudo_terminal() as port:
        dongle = SlcanDongle(port)
        arm = CanopenArm(PythonCanLink("slcan", port.path), CONFIG, RealClock())
        arm.connect()
        with dongle.lock:
            begun = dongle.arm.syncs
        stopper = threading.Thread(target=arm.stop)

        def stop_in_mid_move(number: int) -> None:
            if number == begun + 20:
                stopper.start()

        dongle.arm.on_sync = stop_in_mid_move
        with pytest.raises(MotionStopped):
            arm.move_joints(np.full(6, 100.0) * DEG)
        stopper.join()
        assert arm.is_at_rest()
        with dongle.lock:
            assert all(drive.quick_stops == 1 for drive in dongle.arm.drives.values())
        arm.close()


def test_unplugged_dongle_is_told() -> None:
    with pseudo_terminal() as port:
        SlcanDongle(port)
        arm = CanopenArm(PythonCanLink("slcan", port.path), CONFIG, RealClock())
        arm.connect()
        port.unplug()
        with pytest.raises(DeviceError):
            arm.read_joints(1000)
        arm.close()


def serve_probe(connection: socket.socket) -> None:
    """An ADAM-6052 with nothing touching, as far as the driver asks."""
    while request := connection.recv(260):
        function, address = request[7], int.from_bytes(request[8:10], "big")
        payload = b"\1\0" if function == 2 else b"\4\x60\x52\0\0" if address == 210 else b"\4\0\0\0\0"
        connection.sendall(request[:4] + (2 + len(payload)).to_bytes(2, "big") + request[6:8] + payload)


def test_probe_over_tcp() -> None:
    with tcp_device(serve_probe) as port:
        probe = AdamProbe(TcpLink("127.0.0.1", port), ProbeConfig(reply_timeout_s=5.0), RealClock())
        probe.connect()
        probe.arm()
        assert probe.touched_at_s() is None
        assert probe.is_open()
        probe.close()
        probe.close()


def test_tcp_refused_closed_and_half_open() -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        free = unused.getsockname()[1]
    with pytest.raises(DeviceError, match=f"refuses connections to port {free}"):
        TcpLink("127.0.0.1", free).reopen()
    with tcp_device(lambda connection: connection.sendall(b"bye")) as port:
        link = TcpLink("127.0.0.1", port)
        link.reopen()
        assert read_exactly(link, 3) == b"bye"
        with pytest.raises(DeviceError, match="closed by the device"):
            link.read(5.0)
        link.close()
    silent = threading.Event()
    with tcp_device(lambda connection: bool(silent.wait(30.0))) as port:
        probe = AdamProbe(TcpLink("127.0.0.1", port), ProbeConfig(reply_timeout_s=0.05), RealClock())
        with pytest.raises(DeviceTimeout, match="no answer within"):
            probe.connect()
        probe.close()
        silent.set()


def test_bus_off_and_stray_frames_on_socketcan() -> None:
    """No CAN in every kernel: the bus object is a stand-in, the frames are those of SocketCAN."""
    frames = [
        can.Message(arbitration_id=0x204, is_error_frame=True, is_extended_id=False),  # error passive
        can.Message(arbitration_id=0x183, is_extended_id=True, data=b"\x01"),
        can.Message(arbitration_id=0x183, is_extended_id=False, is_remote_frame=True),
        can.Message(arbitration_id=0x183, is_extended_id=False, data=b"\x02"),
        can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False),
    ]
    link = PythonCanLink("socketcan", "can0")
    link._bus = SimpleNamespace(recv=lambda timeout: frames.pop(0), shutdown=lambda: None)
    (frame,) = link.receive(1.0)
    assert frame.data == b"\x02"
    with pytest.raises(DeviceError, match="CAN bus can0 is off") as error:
        link.receive(1.0)
    assert "termination" in error.value.remedy.lower()
    assert link.bad_frames == 2
    link.close()


class _Answers:
    """A device that is the expected one at one port."""

    def __init__(self, link: SerialLink, serial_numbers: dict[str, str]) -> None:
        self._link, self._serial_numbers, self.closed = link, serial_numbers, 0

    def connect(self) -> Identity:
        self._link.reopen()
        found = self._serial_numbers[self._link.port]
        if found != "17":
            raise IdentityMismatch(f"Serial number {found}, not 17", "Calibrate again")
        return Identity("laser", found, "")

    def health(self) -> LinkHealth:
        raise NotImplementedError

    def close(self) -> None:
        self._link.close()
        self.closed += 1


def test_a_device_is_found_by_its_identity_at_whatever_port_fits(tmp_path: Path) -> None:
    with pseudo_terminal() as first, pseudo_terminal() as second:
        for number, port in enumerate((first, second)):
            (tmp_path / f"ttyUSB{number}").symlink_to(port.path)
        ports = RealPorts(tmp_path, RealClock())
        link = ports.serial("laser", "ttyUSB*", 9600)
        there = {str(tmp_path / "ttyUSB0"): "4", str(tmp_path / "ttyUSB1"): "17"}
        device = _Answers(link, there)
        devices = Devices(device, device, device, ports.searches)  # type: ignore[arg-type]
        search = ports.searches["laser"]
        assert search.connect(device).serial_number == "17"
        assert link.port == str(tmp_path / "ttyUSB1") and device.closed == 1
        assert search.candidates()[0] == str(tmp_path / "ttyUSB1")  # where it was is tried first
        there[str(tmp_path / "ttyUSB1")], there[str(tmp_path / "ttyUSB0")] = "4", "17"
        assert devices.connect(devices.laser).serial_number == "17"
        there[str(tmp_path / "ttyUSB0")] = "5"
        with pytest.raises(DeviceError, match=r"None of the ports .*ttyUSB\* has the device") as missing:
            search.connect(device)
        assert "ttyUSB0: Serial number 5, not 17; ttyUSB1: Serial number 4" in str(missing.value)
        link.close()
    for name in ("ttyUSB0", "ttyUSB1"):
        (tmp_path / name).unlink()
    with pytest.raises(DeviceError, match=r"No port .*ttyUSB\* is there. Plug the device in"):
        search.connect(device)


@pytest.mark.parametrize(
    ("port", "opened"),
    [
        ("COM3", "COM3"),
        ("com12", "com12"),
        (r"\\.\COM12", r"\\.\COM12"),
        ("/dev/ttyUSB0", "/dev/ttyUSB0"),
        (
            "/dev/serial/by-id/usb-FTDI_FT232R_A1-if00-port0",
            "/dev/serial/by-id/usb-FTDI_FT232R_A1-if00-port0",
        ),
        ("run/laser", "/cell/run/laser"),
    ],
)
def test_port_names_of_windows_and_linux(port: str, opened: str) -> None:
    ports = RealPorts(Path("/cell"), RealClock())
    assert ports.serial("laser", port, 9600).port == opened
    assert ports.can_bus("robot", "slcan", port, 500_000).port == opened
    assert ports.can_bus("probe", "socketcan", "can0", 500_000).port == "can0"
    assert ports.tcp("robot", "robot.example", 502).host == "robot.example"
    assert not ports.searches
