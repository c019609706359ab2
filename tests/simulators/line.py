"""A host on the line of a simulated byte device: bytes and virtual time."""

from simulators.virtual import ByteDevice


class Host:
    """Sends bytes and waits; nothing else."""

    def __init__(self, device: ByteDevice) -> None:
        self.device, self.time_s = device, 1.0

    def send(self, data: bytes | str) -> None:
        self.device.receive(bytes.fromhex(data) if isinstance(data, str) else data, self.time_s)

    def wait(self, duration_s: float = 0.5) -> bytes:
        """All that comes within this time."""
        end_s, received = self.time_s + duration_s, b""
        while (due_s := self.device.next_output_s()) <= end_s:
            self.time_s = max(self.time_s, due_s)
            received += self.device.take(self.time_s)
        self.time_s = end_s
        return received

    def ask(self, request: bytes | str, duration_s: float = 0.5) -> str:
        """The answer as hexadecimal digits."""
        self.send(request)
        return self.wait(duration_s).hex(" ").upper()
