"""ABB controller with the open_abb RAPID server: one string in, one string out, in between the whole move.

What the server receives at once is one message, of 80 characters at most; a message that it cannot read is
answered with the number of the one before. Only one client is served; a move survives the loss of the client.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from estimation.transform import FloatArray
from simulators.answers import Answers
from simulators.interfaces import ByteDevice
from simulators.robots.controlled_arm import ControlledArm
from simulators.world.world_file import ArmSpec

PARAMETERS: Final = {0: 0, 1: 7, 2: 6, 3: 0, 4: 0, 6: 7, 7: 7, 9: 4, 30: 7, 31: 0, 32: 0, 33: 0, 98: 0, 99: 0}
MOST_CHARACTERS: Final = 80
MOST_BUFFERED: Final = 512
WAY_POINTS: Final = 17  # of a joint move, to know how far the flange goes


@dataclass(frozen=True, slots=True)
class AbbSettings:
    """What this controller is."""

    serial_number: str = "14-21858"
    version: str = "5.15.0122.01"
    model: str = "IRB 1400"
    decimals: int = 2
    quaternion_decimals: int = 3
    answer_s: float = 0.02
    fine_s: float = 0.03  # from the end of a motion until RAPID goes on


class AbbRobot(ControlledArm):
    """The controller and its arm. Tool and work object are taken, and change what poses mean."""

    def __init__(
        self,
        spec: ArmSpec,
        rng: np.random.Generator,
        noise_factors: FloatArray | None = None,
        motion_speed: float = 1.0,
        settings: AbbSettings | None = None,
    ) -> None:
        super().__init__(spec, rng, noise_factors, motion_speed)
        self.settings = settings or AbbSettings()
        self._flange_T_tool, self._base_T_object = np.eye(4), np.eye(4)
        self._v_tcp, self._v_ori = 100.0, 50.0  # mm/s, deg/s
        self._buffer = list[FloatArray]()
        self._permitted = True
        self.client: AbbSession | None = None

    def connections(self) -> dict[str, Callable[[], ByteDevice]]:
        return {"": self._connect}

    def _connect(self) -> "AbbSession":
        self.client = AbbSession(self)
        return self.client

    # -- what happens to it ----------------------------------------------------------------------

    def permit(self, permitted: bool, time_s: float) -> None:
        """Emergency stop: the program stops, and its client hears no more."""
        self._permitted = permitted
        if not permitted:
            self.fault(0, 0, time_s)

    def fault(self, joint: int, code: int, time_s: float) -> None:
        """An error stops motion and program."""
        self.halt(time_s)
        if self.client is not None:
            self.client.silence()
            self.client = None

    def restart(self, time_s: float) -> None:
        """The program starts anew: tool, work object and speed as it has them."""
        self.fault(0, 0, time_s)
        self._flange_T_tool, self._base_T_object = np.eye(4), np.eye(4)
        self._v_tcp, self._v_ori = 100.0, 50.0
        self._buffer.clear()

    @property
    def runs(self) -> bool:
        """Whether the server program does."""
        return self._permitted

    # -- instructions ----------------------------------------------------------------------------

    def execute(self, code: int, values: list[float], time_s: float) -> tuple[str, float] | None:
        """What is answered after `code ok `, and when; None if the program stops."""
        match code:
            case 1 | 2:
                ended_s = self._move(code, values, time_s)
                return None if ended_s is None else ("", ended_s)
            case 3:
                return self._pose(time_s), time_s
            case 4:
                joints = np.degrees(self.measured(time_s))
                return " ".join(f"{q:.{self.settings.decimals}f}" for q in joints), time_s
            case 6:
                self._flange_T_tool = _pose(values)
            case 7:
                self._base_T_object = _pose(values)
            case 8:
                self._v_tcp, self._v_ori = values[:2]
            case 30:
                self._buffer = [*self._buffer, np.array(values)][:MOST_BUFFERED]
            case 31:
                self._buffer.clear()
            case 32:
                return f"{len(self._buffer):.2f}", time_s
            case 33:
                for target in self._buffer:
                    ended_s = self._move(1, target.tolist(), time_s)
                    if ended_s is None:
                        return None
                    time_s = ended_s
                return "", time_s
            case 98:
                s = self.settings
                return f"{s.serial_number}*{s.version}*{s.model}", time_s
        return "", time_s

    def _move(self, code: int, values: list[float], time_s: float) -> float | None:
        """When RAPID goes on; None if the robot cannot go there."""
        if code == 1:
            flange = self._base_T_object @ _pose(values) @ np.linalg.inv(self._flange_T_tool)
            if not self.move_linear(time_s, flange, self._v_tcp * 1e-3):
                return None
        else:
            target = np.radians(values)
            if not self.within_limits(target):
                return None
            self.move(time_s, target, self._leading_speed(self.joints_at(time_s), target))
        return max(time_s, self.end_s()) + self.settings.fine_s

    def _leading_speed(self, here: FloatArray, target: FloatArray) -> float:
        """Speed of the fastest joint at which neither path nor turn of the tool is too fast, rad/s."""
        points = here + np.linspace(0.0, 1.0, WAY_POINTS)[:, None] * (target - here)
        poses = np.array([self.pose_of(point) @ self._flange_T_tool for point in points])
        path_mm = 1e3 * float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
        turns = Rotation.from_matrix(poses[:-1, :3, :3]).inv() * Rotation.from_matrix(poses[1:, :3, :3])
        turn_deg = float(np.degrees(turns.magnitude()).sum())
        longest = float(np.max(np.abs(target - here)))
        duration_s = max(path_mm / self._v_tcp, turn_deg / self._v_ori, longest / self.speed_limit_rad_s)
        return max(longest, 1e-12) / max(duration_s, 1e-9)

    def _pose(self, time_s: float) -> str:
        flange = self.pose_of(self.measured(time_s))
        pose = np.linalg.inv(self._base_T_object) @ flange @ self._flange_T_tool
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        settings = self.settings
        lengths = [f"{1e3 * length:.{settings.decimals}f}" for length in pose[:3, 3]]
        return " ".join([*lengths, *(f"{q:.{settings.quaternion_decimals}f}" for q in (w, x, y, z))])


class AbbSession(Answers):
    """The client of the server."""

    def __init__(self, robot: AbbRobot) -> None:
        super().__init__()
        self._robot = robot
        self._input = b""
        self._code = 0  # of the message before
        self._free_s = -math.inf  # when the program waits for the next message
        self._heard_s = -math.inf  # when something came last
        self._served = robot.runs

    def silence(self) -> None:
        """The program has stopped."""
        self._served = False
        self._output.clear()

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client; those that come during a move are read together afterwards."""
        self._work(time_s)
        self._input += data
        self._heard_s = time_s
        self._work(time_s)

    def _work(self, time_s: float) -> None:
        """Serve what lies there, as often as the program has come round by then."""
        while self._served and self._input and self._free_s <= time_s:
            message, self._input = self._input[:MOST_CHARACTERS], self._input[MOST_CHARACTERS:]
            self._message(message.decode("ascii", errors="replace"), max(self._free_s, self._heard_s))

    def _message(self, text: str, time_s: float) -> None:
        words, robot = text.partition("#")[0].split(), self._robot
        values: list[float] | None = None
        try:
            if "#" in text:
                self._code = int(words[0])
                values = [float(word) for word in words[1:]]
        except (ValueError, IndexError):
            values = None
        wanted = (2, 4) if self._code == 8 else (PARAMETERS.get(self._code, -1),)
        if values is None or len(values) not in wanted:
            self._reply("0", "", time_s)
            return
        if self._code == 99:
            self.silence()
            return
        done = robot.execute(self._code, values, time_s)
        if done is None:
            self.silence()
            return
        self._reply("1", *done)

    def _reply(self, ok: str, text: str, time_s: float) -> None:
        self._free_s = time_s + self._robot.settings.answer_s
        self._output.append((self._free_s, f"{self._code} {ok} {text}".encode("ascii")))

    def next_output_s(self) -> float:
        """When the next reply is there, or the next message is read."""
        due_s = super().next_output_s()
        return min(due_s, self._free_s) if self._input and self._served else due_s

    def take(self, time_s: float) -> bytes:
        """All replies that were sent by then."""
        self._work(time_s)
        return super().take(time_s)


def _pose(values: list[float]) -> FloatArray:
    """(4, 4) from millimetres and quaternion, scalar first."""
    matrix = np.eye(4)
    w, x, y, z = values[3:]
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, 3] = np.array(values[:3]) * 1e-3
    return matrix
