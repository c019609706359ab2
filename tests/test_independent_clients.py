"""Clients that others wrote read right values from our simulated sensors, over real ports."""

from pathlib import Path

import canopen
import minimalmodbus
import numpy as np
import pytest
import serial
from pyModbusTCP.client import ModbusClient

from estimation.transform import FloatArray
from simulators.modbus_server import ModbusConnection
from simulators.probes.adam6052 import Adam6052
from simulators.probes.wago750 import Wago750, WagoSpec
from simulators.sensors.ams335i import Ams335i, AmsSpec
from simulators.sensors.ft300 import Ft300, Ft300Spec
from simulators.sensors.gocator import Gocator, GocatorSpec
from simulators.sensors.riftek import Rf60x
from simulators.sensors.riftek_head import MODBUS_RTU, RiftekSpec
from simulators.slcan import SlcanDevice
from tests.support.wires import on_serial_port, on_tcp_port

pytestmark = pytest.mark.wire


U8, U16, U32 = 0x05, 0x06, 0x07
OBJECTS = {  # what the library must be told of a device
    0x1000: [U32],
    0x1008: [0x09],
    0x1017: [U16],
    0x1018: [U8, U32, U32, U32, U32],
    0x6005: [U8],
    0x6000: [U8, U8],
    0x6004: [0x04],
    0x2060: [U8, U32],
    **{0x1800 + n: [U8, U32, U8, U16, U8, U16] for n in range(2)},
    **{0x1A00 + n: [U8] + [U32] * 8 for n in range(2)},
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


def canopen_node(path: Path, node: int) -> canopen.RemoteNode:
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
    return network.add_node(node, dictionary)


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
    module = Adam6052(Contact(), 0x6052, 0, 0.001)
    with on_tcp_port(lambda: ModbusConnection(module)) as port:
        client = ModbusClient("127.0.0.1", port, timeout=10.0)
        module._switch.closed, module._switch.count = True, 70_000
        assert client.read_discrete_inputs(0, 8) == [True] + [False] * 7
        low, high = client.read_input_registers(0, 2)
        assert high << 16 | low == 70_000
        assert client.read_holding_registers(210, 1) == [0x6052]
        assert client.write_single_coil(17, True) and client.read_coils(16, 3) == [False, True, False]
        assert client.read_input_registers(16, 1) is None and client.last_except == 2
        client.close()
