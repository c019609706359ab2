"""`python -m simulators`: the devices of a cell, or one device alone, in real time on real ports."""

import argparse
import gc
import signal
import sys
from pathlib import Path

from estimation.errors import CellError, CellFileError

BAD_INPUT, FAULT = 2, 7  # exit codes, as docs/console.md has them

EXAMPLES = """
  truecell simulate cells/bench-block --seed 7 --motion-speed 20
  truecell simulate --device optoncdt-1420 --port ./laser --fault late:0.3@5s --fault corrupt%2
  truecell simulate --device adam-6052 --port 5502 --set channel=3
  truecell simulate --list
"""


def main(arguments: list[str] | None = None) -> int:
    """Serve until told to end. Prints "ready" once every port is open."""
    options = _parser().parse_args(arguments)
    try:
        if options.list:
            from simulators.alone import list_devices

            print(list_devices())
        elif options.device is not None:
            _serve_device(options)
        else:
            _serve_cell(options)
    except CellFileError as error:
        print(f"simulators: {error}", file=sys.stderr)
        return BAD_INPUT
    except (CellError, OSError) as error:
        print(f"simulators: {error}", file=sys.stderr)
        return FAULT
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="truecell simulate",
        description=main.__doc__,
        epilog=f"examples:{EXAMPLES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("cell", type=Path, nargs="?", help="the cell file, or its folder with a world.toml")
    what.add_argument("--device", metavar="NAME", help="one device alone")
    what.add_argument("--list", action="store_true", help="show all devices, their settings and all faults")
    parser.add_argument("--seed", type=int, default=1, help="of everything that is drawn")
    cell = parser.add_argument_group("a cell")
    cell.add_argument(
        "--run-dir",
        type=Path,
        help="for truth.json and the control socket; run in the folder of the cell",
    )
    cell.add_argument("--motion-speed", type=float, default=1.0, help="divides the time of fast moves")
    cell.add_argument("--scenario", default="honest", help="of world.toml")
    alone = parser.add_argument_group("one device")
    alone.add_argument(
        "--port",
        action="append",
        default=[],
        help="path of the serial port or slcan dongle, or TCP port (SOCKET=PORT for a further one)",
    )
    alone.add_argument("--host", default="127.0.0.1", help="address to listen at")
    alone.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting; see --list"
    )
    alone.add_argument("--control", type=Path, metavar="PATH", help="of a socket to make things happen by")
    alone.add_argument("--fault", action="append", default=[], help="what goes wrong; see --list")
    alone.add_argument("--faults", type=Path, metavar="FILE", help='TOML: faults = ["late:0.3@5s", ...]')
    return parser


def _serve_cell(options: argparse.Namespace) -> None:
    from simulators.cell import CellModel
    from simulators.endpoints import read_endpoints
    from simulators.serve import CellServer

    cell_file = options.cell / "cell.toml" if options.cell.is_dir() else options.cell
    devices = read_endpoints(cell_file)
    run_dir = options.run_dir or cell_file.parent / "run"
    model = CellModel(
        cell_file.parent,
        options.seed,
        options.scenario,
        motion_speed=options.motion_speed,
        cache_dir=run_dir / "cache",
        robot=devices["robot"].driver,
        laser=devices["laser"].driver,
        probe=devices["probe"].driver,
    )
    server = CellServer(model, devices, run_dir)
    _keep_modules()
    server.run()


def _serve_device(options: argparse.Namespace) -> None:
    from simulators.alone import DeviceServer, read_ports, read_schedule, read_settings
    from simulators.registry import device_kind
    from simulators.station import Endpoint

    kind = device_kind(options.device)
    server = DeviceServer(
        kind,
        read_settings(kind, options.set),
        Endpoint(read_ports(options.port), options.host),
        read_schedule(options.fault, options.faults),
        options.seed,
        options.control,
    )
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: server.loop.quit())
    _keep_modules()
    for socket, where in server.station.where.items():
        print(f"{kind.name} {socket} at {where}".replace("  ", " "))
    print("ready", flush=True)
    server.run()


def _keep_modules() -> None:
    """From now on, collections of garbage leave out what is there already: they would last 30 ms and more."""
    gc.collect()
    gc.freeze()


if __name__ == "__main__":
    sys.exit(main())
