"""Reports on demand, written where the daemon keeps them."""

from pathlib import Path

from controller.daemon.api import Reporter
from controller.store import RecordNotFound, Store
from drivers.clock import RealClock
from estimation.errors import StoreError


def reporter(store: Store, folder: Path) -> Reporter:
    """Writes the report of a run into `folder`; returns the paths."""

    def write(run: int | None) -> list[Path]:
        from controller.report import write_report  # plots and PDF: only when somebody asks

        newest = store.runs(1)
        if run is None and not newest:
            raise RecordNotFound("There is no run yet", "Start the job first")
        try:
            paths = write_report(store, newest[0].id if run is None else run, folder, RealClock().utc_s())
        except OSError as error:
            problem = f"Report not written to {folder}: {error.strerror}"
            raise StoreError(problem, "Check that folder") from error
        return [path for path in (paths.html, paths.pdf) if path is not None]

    return write
