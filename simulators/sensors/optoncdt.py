"""Micro-Epsilon optoNCDT 1420 on its RS-422 line: ASCII commands beside a stream of three-byte values."""

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray
from simulators.sensors.beam import Beam
from simulators.world.world_file import LaserSpec

IntArray = NDArray[np.int64]

UNDERFLOW: Final = 262073  # of a mastered value
OVERFLOW: Final = 262074
LARGEST_MASTERED: Final = 262072
TOO_MUCH_DATA: Final = 262075
NO_PEAK: Final = 262076
BEFORE_RANGE: Final = 262077
BEHIND_RANGE: Final = 262078
LASER_OFF: Final = 262082
LARGEST_DISTANCE: Final = 65520
COMMAND_S: Final = 0.012  # until the sensor has answered
RESET_S: Final = 1.5
RATES_KHZ: Final = ("0.25", "0.5", "1", "2", "4", "8")
BAUDS: Final = (
    9600, 19200, 56000, 115200, 128000, 230400, 256000, 460800, 691200, 921600, 1000000
)  # fmt: skip
LONGEST_COMMAND: Final = 255
KEPT_BYTES: Final = 65536  # by the receiving port while nobody reads; what comes then is lost
CHOICES: Final[dict[str, tuple[str, ...]]] = {
    "OUTPUT": ("NONE", "RS422", "ANALOG"),
    "MEASRATE": RATES_KHZ,
    "OUTREDUCEDEVICE": ("NONE", "RS422", "ANALOG"),
    "OUTADD_RS422": ("NONE", "INTENSITY"),
    "BAUDRATE": tuple(str(baud) for baud in BAUDS),
    "ECHO": ("ON", "OFF"),
    "LASERPOW": ("FULL", "OFF"),
    "LANGUAGE": ("EN", "DE", "CN"),
    "TRIGGER": ("NONE",),
    "MASTERMV": ("NONE",),  # and MASTER with a value
}
POWER_ON: Final[dict[str, str]] = {
    "OUTPUT": "RS422",  # a sensor comes up measuring
    "MEASRATE": "4",
    "OUTREDUCEDEVICE": "NONE",
    "OUTADD_RS422": "NONE",
    "ECHO": "ON",
    "LASERPOW": "FULL",
    "LANGUAGE": "EN",
    "TRIGGER": "NONE",
    "MASTERMV": "NONE",
}


def encode_values(values: IntArray, first: bool = True) -> NDArray[np.uint8]:
    """Three bytes (n, 3) of each 18-bit value, low bits first; flags as in the manual."""
    result = np.empty((len(values), 3), dtype=np.uint8)
    result[:, 0] = values & 0x3F
    result[:, 1] = values >> 6 & 0x3F | 0x40
    result[:, 2] = values >> 12 & 0x3F | (0x80 if first else 0xC0)
    return result


