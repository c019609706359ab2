"""Clients that others wrote read right values from our simulated sensors, over real ports."""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import canopen
import minimalmodbus
import numpy as np
import pytest
import serial
from canopen.profiles.p402 import BaseNode402
from pyModbusTCP.client import ModbusClient

from estimation.transform import FloatArray
from simulators.modbus_tcp_slave import RegisterConnection
from simulators.probes.adam6052 import FUNCTIONS, Adam6052
from simulators.probes.wago750 import Wago750, WagoSpec
from simulators.registry import device_kind
from simulators.sensors.ams335i import Ams335i, AmsSpec
from simulators.sensors.ft300 import Ft300, Ft300Spec
from simulators.sensors.gocator import Gocator, GocatorSpec
from simulators.sensors.riftek import Rf60x
from simulators.sensors.riftek_head import MODBUS_RTU, RiftekSpec
from simulators.slcan import SlcanDevice
from tests.support.wires import on_serial_port, on_tcp_port

pytestmark = pytest.mark.wire


I8, I16, I32, U8, U16, U32, TEXT = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x09
OBJECTS = {  # what the library must be told of a device
    0x1000: [U32],
    0x1008: [TEXT],
    0x100A: [TEXT],
    0x1017: [U16],
    0x1018: [U8, U32, U32, U32, U32],
    0x6005: [U8],
    0x6000: [U8, U8],
    0x6004: [I32],
    0x2060: [U8, U32],
    0x6040: [U16],
    0x6041: [U16],
    0x6042: [I16],
    0x6060: [I8],
    0x6061: [I8],
    0x6064: [I32],
    0x606B: [I32],
    0x606C: [I32],
    0x607A: [I32],
    0x6081: [U32],
    0x6099: [U32],
    0x60C1: [U8, I32],
    0x6502: [U32],
    **{0x1400 + n: [U8, U32, U8, U16, U8, U16] for n in range(2)},
    **{0x1600 + n: [U8] + [U32] * 8 for n in range(2)},
    **{0x1800 + n: [U8, U32, U8, U16, U8, U16] for n in range(4)},
    **{0x1A00 + n: [U8] + [U32] * 8 for n in range(4)},
}


class Contact:
    """Closed by hand."""

    closed, count = False, 0

    def update(self, time_s: float) -> None:
        pass

    def unchanged_until_s(self, time_s: float) -> float:
        return time_s


class Still:
    """A target at 0.1 m, and a force."""

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        return np.full(len(times_s), 0.1)

    def wrenches(self, times_s: FloatArray) -> FloatArray:
        return np.tile([12.34, -5.67, 98.76, 0.123, -0.456, 1.0], (len(times_s), 1))


def instrument(path: Path, unit: int, baud: int, parity: str) -> minimalmodbus.Instrument:
    port = serial.Serial(str(path), baud, parity=parity, timeout=2.0)
    return minimalmodbus.Instrument(port, unit)


def test_minimalmodbus_reads_the_force_sensor(tmp_path: Path) -> None:
    sensor = Ft300(Ft300Spec(), Still(), np.random.default_rng(1))
    with on_serial_port(tmp_path / "ft", sensor, lambda: sensor.uart.baud):
        client = instrument(tmp_path / "ft", 9, 19200, serial.PARITY_NONE)
        forces = [client.read_register(180 + i, 2, signed=True) for i in range(3)]
        torques = [client.read_register(183 + i, 3, signed=True) for i in range(3)]
        assert forces == [12.34, -5.67, 98.76] and torques == [0.123, -0.456, 1.0]
        assert client.read_string(510, 4).rstrip("\0") == "FTD-0417"
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.read_register(179)
        client.write_registers(410, [0x0200])
        assert sensor.streaming
        client.serial.close()


def test_minimalmodbus_reads_and_sets_the_riftek_laser(tmp_path: Path) -> None:
    spec = RiftekSpec(protocol=MODBUS_RTU)
    head = Rf60x(spec, Still(), 0.0, 0.0, np.random.default_rng(1))
    with on_serial_port(tmp_path / "laser", head, lambda: head.baud):
        client = instrument(tmp_path / "laser", 1, 9600, serial.PARITY_EVEN)
        assert client.read_registers(1, 5, functioncode=4) == [63, 0x90, 17185, 80, 50]
        result = client.read_register(6, functioncode=4)
        assert 80 + result * 50 / 0x4000 == pytest.approx(100.0, abs=0.01)
        client.write_register(15, 4, functioncode=6)
        assert client.read_register(15) == 4
        with pytest.raises(minimalmodbus.SlaveReportedException):
            client.write_register(15, 0, functioncode=6)
        client.serial.close()


