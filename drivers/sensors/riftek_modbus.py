"""The RangeSensor capability of a RIFTEK RF602 in Modbus RTU: one request for each result."""

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.links.modbus_rtu import ModbusRtu
from drivers.sensors import riftek_codec as codec
from drivers.sensors.riftek_polled import PolledRiftek
from drivers.sensors.riftek_settings import BITS_PER_BYTE, RiftekConfig, compare
from estimation.errors import DeviceError, FrameError


class RiftekModbusLaser(PolledRiftek):
    """Each reading brings serial number, base distance and range with it, so that it proves what it is."""

    def __init__(self, link: ByteLink, config: RiftekConfig, clock: Clock) -> None:
        super().__init__(link, config, clock)
        self._modbus = ModbusRtu(
            link,
            clock,
            name="Laser",
            unit=config.address,
            baud=config.baud,
            bits_per_byte=BITS_PER_BYTE,
            worst_answer_s=config.worst_answer_s,
            echo=config.echo,
            on_resync=self._after_failure,
        )

    def connect(self) -> Identity:
        """Compare the identity, set and read back the parameters, take one result.

        Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch.
        """
        config = self._config
        self._connected = False
        self._link.reopen()
        self._opened += 1
        self._modbus.reset()
        identity = compare(config, self._head())
        control = self._modbus.read_holding_registers(self._wire(codec.CONTROL_REGISTER), 1)[0]
        for register, value in (
            (codec.LASER_REGISTER, 1),
            (codec.CONTROL_REGISTER, control & 0xFE),  # sample by time, not by trigger
            (codec.AVERAGES_REGISTER, config.averages),
            (codec.PERIOD_REGISTER, config.period_us),
            (codec.HOLD_REGISTER, 0),  # a result that is held is older than it looks
        ):
            self._write(register, value)
        self._connected = True
        self.begin_window()
        self.end_window(1)
        return identity

    def health(self) -> LinkHealth:
        """Link counters."""
        modbus = self._modbus
        return LinkHealth(modbus.frames, modbus.bad_frames, modbus.timeouts, max(0, self._opened - 1))

    def _result(self) -> tuple[int, float]:
        serial, base, full, result = self._modbus.read_input_registers(self._wire(codec.SERIAL_REGISTER), 4)
        config = self._config
        if (base, full) != (round(config.base_m * 1e3), round(config.range_m * 1e3)) or (
            config.serial_number and str(serial) != config.serial_number
        ):
            raise FrameError(
                f"Laser: serial {serial}, base {base} mm, range {full} mm came with a result",
                "Give every unit on the line its own address",
            )
        return result, self._modbus.received_s

    def _head(self) -> codec.Head:
        return codec.Head(*self._modbus.read_input_registers(self._wire(1), 5))

    def _write(self, register: int, value: int) -> None:
        self._modbus.write_register(self._wire(register), value)
        (told,) = self._modbus.read_holding_registers(self._wire(register), 1)
        if told != value:
            raise DeviceError(
                f"Laser: register {register} is {told} after {value} was written",
                "Check the settings of the laser in the cell file",
            )

    def _wire(self, register: int) -> int:
        return register - 1 + self._config.first_register
