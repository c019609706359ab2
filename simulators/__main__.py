"""`python -m simulators CELLDIR`: the devices of a simulated cell, in real time, on real ports."""

import argparse
import sys
from pathlib import Path

from estimation.errors import CellError
from simulators.cell import CellModel
from simulators.serve import CellServer


def main(arguments: list[str] | None = None) -> int:
    """Serve until told to end. Prints "ready" once every port is open."""
    parser = argparse.ArgumentParser(prog="python -m simulators", description=main.__doc__)
    parser.add_argument("cell_dir", type=Path, help="directory with a world.toml")
    parser.add_argument("--run-dir", type=Path, help="where ports, truth.json and control go; CELLDIR/run")
    parser.add_argument("--seed", type=int, default=1, help="of everything that is drawn")
    parser.add_argument("--motion-speed", type=float, default=1.0, help="divides the time of fast moves")
    parser.add_argument("--scenario", default="honest", help="of world.toml")
    parser.add_argument("--probe-port", type=int, help="TCP port of the probe, 0 for any; that of world.toml")
    options = parser.parse_args(arguments)
    run_dir = options.run_dir or options.cell_dir / "run"
    try:
        model = CellModel(
            options.cell_dir,
            options.seed,
            options.scenario,
            motion_speed=options.motion_speed,
            cache_dir=run_dir / "cache",
        )
        CellServer(model, run_dir, options.probe_port).run()
    except (CellError, OSError) as error:
        print(f"simulators: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
