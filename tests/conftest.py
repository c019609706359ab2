"""For every test: one thread of linear algebra, as in the daemon; the longest files first; figures last.

Campaigns may take hours, other tests have the limit of pyproject.toml or their own.
"""

import os

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Workers take whole files in this order, so that none is left with a long one at the end. It needs
# --no-loadscope-reorder: by itself xdist begins with the files of many tests, which are short ones.
LONGEST_FIRST = ("test_many_cells", "test_kill", "test_wires", "test_scenarios", "test_real_wires")
CAMPAIGN_LIMIT_S = 6 * 3600


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Stable: within a file, and among the short ones, the order stays."""

    def place(item: pytest.Item) -> int:
        name = item.path.stem
        return LONGEST_FIRST.index(name) if name in LONGEST_FIRST else len(LONGEST_FIRST)

    items.sort(key=place)
    for item in items:
        if item.get_closest_marker("campaign"):
            item.add_marker(pytest.mark.timeout(CAMPAIGN_LIMIT_S), append=False)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The figures that tests have recorded, for docs/evidence.md."""
    for outcome in ("passed", "failed"):
        for report in terminalreporter.getreports(outcome):
            for name, value in report.user_properties:
                terminalreporter.write_line(f"{name}: {value}")
