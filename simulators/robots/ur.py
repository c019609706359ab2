"""Universal Robots controller: RTDE (30004), programs (30002) and dashboard (29999) before one arm.

A program takes the place of the one that runs; it is refused in local mode, without a word.
"""

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from estimation.transform import FloatArray
from simulators.answers import Answers
from simulators.interfaces import ByteDevice
from simulators.robots.controlled_arm import ControlledArm
from simulators.robots.ur_fields import (
    IDLE,
    NORMAL,
    POWER_OFF,
    POWER_ON,
    PROTECTIVE_STOP,
    REGISTERS,
    ROBOT_EMERGENCY_STOP,
    RUNNING,
    Moment,
    UrState,
    pose_matrix,
)
from simulators.robots.ur_rtde import RtdeSession
from simulators.robots.ur_script import Call, ScriptError, ScriptReader, parse_call
from simulators.world.world_file import ArmSpec

MODE_NAMES: Final = {POWER_OFF: "POWER_OFF", POWER_ON: "POWER_ON", IDLE: "IDLE", RUNNING: "RUNNING"}
SAFETY_NAMES: Final = {
    NORMAL: "NORMAL",
    PROTECTIVE_STOP: "PROTECTIVE_STOP",
    ROBOT_EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP",
}
UNLOCK_S: Final = 5.0  # a protective stop stays for so long at least


@dataclass(frozen=True, slots=True)
class UrSettings:
    """What this controller is."""

    model: str = "UR5"
    serial_number: str = "20235500123"
    polyscope: str = "URSoftware 5.11.1.108318 (Jul 21 2021)"
    version: tuple[int, int, int, int] = (5, 11, 1, 108318)
    clock_ahead_s: float = 4711.0  # of the controller against the world
    clock_drift: float = 50e-6
    program_s: float = 0.014  # from receipt of a program to its first statement
    power_s: float = 1.0
    brake_s: float = 0.6
    answer_s: float = 0.003  # of the dashboard
    tool_m: tuple[float, float, float] = (0.0, 0.0, 0.1)  # as somebody left it
    remote: bool = True


