"""Seeded sessions over all drivers: late, lost, doubled, reordered, cut and corrupted messages."""

import os

import pytest

from tests.conformance.sessions import sessions


def test_seeded_sessions() -> None:
    assert sessions(range(320)).failures == []


@pytest.mark.campaign
def test_fifty_thousand_seeded_sessions() -> None:
    """TRUECELL_SEEDS=0-10000 runs a part of them."""
    first, last = os.environ.get("TRUECELL_SEEDS", "0-50000").split("-")
    tally = sessions(range(int(first), int(last)))
    print(tally.table())
    assert tally.failures == []
