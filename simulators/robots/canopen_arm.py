"""Six drives on one CAN bus: the arm as its master sees it."""

import math
from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np

from estimation.transform import FloatArray
from simulators.interfaces import Frame
from simulators.robots.drive import Drive, DriveSettings
from simulators.robots.mechanism import MechanicalArm, reading_noise
from simulators.world.world_file import ArmSpec

COUNT_RAD: Final = math.pi / 180 / 1000  # the arm counts thousandths of a degree
DONGLE_S: Final = 0.001  # the CAN dongle hands frames over in bursts: all answers to a SYNC come together
NMT_RESET_NODE: Final = 0x81
REPLY_S: Final = 0.0004  # an SDO server thinks


class SimulatedArm(MechanicalArm):
    """The bus end of the arm. Time only moves forward, by `advance` or with a frame from the master.

    `noise_factors` (n,) multiply the noise of each joint's readings; `motion_speed` shortens fast moves.
    """

    def __init__(
        self,
        spec: ArmSpec,
        rng: np.random.Generator,
        noise_factors: FloatArray | None = None,
        motion_speed: float = 1.0,
    ) -> None:
        self._spec = spec
        self._rng = rng
        self._output: deque[Frame] = deque()
        self._motion_speed = motion_speed
        factors = np.ones(len(spec.nodes)) if noise_factors is None else np.asarray(noise_factors)
        self.drives = [self._drive(joint, float(factors[joint])) for joint in range(len(spec.nodes))]
        super().__init__([drive.motion for drive in self.drives], COUNT_RAD)
        self._by_node = dict(zip(spec.nodes, self.drives, strict=True))
        self._next_event_s = math.inf
        self._receivers: dict[int, Drive] = {}
        self._settings_changed()

    def _drive(self, joint: int, noise_factor: float) -> Drive:
        spec, link = self._spec, self._spec.links[joint]
        settings = DriveSettings(
            node=spec.nodes[joint],
            device_name=spec.device_name,
            serial_number=spec.serial_number + joint,
            limits_counts=(round(link.lower_rad / COUNT_RAD), round(link.upper_rad / COUNT_RAD)),
            speed_limit=spec.speed_limit_rad_s / COUNT_RAD,
            acceleration=spec.acceleration_rad_s2 / COUNT_RAD,
            quick_stop=spec.quick_stop_rad_s2 / COUNT_RAD,
            step_counts=spec.encoder_step_rad / COUNT_RAD,
            enable_delay_s=spec.enable_delay_s,
            boot_time_s=spec.boot_time_s,
        )
        start = float(spec.start_joints_rad[joint]) / COUNT_RAD
        noise = reading_noise(self._rng, noise_factor * spec.noise_rad / COUNT_RAD)
        return Drive(settings, start, noise, self._emit)

    # -- bus -------------------------------------------------------------------------------------

    def _emit(self, time_s: float, can_id: int, data: bytes) -> None:
        self._output.append(Frame(can_id, data, self._handed_over_s(time_s)))

    def _handed_over_s(self, time_s: float) -> float:
        """When the dongle hands over what is on the bus at `time_s`."""
        output = self._output
        time_s += DONGLE_S
        return output[-1].time_s if output and output[-1].time_s > time_s else time_s

    def next_output_s(self) -> float:
        """Nothing comes from the arm before this, if the master stays silent."""
        return self._output[0].time_s if self._output else self._next_event_s

    def advance(self, time_s: float) -> None:
        """Let everything happen that is due by then."""
        if time_s < self._next_event_s:
            return
        for drive in self.drives:
            if drive.next_event_s <= time_s:
                drive.advance(time_s)
        self._schedule()

    def _schedule(self) -> None:
        self._next_event_s = min([drive.next_event_s for drive in self.drives])

    def next_frames(self, until_s: float) -> list[Frame]:
        """The frames that come together next, if that is by then; everything before has happened."""
        output = self._output
        while not output or output[0].time_s >= self._next_event_s:
            if self._next_event_s > until_s:
                return []
            self.advance(self._next_event_s)
        first_s = output[0].time_s
        together = list[Frame]()
        if first_s <= until_s:
            while output and output[0].time_s == first_s:
                together.append(output.popleft())
        return together

    def take(self, time_s: float) -> Frame | None:
        """The oldest frame that was on the bus by then."""
        if time_s >= self._next_event_s:
            self.advance(time_s)
        return self._output.popleft() if self._output and self._output[0].time_s <= time_s else None

    def receive(self, can_id: int, data: bytes, time_s: float) -> None:
        """A frame from the master."""
        self.advance(time_s)
        if can_id == 0x080:
            self._sync(time_s)
            return
        elif can_id in self._receivers:
            drive = self._receivers[can_id]
            if drive.receive(can_id, data, time_s):
                self._start([drive])
            if drive.next_event_s < self._next_event_s:
                self._next_event_s = drive.next_event_s
            return
        elif can_id >> 7 == 0x600 >> 7:
            self._request(can_id & 0x7F, data, time_s)
        elif can_id == 0x000 and len(data) == 2:
            for node, drive in self._by_node.items():
                if data[1] in (0, node):
                    drive.network(data[0], time_s)
            self._settings_changed()
        elif can_id >> 7 == 0x700 >> 7:
            for drive in self.drives:
                drive.heartbeat(can_id & 0x7F, time_s)
        else:
            return
        self._schedule()

    def _sync(self, time_s: float) -> None:
        output, handed_over_s = self._output, self._handed_over_s(time_s)
        for drive in self.drives:
            for can_id, data in drive.answer_sync(time_s):
                output.append(Frame(can_id, data, handed_over_s))
        waiting = [drive for drive in self.drives if drive.awaits_sync]
        if waiting:
            starting = [drive for drive in waiting if drive.sync_apply()]
            if starting:
                self._start(starting)
            self._schedule()

    def _start(self, drives: list[Drive]) -> None:
        """Drives that start at one instant are one move: all of it is sped up, or none."""
        fastest = max(drive.waiting_speed for drive in drives)
        fast = fastest * COUNT_RAD >= self._spec.fast_move_rad_s
        for drive in drives:
            drive.start_move(self._motion_speed if fast else 1.0)

    def _request(self, node: int, data: bytes, time_s: float) -> None:
        drive = self._by_node.get(node)
        if drive is None:
            return
        answer = drive.request(data, time_s)
        if answer:
            self._emit(time_s + REPLY_S, 0x580 + node, answer)
        self._settings_changed()

    def _settings_changed(self) -> None:
        self._receivers = {can_id: drive for drive in self.drives for can_id in drive.receive_ids}

    def permit(self, permitted: bool, time_s: float) -> None:
        """Give or take the run permission (emergency stop, guard door)."""
        self.advance(time_s)
        for drive in self.drives:
            drive.permit(permitted, time_s)
        self._schedule()

    def restart(self, time_s: float) -> None:
        """The supply of all drives drops for a moment: they boot, and run-time settings are gone."""
        self.advance(time_s)
        for drive in self.drives:
            drive.network(NMT_RESET_NODE, time_s)
        self._settings_changed()
        self._schedule()

    def wire_touch_inputs(self, first_closing: Callable[[float, float], float | None]) -> None:
        """Wire a contact to a touch-probe input of every drive, which those of the PRBT do not have."""
        for drive in self.drives:
            drive.wire_touch_input(first_closing)

    def fault(self, joint: int, code: int, time_s: float) -> None:
        """Let one drive fail; the others do not notice."""
        self.advance(time_s)
        self.drives[joint].fault(code, 0x21)
        self._schedule()
