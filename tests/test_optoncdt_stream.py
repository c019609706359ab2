"""Ten minutes of the optoNCDT's fastest stream over a real port."""

import numpy as np
import pytest

from benchmarks.optoncdt_stream import RANGE_M, missing, stream

DURATION_S = 600


@pytest.mark.campaign
@pytest.mark.wire
def test_no_value_is_lost_and_a_tenth_of_a_core_reads_them() -> None:
    seen = stream(DURATION_S)
    print(seen)
    assert seen.lost == 0 and seen.bad_frames == 0
    assert seen.cpu_share < 0.1


def test_the_count_finds_what_is_lost_also_where_the_target_begins_again() -> None:
    number = np.delete(np.arange(40_000), [5, 6, 15_999, 32_000])
    assert missing(np.rint(number / 16_000 % 1.0 * 64_000) / 64_000 * RANGE_M) == 4
