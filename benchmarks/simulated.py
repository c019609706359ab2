"""A simulated device in a process of its own."""

import contextlib
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path


@contextlib.contextmanager
def simulated_device(kind: str, port: Path, settings: Mapping[str, object] | None = None) -> Iterator[None]:
    """The device at this port while the block runs."""
    command = [sys.executable, "-m", "simulators", "--device", kind, "--port", str(port)]
    for key, value in (settings or {}).items():
        command += ["--set", f"{key}={value}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as simulator:
        try:
            assert simulator.stdout is not None
            while simulator.stdout.readline() != "ready\n":
                if simulator.poll() is not None:
                    raise RuntimeError(f"The simulated {kind} has not started")
            yield
        finally:
            simulator.terminate()
