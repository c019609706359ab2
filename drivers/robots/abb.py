"""ABB controllers that run the open_abb server: one client, and moves that answer when they have ended.

The server cannot be interrupted: a stop waits for the end of a move, so moves go in steps. Nothing ties a
late reply to its request but the number of the request: after a timeout the line stays silent for as long as
a reply may take, and then proves who answers.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.capabilities import Contact, Identity, LinkHealth, RobotAbilities, StopWay
from drivers.clock import Clock
from drivers.links.interfaces import ByteLink
from drivers.robots import abb_codec as codec
from estimation.errors import DeviceError, DeviceTimeout, FrameError, IdentityMismatch
from estimation.transform import FloatArray, Transform

MOVE_MARGIN_S: Final = 5.0  # on top of the longest time that a move can take
REST_S: Final = 0.25  # two readings so far apart agree: the arm stands
LEAST_SPEED: Final = 0.01  # mm/s and deg/s, as they are sent
TRIES: Final = 2  # of questions; a move is never repeated


@dataclass(frozen=True, slots=True)
class AbbConfig:
    """Settings of one controller and its server program."""

    reach_m: float  # largest distance of the flange from an axis: turns speeds of joints into speeds of it
    touch_step_s: float  # a guarded move goes in steps of so long
    stop_delay_s: float  # the longest step of any other move
    model: str = ""  # as the server says it; "" does not compare
    serial_number: str = ""  # likewise
    decimals: int = 2  # of joints and lengths in replies
    quaternion_decimals: int = 3
    reply_timeout_s: float = 0.5
    quiet_s: float = 0.05  # ends the one reply of unknown length


class AbbLine:
    """Requests and replies."""

    def __init__(self, link: ByteLink, config: AbbConfig, clock: Clock) -> None:
        self._link, self._config, self._clock = link, config, clock
        self._out_of_step, self._identity = False, ("", "", "")
        self.frames = self.bad_frames = self.timeouts = self.opened = 0

    def open(self) -> tuple[str, str, str]:
        """Connect; serial number, version and type of who answers."""
        self._link.reopen()
        self.opened += 1
        self._out_of_step = False
        self._identity = self._information()
        return self._identity

    def close(self) -> None:
        """Leave; safe twice."""
        self._link.close()

    def leave(self) -> None:
        """Let the server wait for the next client; it does not answer."""
        self._link.write(codec.encode(codec.CLOSE))

    def ask(self, code: int, counts: Sequence[int]) -> list[float]:
        """The values of a question, asked again once if there is no reply."""
        for _ in range(TRIES - 1):
            with contextlib.suppress(DeviceTimeout, FrameError):
                return self.tell(code, (), counts)
        return self.tell(code, (), counts)

    def tell(
        self, code: int, values: Sequence[float], counts: Sequence[int] = (), timeout_s: float = 0.0
    ) -> list[float]:
        """The reply to a request, waited for at least as long as any reply may take."""
        self._resynchronise()
        request = codec.encode(code, values)
        timeout_s = max(timeout_s, self._config.reply_timeout_s)
        self._link.write(request)
        data, deadline_s = b"", self._clock.now_s() + timeout_s
        try:
            while (found := codec.parse_reply(data, code, counts)) is None:
                data += self._read(deadline_s, f"request {code:02d} within {timeout_s:.1f} s")
        except (DeviceTimeout, FrameError) as error:
            self._out_of_step = True
            self.bad_frames += isinstance(error, FrameError)
            raise
        self.frames += 1
        return found

    def _read(self, deadline_s: float, what: str) -> bytes:
        remaining_s = deadline_s - self._clock.now_s()
        data = self._link.read(max(remaining_s, 0.0))
        if not data and remaining_s <= 0.0:
            self.timeouts += 1
            raise DeviceTimeout(
                f"ABB did not answer {what}",
                "Check emergency stop, network and server program at the controller",
            )
        return data

    def _information(self) -> tuple[str, str, str]:
        self._link.write(codec.encode(codec.INFORMATION))
        deadline_s = self._clock.now_s() + self._config.reply_timeout_s
        what = f"request {codec.INFORMATION} within {self._config.reply_timeout_s:g} s"
        while not (data := self._read(deadline_s, what)):
            pass
        while more := self._link.read(self._config.quiet_s):
            data += more
            if len(data) > codec.MOST_BYTES:
                break
        self.frames += 1
        return codec.parse_information(data)

    def _resynchronise(self) -> None:
        """Silence for as long as a reply may take, then prove who answers; also if something came unasked."""
        if self._link.read(0.0):
            self.bad_frames += 1
            self._out_of_step = True
        if not self._out_of_step:
            return
        deadline_s = self._clock.now_s() + 4.0 * self._config.reply_timeout_s
        while self._link.read(self._config.reply_timeout_s):
            if self._clock.now_s() > deadline_s:
                raise FrameError("ABB sends without being asked", "Check that only this controller asks")
        found = self._information()
        if found != self._identity:
            raise IdentityMismatch(
                f"{found} answers after a timeout, before it was {self._identity}", "Reset"
            )
        self._out_of_step = False


class AbbController:
    """A `RobotController` whose moves have ended when `start_move` returns."""

    def __init__(self, link: ByteLink, config: AbbConfig, clock: Clock) -> None:
        self._config, self._clock = config, clock
        self._line = AbbLine(link, config, clock)
        self._here: FloatArray | None = None  # as read last
        self._surely_stands = False  # nothing moves as long as the server answers, but for a move of before
        self._connected = False

    @property
    def abilities(self) -> RobotAbilities:
        """No stop; a contact lies somewhere in the step in which the probe was touched."""
        return RobotAbilities(
            StopWay.BETWEEN_STEPS,
            stop_delay_s=self._config.stop_delay_s,
            contact_delay_s=self._config.touch_step_s,
            joint_resolution_rad=math.radians(10.0**-self._config.decimals),
            linear_moves=True,
            reports_pose=True,
        )

    def connect(self) -> Identity:
        """Identity.

        Raises DeviceError, DeviceTimeout, FrameError, IdentityMismatch.
        """
        config, line = self._config, self._line
        self._surely_stands = False
        serial, version, model = line.open()
        for what, found, expected in (
            ("type", model, config.model),
            ("serial number", serial, config.serial_number),
        ):
            if expected and found != expected:
                raise IdentityMismatch(
                    f"The controller answers {what} {found!r}, the cell file says {expected!r}",
                    "Check host and port, or correct the cell file and calibrate again",
                )
        self._connected = True
        return Identity(model, serial, version, (("decimals", str(config.decimals)),))

    def enable(self) -> None:
        """Flange and base as tool and work object; every move ends at rest."""
        for code, values in (
            (codec.TOOL, codec.NOTHING),
            (codec.WORK_OBJECT, codec.NOTHING),
            (codec.ZONE, codec.FINE),
        ):
            self._line.tell(code, values)

    def close(self) -> None:
        """Tell the server to wait for the next client; safe twice."""
        if self._connected:
            self._connected = False
            with contextlib.suppress(DeviceError):
                self._line.leave()
        self._line.close()

    def health(self) -> LinkHealth:
        """Link counters."""
        line = self._line
        return LinkHealth(line.frames, line.bad_frames, line.timeouts, max(0, line.opened - 1))

    def read_joints(self) -> tuple[float, FloatArray]:
        """Stamped in the middle between request and reply."""
        asked_s = self._clock.now_s()
        values = self._line.ask(codec.JOINTS, codec.joint_decimals(self._config.decimals))
        self._here = np.radians(values)
        return (asked_s + self._clock.now_s()) / 2.0, self._here

    def read_pose(self) -> Transform:
        """base_T_flange as the controller computes it."""
        counts = codec.pose_decimals(self._config.decimals, self._config.quaternion_decimals)
        return Transform("base", "flange", codec.pose_matrix(self._line.ask(codec.POSE, counts)))

    def is_moving(self) -> bool:
        """A server that answers moves nothing; what it moved before we came may still be on its way."""
        _, first = self.read_joints()
        if not self._surely_stands:
            self._clock.sleep(REST_S)
            _, second = self.read_joints()
            self._surely_stands = bool(
                (np.abs(second - first) < 1.5 * self.abilities.joint_resolution_rad).all()
            )
        return not self._surely_stands

    def start_move(self, target_rad: FloatArray, speed_rad_s: float) -> None:
        """The flange may take the way of all joints one after the other, so long is waited."""
        _, here = self.read_joints() if self._here is None else (0.0, self._here)
        self._set_speed(speed_rad_s * self._config.reach_m, math.degrees(speed_rad_s))
        longest_s = float(np.sum(np.abs(target_rad - here))) / speed_rad_s
        self._move(codec.MOVE_JOINTS, np.degrees(target_rad).tolist(), longest_s)

    def start_linear(self, base_T_flange: Transform, speed_m_s: float) -> None:
        """Likewise on a straight line."""
        self._set_speed(speed_m_s, math.degrees(speed_m_s / self._config.reach_m))
        longest_s = 2.0 * self._config.reach_m / speed_m_s
        self._move(codec.MOVE_LINEAR, codec.pose_values(base_T_flange.matrix), longest_s)

    def halt(self) -> None:
        """Never called: it cannot."""

    def recover(self) -> None:
        """Nothing."""

    def contact_at(self, touched_s: float, late_s: float) -> Contact | None:
        """None: a step has no inside."""
        return None

    def _set_speed(self, flange_m_s: float, turn_deg_s: float) -> None:
        speeds = [max(1e3 * flange_m_s, LEAST_SPEED), max(turn_deg_s, LEAST_SPEED)]
        self._line.tell(codec.SPEED, speeds)

    def _move(self, code: int, values: Sequence[float], longest_s: float) -> None:
        self._surely_stands = False
        self._line.tell(code, values, timeout_s=2.0 * longest_s + MOVE_MARGIN_S)
        self._surely_stands = True
