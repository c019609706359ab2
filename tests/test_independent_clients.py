"""Clients that others wrote read right values from our simulated sensors, over real ports."""

from pathlib import Path

import minimalmodbus
import numpy as np
import pytest
import serial

from estimation.transform import FloatArray
from simulators.sensors.ft300 import Ft300, Ft300Spec
from simulators.sensors.riftek import Rf60x
from simulators.sensors.riftek_head import MODBUS_RTU, RiftekSpec
from tests.support.wires import on_serial_port

pytestmark = pytest.mark.wire


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
