"""Where the work of a campaign runs: the cores of this computer, or a Dask cluster."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Final, Protocol, TypeVar

from estimation.errors import CellError

Item = TypeVar("Item")
Result = TypeVar("Result")
CONNECT_TIMEOUT_S: Final = 10.0


class Executor(Protocol):
    """Runs one function on many items. The items carry their seeds, so who runs them changes no result."""

    workers: int

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items. An error of the function is raised here."""


class _Local:
    """Processes of this computer, one for each core unless told otherwise."""

    def __init__(self, pool: ProcessPoolExecutor, workers: int) -> None:
        self._pool, self.workers = pool, workers

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        return self._pool.map(function, items)


class _Dask:
    """Workers of a cluster, which need this version of truecell."""

    def __init__(self, client: object) -> None:
        self._client = client
        self.workers = len(client.scheduler_info()["workers"])  # type: ignore[attr-defined]

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        # pure=False: equal items are work of their own, never an answer from the cache
        futures = self._client.map(function, list(items), pure=False)  # type: ignore[attr-defined]
        for future in futures:
            yield future.result()


@contextmanager
def open_executor(scheduler: str | None = None, workers: int | None = None) -> Iterator[Executor]:
    """The executor at a Dask scheduler's address ("tcp://host:8786"), or this computer's cores.

    Raises CellError when there is no scheduler at that address, or the extra `scale` is not installed.
    """
    if scheduler is None:
        count = workers or os.cpu_count() or 1
        pool = ProcessPoolExecutor(
            count,
            # nothing of this process, its threads and open files, goes into the workers
            mp_context=get_context("forkserver"),
            # Ctrl-C is for this process alone, which then tells its workers
            initializer=signal.signal,
            initargs=(signal.SIGINT, signal.SIG_IGN),
        )
        try:
            yield _Local(pool, count)
        finally:
            pool.shutdown(cancel_futures=True)
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise CellError(
            "Dask is not installed here", "Install truecell with its extra: pip install truecell[scale]"
        ) from error
    try:
        client = Client(scheduler, timeout=CONNECT_TIMEOUT_S)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise CellError(
            f"No Dask scheduler at {scheduler}: {error}", "Give an address such as tcp://host:8786"
        ) from error
    with client:
        yield _Dask(client)