class OptoNcdt1420:
    """The sensor's end of the line. Values exist only when they are taken, so an unread stream is free."""

    def __init__(
        self,
        spec: LaserSpec,
        beam: Beam,
        scale: float,
        offset_m: float,
        rng: np.random.Generator,
        noise_factor: float = 1.0,
    ) -> None:
        self._spec, self._beam, self._rng = spec, beam, rng
        self._scale, self._offset_m = scale, offset_m
        self._noise_m = spec.reading_noise_m * noise_factor
        self._settings = {**POWER_ON, "BAUDRATE": str(spec.baud)}
        self._mastered_m: float | None = None  # what is added to a distance
        self._input = b""
        self._output: deque[tuple[float, bytes]] = deque()
        self._up_s = 0.0  # when it has booted
        self._start_stream(0.0)

    @property
    def baud(self) -> int:
        """Line speed now."""
        return int(self._settings["BAUDRATE"])

    # -- stream of values ------------------------------------------------------------------------

    def _start_stream(self, time_s: float) -> None:
        rate_hz = float(self._settings["MEASRATE"]) * 1000 * (1 + self._spec.clock_drift)
        self._cycle_s = 1 / rate_hz
        self._stream_s = max(time_s, self._up_s)
        self._next_value = 1  # counted from the start of the stream

    @property
    def _streaming(self) -> bool:
        s = self._settings
        return s["OUTPUT"] == "RS422" and "RS422" not in s["OUTREDUCEDEVICE"]

    def _burst(self, time_s: float, later: bool) -> float:
        """The converter hands bytes over at these instants: the last one before, or the next one."""
        number = time_s / self._spec.latency_s
        return (math.ceil(number - 1e-9) if later else math.floor(number + 1e-9)) * self._spec.latency_s

    def _values_until(self, time_s: float) -> IntArray:
        """Numbers of the values measured and not taken yet."""
        last = math.floor((time_s - self._stream_s) / self._cycle_s + 1e-9)
        return np.arange(self._next_value, last + 1)

    def _stream(self, time_s: float) -> bytes:
        if not self._streaming:
            return b""
        numbers = self._values_until(time_s)
        if not len(numbers):
            return b""
        self._next_value = int(numbers[-1]) + 1
        with_intensity = self._settings["OUTADD_RS422"] == "INTENSITY"
        size = 6 if with_intensity else 3
        if 10 * size / self._cycle_s > self.baud:
            numbers = numbers[::size]  # what the line can carry says that it cannot carry more
            return encode_values(np.full(len(numbers), TOO_MUCH_DATA)).tobytes()
        numbers = numbers[: KEPT_BYTES // size]
        data = encode_values(self._measure(self._stream_s + numbers.astype(np.float64) * self._cycle_s))
        if with_intensity:
            percent = encode_values(np.full(len(numbers), 32768), first=False)
            data = np.concatenate([data, percent], axis=1)
        return data.tobytes()

    def _measure(self, times_s: FloatArray) -> IntArray:
        if self._settings["LASERPOW"] == "OFF":
            return np.full(len(times_s), LASER_OFF)
        noise = self._rng.standard_normal(len(times_s)) * self._noise_m
        true_m = self._beam.beam_lengths_m(times_s)
        reading_m = (true_m - self._offset_m) / (1 + self._scale) + noise
        distance_m = reading_m - self._spec.range_start_m
        percent = distance_m / self._spec.range_m * 100
        code = np.rint((percent + 1) * (LARGEST_DISTANCE / 102))
        errors = [np.isnan(code), code < 0, code > LARGEST_DISTANCE]
        if self._mastered_m is not None:
            percent += self._mastered_m / self._spec.range_m * 100
            code = np.rint((percent + 51) * (LARGEST_DISTANCE / 102))
            errors += [code < 0, code > LARGEST_MASTERED]
        words = [NO_PEAK, BEFORE_RANGE, BEHIND_RANGE, UNDERFLOW, OVERFLOW]
        code = np.select(errors, words[: len(errors)], default=code)
        return code.astype(np.int64)

    # -- line ------------------------------------------------------------------------------------

    def next_output_s(self) -> float:
        """When the next bytes are handed over."""
        reply_s = self._output[0][0] if self._output else math.inf
        if not self._streaming:
            return reply_s
        value_s = self._stream_s + self._next_value * self._cycle_s
        return min(reply_s, self._burst(value_s, later=True))

    def take(self, time_s: float) -> bytes:
        """Everything handed over by then."""
        data = b""
        while self._output and self._output[0][0] <= time_s:
            reply_s, reply = self._output.popleft()
            data += self._stream(reply_s) + reply
        return data + self._stream(self._burst(time_s, later=False))

    def discard(self, time_s: float) -> None:
        """Forget what was handed over by then, without making it."""
        while self._output and self._output[0][0] <= time_s:
            self._output.popleft()
        numbers = self._values_until(self._burst(time_s, later=False))
        if self._streaming and len(numbers):
            self._next_value = int(numbers[-1]) + 1

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the host; a command ends with LF."""
        if time_s < self._up_s:
            return
        self._input += data
        while b"\n" in self._input:
            line, _, self._input = self._input.partition(b"\n")
            words = line.strip().decode("latin-1").split()
            if words or line:
                self._reply(self._execute(words, time_s), time_s)
        if len(self._input) > LONGEST_COMMAND:
            self._input = b""
            self._reply("E214 Entered command is too long to be processed\r\n", time_s)

    def _reply(self, text: str, time_s: float) -> None:
        self._output.append((self._reply_time(time_s), text.encode("latin-1") + b"->"))

    def _reply_time(self, time_s: float) -> float:
        reply_s = self._burst(time_s + COMMAND_S, later=True)
        return max(reply_s, self._output[-1][0]) if self._output else reply_s

    # -- commands --------------------------------------------------------------------------------

    def _execute(self, words: list[str], time_s: float) -> str:
        """The reply without the prompt."""
        if not words:
            return "\r\n"
        name, parameters = words[0].upper(), [word.upper() for word in words[1:]]
        if name == "MASTERMV" and len(parameters) == 2:
            return self._master(parameters, time_s)
        if name == "MASTERMV" and parameters == ["NONE"]:
            self._mastered_m = None
        if name in CHOICES:
            return self._setting(name, parameters, time_s)
        if name in ("GETINFO", "PRINT", "HELP", "RESET", "GETUSERLEVEL", "RESETCNT") and parameters:
            return "E232 Wrong parameter count\r\n"
        if name == "GETINFO":
            return self._information()
        if name == "PRINT":
            return "PRINT\r\n" + "".join(f"{key} {value}\r\n" for key, value in self._settings.items())
        if name == "HELP":
            return "HELP\r\n" + "".join(f"{key}\r\n" for key in ("GETINFO", "PRINT", "RESET", *CHOICES))
        if name == "GETUSERLEVEL":
            return "GETUSERLEVEL PROFESSIONAL\r\n"
        if name == "RESETCNT":
            return "RESETCNT\r\n"
        if name == "RESET":
            self.restart(time_s)
            return "RESET\r\n"
        return "E210 Unknown command\r\n"

    def restart(self, time_s: float) -> None:
        """Power comes back: run-time settings are lost, and it measures."""
        self._settings = {**POWER_ON, "BAUDRATE": str(self._spec.baud)}
        self._mastered_m = None
        self._input = b""
        self._output.clear()
        self._up_s = time_s + RESET_S
        self._start_stream(time_s)

    def _setting(self, name: str, parameters: list[str], time_s: float) -> str:
        if parameters:
            if len(parameters) > 1:
                return "E232 Wrong parameter count\r\n"
            (value,) = parameters
            if value not in CHOICES[name]:
                return "E236 Value is out of range or the format is invalid\r\n"
            self._settings[name] = value
            if name in ("OUTPUT", "MEASRATE", "OUTREDUCEDEVICE", "OUTADD_RS422"):
                self._start_stream(self._reply_time(time_s))  # values follow the reply
        if parameters and self._settings["ECHO"] == "OFF":
            return ""
        return f"{name} {self._settings[name]}\r\n"

    def _master(self, parameters: list[str], time_s: float) -> str:
        """The present distance is to count as that many millimetres."""
        what, value = parameters
        if (
            what != "MASTER"
            or not value.replace(".", "", 1).isdecimal()
            or float(value) > self._spec.range_m * 1000
        ):
            return "E236 Value is out of range or the format is invalid\r\n"
        distance_m = float(self._beam.beam_lengths_m(np.array([time_s]))[0]) - self._spec.range_start_m
        if not 0 <= distance_m <= self._spec.range_m:
            return "E104 Timeout\r\n"
        self._mastered_m = float(value) / 1000 - distance_m
        self._settings["MASTERMV"] = f"MASTER {value}"
        return f"MASTERMV MASTER {value}\r\n"

    def _information(self) -> str:
        spec = self._spec
        return (
            "GETINFO\r\n"
            f"Name: {spec.model}\r\n"
            f"Serial: {spec.serial_number}\r\n"
            "Option: 000\r\n"
            f"Article: {spec.article}\r\n"
            "Cable head: Wire\r\n"
            f"Measuring range: {spec.range_m * 1000:.2f}mm\r\n"
            f"Version: {spec.version}\r\n"
            "Hardware-rev: 00\r\n"
            "Boot-version: 001.000\r\n"
        )
