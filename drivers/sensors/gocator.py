"""The RangeSensor capability of a LMI Gocator line profiler: one of its measurements, by Modbus TCP.

Modbus carries what the head measures in its profiles, not the profiles. Those travel on a data channel of
their own, whose format is not in the facts at hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from drivers.capabilities import Identity, LinkHealth
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.links.modbus_tcp import ModbusTcp
from drivers.sensors.polled import Answer, PolledRange, no_value
from estimation.errors import DeviceError, DeviceTimeout, IdentityMismatch

MODEL: Final = "LMI Gocator"
COMMAND: Final = 0
START: Final = 1
LOAD_JOB: Final = 5
RUNNING: Final = 300
BUSY: Final = 301
JOB_LENGTH: Final = 311  # then the name, one character in each register
LONGEST_NAME: Final = 60
ADVANCE: Final = 976  # reading it takes the next message, where the head buffers them
BUFFERED: Final = 977  # first of what is read at once, to the decision of the measurement
FRAME_INDEX: Final = 996
MEASUREMENTS: Final = 1000
MOST_MEASUREMENT: Final = 33  # the last that fits into one request together with the frame index
INVALID: Final = -(1 << 31)
NO_VALUE: Final = {1: "invalid value", 2: "invalid anchor"}  # codes of a decision
STEP_M: Final = 1e-6
BUSY_POLL_S: Final = 0.05
NEW_FRAME_POLLS: Final = 4  # in one period


@dataclass(frozen=True, slots=True)
class GocatorConfig:
    """Settings of one head and of the measurement that is its distance."""

    zero_m: float  # distance at which the measurement is zero
    rate_hz: float  # profiles per second
    measurement: int = 0
    towards: bool = True  # the measurement grows towards the head
    job: str = ""  # compared, and loaded if it is another; "" takes what is loaded
    noise_m: float = 0.0  # of one value; 0 switches the search for a frozen value off
    latency_s: float = 0.02  # from the exposure until its result can be read
    silence_s: float = 0.5  # without a new profile
    command_timeout_s: float = 10.0
    reply_timeout_s: float = 0.2


class _Result(NamedTuple):
    buffered: int
    frame: int
    value_um: int
    decision: int
    received_s: float


class Gocator(PolledRange):
    """A value counts once its frame index is another than that of the value before."""

    def __init__(self, link: ByteLink, config: GocatorConfig, clock: Clock) -> None:
        if not 0 <= config.measurement <= MOST_MEASUREMENT:
            raise DeviceError(
                f"Measurement {config.measurement} of a Gocator",
                f"Give the measurement an id of 0 to {MOST_MEASUREMENT}",
            )
        period_s = 1.0 / config.rate_hz
        super().__init__(
            clock, "Laser", fresh_s=period_s + config.latency_s, noise_m=config.noise_m, step_m=STEP_M
        )
        self._link, self._config, self._period_s = link, config, period_s
        self._modbus = ModbusTcp(
            link,
            clock,
            name="Laser",
            reply_timeout_s=config.reply_timeout_s,
            on_resync=self._after_timeout,
        )
        self._opened = 0
        self._job = ""  # compared again after a timeout
        self._frame = -1  # of the last value

    def connect(self) -> Identity:
        """Load the job if it is another, start the head if it stands, take one value.

        Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch.
        """
        self._connected, self._job = False, ""
        self._link.reopen()
        self._opened += 1
        self._modbus.reset()
        self._wait_until_idle()
        job = self._read_job()
        if self._config.job not in ("", job):
            self._run(LOAD_JOB, self._config.job)
            job = self._read_job()
            self._compare(job, self._config.job)
        if not self._modbus.read_holding_registers(RUNNING, 1)[0]:
            self._run(START)
            if not self._modbus.read_holding_registers(RUNNING, 1)[0]:
                raise DeviceError("Laser: the head does not start", "Look at its own page for the reason")
        self._connected, self._job = True, job
        self.begin_window()
        self.end_window(1)
        settings = (("job", job), ("measurement", str(self._config.measurement)))
        return Identity(MODEL, "", "", settings)

    def close(self) -> None:
        """Release the connection; safe twice."""
        self._connected = False
        self._link.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        modbus = self._modbus
        return LinkHealth(modbus.frames, modbus.bad_frames, modbus.timeouts, max(0, self._opened - 1))

    def begin_window(self) -> None:
        """Values are measured after now: later than the profile that the head shows."""
        super().begin_window()
        self._frame = self._newest().frame

    def _ask(self) -> Answer:
        deadline_s = self._clock.now_s() + self._config.silence_s
        while (result := self._newest()).frame == self._frame:
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeout(
                    f"Laser: no new profile for {self._config.silence_s:g} s, index {self._frame}",
                    "Check trigger and state of the head",
                )
            self._clock.sleep(self._period_s / NEW_FRAME_POLLS)
        self._frame = result.frame
        if result.value_um == INVALID or result.decision >> 1:
            return no_value(result.received_s, NO_VALUE.get(result.decision >> 1, "no value"))
        height_m = result.value_um * STEP_M
        sign = -1.0 if self._config.towards else 1.0
        return Answer(self._config.zero_m + sign * height_m, result.received_s)

    def _newest(self) -> _Result:
        """What the head shows, all from one profile; buffered messages are taken until the last."""
        decision = MEASUREMENTS + 3 * self._config.measurement + 2
        deadline_s = self._clock.now_s() + self._config.silence_s
        while True:
            self._modbus.read_holding_registers(ADVANCE, 1)
            words = self._modbus.read_holding_registers(BUFFERED, decision + 1 - BUFFERED)
            result = _Result(
                words[0],
                _number(words[FRAME_INDEX - BUFFERED :][:4]),
                _number(words[-3:-1], signed=True),
                words[-1],
                self._modbus.received_s,
            )
            if not result.buffered:
                return result
            if self._clock.now_s() > deadline_s:
                raise DeviceError(
                    f"Laser: {result.buffered} results wait, and new ones come faster than they are read",
                    "Switch the buffer of the Modbus output off, or lower the rate",
                )

    # --- commands ------------------------------------------------------------------------------------

    def _run(self, command: int, name: str = "") -> None:
        """A command runs only if it is another than the one before: write 0 first."""
        self._modbus.write_register(COMMAND, 0)
        self._wait_until_idle()
        letters = [*name.encode("ascii"), 0] if name else []
        self._modbus.write_registers(COMMAND, [command, *letters])
        self._wait_until_idle()

    def _wait_until_idle(self) -> None:
        limit_s = self._config.command_timeout_s
        deadline_s = self._clock.now_s() + limit_s
        while self._modbus.read_holding_registers(BUSY, 1)[0]:
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeout(f"Laser: busy for more than {limit_s:g} s", "Look at the head's own page")
            self._clock.sleep(BUSY_POLL_S)

    def _read_job(self) -> str:
        words = self._modbus.read_holding_registers(JOB_LENGTH, 1 + LONGEST_NAME)
        return "".join(chr(word & 0x7F) for word in words[1 : 1 + words[0]])

    def _compare(self, job: str, expected: str) -> None:
        if job != expected:
            raise IdentityMismatch(
                f"Laser: its job is {job!r}, not {expected!r}",
                "Another job gives the registers another meaning: load the right one, then calibrate again",
            )

    def _after_timeout(self) -> None:
        """Part of the resynchronisation: the head that answers now still has the job."""
        if self._connected:
            self._compare(self._read_job(), self._job)


def _number(words: Sequence[int], *, signed: bool = False) -> int:
    """The high word first."""
    return int.from_bytes(b"".join(word.to_bytes(2, "big") for word in words), "big", signed=signed)