def canopen_node(
    path: Path, node: int, kind: type[canopen.RemoteNode] = canopen.RemoteNode
) -> canopen.RemoteNode:
    network = canopen.Network()
    network.connect(interface="slcan", channel=str(path), bitrate=1_000_000, sleep_after_open=0.0)
    dictionary = canopen.ObjectDictionary()
    for index, types in OBJECTS.items():
        record = canopen.objectdictionary.ODRecord(f"{index:04X}", index)
        for sub, type_ in enumerate(types):
            variable = canopen.objectdictionary.ODVariable(f"{index:04X}_{sub}", index, sub)
            variable.data_type = type_
            record.add_member(variable)
        if len(types) == 1:
            dictionary.add_object(record[0])
        else:
            dictionary.add_object(record)
    made = kind(node, dictionary)
    made.sdo.RESPONSE_TIMEOUT = 3.0
    return network.add_node(made)


def test_canopen_reads_the_io_station_and_follows_its_events(tmp_path: Path) -> None:
    contact = Contact()
    station = Wago750(WagoSpec(), contact)
    with on_serial_port(tmp_path / "can", SlcanDevice(station)):
        node = canopen_node(tmp_path / "can", 20)
        assert node.sdo[0x1000].raw & 0xFFFF == 401
        assert node.sdo[0x1018][1].raw == 0x21
        assert node.sdo[0x1008].raw == "750-337"
        node.sdo[0x6005].raw = 1
        node.tpdo[1].read()
        assert [variable.index for variable in node.tpdo[1].map] == [0x6000]
        node.tpdo[1].event_timer = 20
        node.tpdo[1].save()  # by way of "switched off", as the manual demands
        node.sdo[0x1017].raw = 50
        node.nmt.state = "OPERATIONAL"
        assert node.nmt.wait_for_heartbeat(5.0) == "OPERATIONAL"
        assert node.tpdo[1].wait_for_reception(5.0) and node.tpdo[1].map[0].raw == 0
        contact.closed = True
        for _ in range(20):
            if node.tpdo[1].wait_for_reception(5.0) and node.tpdo[1].map[0].raw:
                break
        assert node.tpdo[1].map[0].raw == 1 and node.sdo[0x6000][1].raw == 1
        with pytest.raises(canopen.SdoAbortedError):
            node.sdo[0x6000][1].raw = 0
        node.network.disconnect()


def test_canopen_reads_the_distance_laser(tmp_path: Path) -> None:
    laser = Ams335i(AmsSpec(), Still(), 0.0, 0.0, np.random.default_rng(1))
    with on_serial_port(tmp_path / "can", SlcanDevice(laser)):
        node = canopen_node(tmp_path / "can", 16)
        assert node.sdo[0x1000].raw == 0x00080196
        assert node.sdo[0x6004].raw == 1000  # tenths of a millimetre
        node.tpdo[2].read()
        node.nmt.state = "OPERATIONAL"
        node.sdo[0x1000].raw  # noqa: B018  # answered, so the start has arrived
        node.network.sync.transmit()
        assert node.tpdo[2].wait_for_reception(5.0)
        assert [variable.raw for variable in node.tpdo[2].map] == [1000, 0]
        node.network.disconnect()


