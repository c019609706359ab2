"""A bare CANopen master for the tests of the simulated arm."""

import struct

from simulators.robots.canopen_arm import COUNT_RAD, Frame, SimulatedArm

SYNC_S = 0.02


class Master:
    """Speaks in bytes, keeps the time, remembers what it hears."""

    def __init__(self, arm: SimulatedArm) -> None:
        self.arm, self.time_s, self.heard = arm, 0.0, list[Frame]()

    def send(self, can_id: int, data: bytes | str = b"") -> None:
        self.arm.receive(can_id, bytes.fromhex(data) if isinstance(data, str) else data, self.time_s)

    def wait(self, duration_s: float) -> list[Frame]:
        self.time_s += duration_s
        fresh = []
        while (frame := self.arm.take(self.time_s)) is not None:
            fresh.append(frame)
        self.heard += fresh
        return fresh

    def sdo(self, node: int, request: str) -> str:
        self.send(0x600 + node, request)
        (answer,) = [frame for frame in self.wait(0.005) if frame.can_id == 0x580 + node]
        return answer.data.hex(" ").upper()

    def write(self, node: int, index: int, sub: int, value: int, size: int) -> str:
        data = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + (value % 2**32).to_bytes(4, "little")
        return self.sdo(node, data.hex())

    def read(self, node: int, index: int, sub: int = 0) -> int:
        answer = bytes.fromhex(self.sdo(node, struct.pack("<BHB4x", 0x40, index, sub).hex()))
        assert answer[0] & 0xE0 == 0x40
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=True)

    def sync(self, count: int = 1) -> list[Frame]:
        frames: list[Frame] = []
        for _ in range(count):
            self.send(0x080)
            frames = self.wait(SYNC_S)
        return frames

    def status(self, node: int) -> int:
        return self.read(node, 0x6041) & 0xFFFF

    def enable(self, node: int = 3) -> None:
        self.write(node, 0x6060, 0, 1, 1)
        for word in (6, 7, 15):
            self.write(node, 0x6040, 0, word, 2)
        self.wait(0.1)
        assert self.status(node) & 0x6F == 0x27

    def move(self, counts: int, speed: int, node: int = 3, word: int = 0x1F) -> None:
        self.write(node, 0x607A, 0, counts, 4)
        self.write(node, 0x6081, 0, speed, 4)
        self.write(node, 0x6040, 0, word, 2)
        self.write(node, 0x6040, 0, word & ~0x10, 2)

    def joint_counts(self, joint: int = 0) -> float:
        self.arm.advance(self.time_s)
        return round(float(self.arm.joints_at(self.time_s)[joint] / COUNT_RAD), 6)
