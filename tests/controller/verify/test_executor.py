"""Where work runs changes no result, and errors come back as they are."""

import math

import pytest

from controller.verify.executor import open_executor
from estimation.errors import CellError


def test_results_come_in_order_whoever_runs_them() -> None:
    items = list(range(40))
    expected = [math.factorial(item) for item in items]
    for workers in (1, 2):
        with open_executor(workers=workers) as executor:
            assert executor.workers == workers
            assert list(executor.map(math.factorial, items)) == expected


def test_an_error_of_the_work_is_raised_here() -> None:
    with open_executor(workers=1) as executor, pytest.raises(ValueError, match="negative"):
        list(executor.map(math.factorial, [3, -1]))


def test_a_dask_cluster_gives_the_same() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
        ) as cluster,
        open_executor(cluster.scheduler_address) as executor,
    ):
        assert list(executor.map(math.factorial, [5, 5, 6])) == [120, 120, 720]


@pytest.mark.parametrize("address", ["nonsense://here", "tcp://127.0.0.1:1"])
def test_no_scheduler_is_one_sentence(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("controller.verify.executor.CONNECT_TIMEOUT_S", 0.3)
    with pytest.raises(CellError, match=f"No Dask scheduler at {address}"), open_executor(address):
        pass
