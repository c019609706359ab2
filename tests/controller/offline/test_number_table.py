"""Numbers of many lines: what was written comes back, and a bad line is in the block that is named."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.offline import number_table
from controller.offline.number_table import BadBlock, read_numbers

NUMBER = st.floats(allow_nan=False, allow_infinity=False)
ROWS = st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=1, max_size=30)
NOTHING = st.sampled_from(["", "   ", "# a comment"])


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(number_table, "_BLOCK", 4)


@given(ROWS, st.lists(NOTHING, max_size=9), st.sampled_from([",", ";", "\t", None]), st.randoms())
@settings(max_examples=60, deadline=None, derandomize=True)
def test_numbers_come_back_whatever_stands_between_them(rows, nothing, separator, random) -> None:  # type: ignore[no-untyped-def]
    lines = [(separator or " ").join(map(repr, row)) for row in rows]
    for each in nothing:
        lines.insert(random.randrange(len(lines) + 1), each)
    found = read_numbers(["header", *lines], 1, separator, 3)
    assert isinstance(found, np.ndarray)
    assert found.tolist() == [list(row) for row in rows]


@given(
    ROWS, st.sampled_from(["1,2", "1,2,3,4", "1,x,3", "1,nan,3", "1,2,inf", "1;2;3", "1,,3"]), st.randoms()
)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_a_bad_line_is_in_the_block_that_is_named(rows, bad, random) -> None:  # type: ignore[no-untyped-def]
    lines = [",".join(map(repr, row)) for row in rows]
    place = random.randrange(len(lines) + 1)
    lines.insert(place, bad)
    found = read_numbers(lines, 0, ",", 3)
    assert isinstance(found, BadBlock)
    assert found.start <= place < found.stop