def test_canopen_moves_a_joint_of_the_arm(tmp_path: Path) -> None:
    """BaseNode402, with the PDOs that the drive has by itself and the state machine of the library."""
    arm = device_kind("canopen-402").simulated().model
    with on_serial_port(tmp_path / "can", SlcanDevice(arm), update=arm.advance):
        node = canopen_node(tmp_path / "can", 5, BaseNode402)
        assert node.sdo[0x1008].raw == "PRBT" and node.sdo[0x100A].raw.endswith("simulated")
        with pytest.raises(canopen.SdoAbortedError) as aborted:
            _ = node.sdo[0x6099].raw  # it has no homing
        assert aborted.value.code == 0x06020000
        node.nmt.state = "PRE-OPERATIONAL"
        node.setup_402_state_machine()
        assert [variable.index for variable in node.rpdo[1].map] == [0x6040, 0x6042, 0x60C1]
        node.network.sync.start(0.01)
        node.rpdo[1].start(0.01)
        try:
            node.nmt.state = "OPERATIONAL"
            wait_for(lambda: node.state == "SWITCH ON DISABLED")
            node.op_mode = "PROFILED POSITION"
            assert node.is_op_mode_supported("INTERPOLATED POSITION") and node.op_mode == "PROFILED POSITION"
            node.state = "OPERATION ENABLED"
            node.sdo[0x6081].raw = 60_000
            node.sdo[0x607A].raw = 20_000
            node.controlword = 0x1F
            wait_for(lambda: node.statusword & 0x1000)
            node.controlword = 0x0F
            wait_for(lambda: node.statusword & 0x1400 == 0x400)
            assert node.sdo[0x6064].raw == pytest.approx(20_000, abs=10)
            node.sdo[0x1017].raw = 50
            assert node.nmt.wait_for_heartbeat(5.0) == "OPERATIONAL"
            node.state = "SWITCH ON DISABLED"
        finally:
            node.rpdo[1].stop()
            node.network.sync.stop()
            node.network.disconnect()


def wait_for(condition: Callable[[], object]) -> None:
    """The device lives in another thread."""
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline, "not within the time"
        time.sleep(0.005)


def test_pymodbustcp_reads_the_robot_controller() -> None:
    with on_tcp_port(device_kind("igus-irc").simulated().connect[""]) as port:
        client = ModbusClient("127.0.0.1", port, timeout=10.0)
        assert client.read_input_registers(0, 4) == [902, 13, 2, 1]
        assert client.read_holding_registers(187, 1) == [10_000]
        assert client.write_single_register(187, 5_000) and client.read_holding_registers(187, 1) == [5_000]
        assert client.read_holding_registers(299, 1) is None and client.last_except == 2
        client.close()


def test_a_dashboard_client_reads_the_robot_controller() -> None:
    """That of ur_rtde; its port is fixed, so the address is one of our own."""
    with on_tcp_port(device_kind("ur").simulated().connect["dashboard"], "127.83.17.5", 29999):
        told = subprocess.run(
            [sys.executable, "-c", DASHBOARD, "127.83.17.5"],
            capture_output=True, text=True, timeout=60, check=True,
        ).stdout.splitlines()  # fmt: skip
    assert told == ["5.11.1.108318", "20235500123", "UR5", "POWER_OFF", "NORMAL", "False", "True"]


DASHBOARD = """
import sys
from dashboard_client import DashboardClient
client = DashboardClient(sys.argv[1])
client.connect()
print(client.polyscopeVersion(), client.getSerialNumber(), client.getRobotModel(), sep="\\n")
print(client.robotmode().split()[-1], client.safetymode().split()[-1], sep="\\n")
print(client.running(), client.isInRemoteControl(), sep="\\n")
"""


def test_pymodbustcp_reads_the_profiler() -> None:
    head = Gocator(GocatorSpec(zero_m=0.112345), Still(), 0.0, 0.0, np.random.default_rng(1))
    with on_tcp_port(head.connect) as port:
        client = ModbusClient("127.0.0.1", port, timeout=10.0)
        assert client.write_multiple_registers(0, [1])
        while client.read_holding_registers(301, 1) != [0]:
            pass
        assert client.read_holding_registers(300, 2) == [1, 0]
        while client.read_input_registers(996, 7)[3] == 0:
            pass
        assert client.read_input_registers(1000, 3) == [0, 12345, 1]
        name = client.read_holding_registers(311, 6)
        assert bytes(name[1 : 1 + name[0]]) == b"block"
        assert client.read_holding_registers(0, 1) is None and client.last_except == 2
        client.close()


def test_pymodbustcp_reads_the_remote_io() -> None:
    module = Adam6052(Contact(), 0x6052, 0)
    with on_tcp_port(lambda: RegisterConnection(module, FUNCTIONS, 0.001)) as port:
        client = ModbusClient("127.0.0.1", port, timeout=10.0)
        module._switch.closed, module._switch.count = True, 70_000
        assert client.read_discrete_inputs(0, 8) == [True] + [False] * 7
        low, high = client.read_input_registers(0, 2)
        assert high << 16 | low == 70_000
        assert client.read_holding_registers(210, 1) == [0x6052]
        assert client.write_single_coil(17, True) and client.read_coils(16, 3) == [False, True, False]
        assert client.read_input_registers(16, 1) is None and client.last_except == 2
        client.close()