class UrRobot(ControlledArm):
    """The controller and its arm; any number of clients."""

    def __init__(
        self,
        spec: ArmSpec,
        rng: np.random.Generator,
        noise_factors: FloatArray | None = None,
        motion_speed: float = 1.0,
        settings: UrSettings | None = None,
    ) -> None:
        super().__init__(spec, rng, noise_factors, motion_speed)
        self.settings = settings or UrSettings()
        self._times, self._states = [-math.inf], [UrState()]
        self._flange_T_tcp = pose_matrix((*self.settings.tool_m, 0.0, 0.0, 0.0))
        self._stopped_s = -math.inf  # when the protective stop came
        self._permitted = True

    def connections(self) -> dict[str, Callable[[], ByteDevice]]:
        return {
            "": lambda: RtdeSession(self, self.settings.version),
            "script": lambda: ScriptSession(self),
            "dashboard": lambda: DashboardSession(self),
        }

    # -- what can be seen ------------------------------------------------------------------------

    def state_at(self, time_s: float) -> UrState:
        """Modes and registers at an instant."""
        return self._states[bisect_right(self._times, time_s) - 1]

    def moment(self, time_s: float) -> Moment:
        """The robot at an instant up to the present."""
        joints, settings = self.measured(time_s), self.settings
        return Moment(
            time_s * (1.0 + settings.clock_drift) + settings.clock_ahead_s,
            joints,
            self.joints_at(time_s),
            lambda: self.course(time_s)[0],
            self.pose_of(joints) @ self._flange_T_tcp,
            self.state_at(time_s),
        )

    def _become(self, time_s: float, **changes: Any) -> None:
        """From then on; what was to come after is not to come any more."""
        kept = bisect_right(self._times, time_s)
        state = replace(self._states[kept - 1], **changes)
        self._times[kept:], self._states[kept:] = [time_s], [state]

    # -- what happens to it ----------------------------------------------------------------------

    def permit(self, permitted: bool, time_s: float) -> None:
        """Emergency stop pressed or released; the robot is off afterwards."""
        self._permitted = permitted
        self.halt(time_s)
        safety = NORMAL if permitted else ROBOT_EMERGENCY_STOP
        self._become(time_s, mode=POWER_OFF, safety=safety, program_runs=False)

    def fault(self, joint: int, code: int, time_s: float) -> None:
        """A protective stop."""
        self.halt(time_s)
        self._stopped_s = time_s
        self._become(time_s, safety=PROTECTIVE_STOP, program_runs=False)

    def restart(self, time_s: float) -> None:
        """Power comes back: off, registers empty, the tool as it was left."""
        self.halt(time_s)
        self._flange_T_tcp = pose_matrix((*self.settings.tool_m, 0.0, 0.0, 0.0))
        self._become(time_s, mode=POWER_OFF, safety=NORMAL, program_runs=False, registers=(0,) * REGISTERS)

    # -- programs --------------------------------------------------------------------------------

    def run(self, lines: list[str], time_s: float) -> None:
        """Run a program in the place of any other."""
        now = self.state_at(time_s)
        if not self.settings.remote or now.mode != RUNNING or now.safety != NORMAL:
            return
        try:
            calls = [parse_call(line) for line in lines]
        except ScriptError:
            return  # the controller says so on the pendant
        begin_s = time_s + self.settings.program_s
        self._become(begin_s, program_runs=True)
        at_s = self.halt(begin_s)  # what moves without its program comes to rest
        for call in calls:
            done_s = self._execute(call, at_s)
            if done_s is None:
                self.fault(0, 0, at_s)
                return
            at_s = done_s
        self._become(at_s, program_runs=False)

    def _execute(self, call: Call, time_s: float) -> float | None:
        """When the statement has ended; None if it stops the robot."""
        match call.name:
            case "write_output_integer_register":
                number, value = int(call.arguments[0][0]), int(call.arguments[1][0])
                self._become(time_s, registers=self.state_at(time_s).with_register(number, value).registers)
            case "set_tcp":
                self._flange_T_tcp = pose_matrix(call.arguments[0])
            case "movej":
                target = np.array(call.arguments[0])
                if target.shape != (6,) or not self.within_limits(target):
                    return None
                self.move(time_s, target, call.named.get("v", 1.05), call.named.get("a", 1.4))
                return max(time_s, self.end_s())
            case "movel":
                flange = pose_matrix(call.arguments[0]) @ np.linalg.inv(self._flange_T_tcp)
                if not self.move_linear(time_s, flange, call.named.get("v", 0.25)):
                    return None
                return max(time_s, self.end_s())
            case "stopj" | "stopl":
                return self.halt(time_s)
            case "sleep":
                return time_s + call.arguments[0][0]
            case _:
                return None
        return time_s

    # -- dashboard -------------------------------------------------------------------------------

    def command(self, text: str, time_s: float) -> str:
        """The answer of the dashboard server."""
        state, settings = self.state_at(time_s), self.settings
        match text:
            case "robotmode":
                return f"Robotmode: {MODE_NAMES[state.mode]}"
            case "safetystatus":
                return f"Safetystatus: {SAFETY_NAMES[state.safety]}"
            case "safetymode":
                return f"Safetymode: {SAFETY_NAMES[state.safety]}"
            case "get robot model":
                return settings.model
            case "get serial number":
                return settings.serial_number
            case "PolyscopeVersion":
                return settings.polyscope
            case "is in remote control":
                return str(settings.remote).lower()
            case "running":
                return f"Program running: {str(state.program_runs).lower()}"
            case "power on":
                if state.safety == NORMAL and state.mode == POWER_OFF:
                    self._become(time_s, mode=POWER_ON)
                    self._become(time_s + settings.power_s, mode=IDLE)
                return "Powering on"
            case "brake release":
                if state.safety == NORMAL and state.mode == IDLE:
                    self._become(time_s + settings.brake_s, mode=RUNNING)
                return "Brake releasing"
            case "power off":
                self.halt(time_s)
                self._become(time_s, mode=POWER_OFF, program_runs=False)
                return "Powering off"
            case "stop":
                self.halt(time_s)
                self._become(time_s, program_runs=False)
                return "Stopped"
            case "close safety popup":
                return "closing safety popup"
            case "unlock protective stop":
                if time_s < self._stopped_s + UNLOCK_S:
                    return "Cannot unlock protective stop until 5s after occurrence."
                self._become(time_s, safety=NORMAL if self._permitted else ROBOT_EMERGENCY_STOP)
                return "Protective stop releasing"
        return f"could not understand: {text}"


class ScriptSession:
    """A client that sends programs. What the controller says on this port is left out."""

    def __init__(self, robot: UrRobot) -> None:
        self._robot, self._reader = robot, ScriptReader()

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client."""
        for lines in self._reader.feed(data):
            self._robot.run(lines, time_s)

    def next_output_s(self) -> float:
        """Never."""
        return math.inf

    def take(self, time_s: float) -> bytes:
        """Nothing."""
        return b""

    def discard(self, time_s: float) -> None:
        """Nothing."""


class DashboardSession(Answers):
    """A client of the dashboard server: lines, and a greeting before the first."""

    def __init__(self, robot: UrRobot) -> None:
        super().__init__()
        self._robot, self._input = robot, b""
        greeting = b"Connected: Universal Robots Dashboard Server\n"
        self._output.append((-math.inf, greeting))

    def receive(self, data: bytes, time_s: float) -> None:
        """Bytes from the client."""
        self._input += data
        while b"\n" in self._input:
            line, _, self._input = self._input.partition(b"\n")
            answer = self._robot.command(line.decode("utf-8", errors="replace").strip(), time_s)
            self._output.append((time_s + self._robot.settings.answer_s, answer.encode() + b"\n"))
