"""Six joints over a real slcan port for a minute: no reading is late."""

import numpy as np
import pytest

from benchmarks.slcan_sync import regularity

LONGEST_GAP_S = 0.060


@pytest.mark.campaign
@pytest.mark.wire
def test_no_gap_is_longer_than_three_periods_of_sync() -> None:
    seen = regularity(60.0)
    print(seen)
    assert seen.gaps_s.sum() > 59.0 and seen.bad_frames == 0
    assert np.max(seen.gaps_s) <= LONGEST_GAP_S
    assert np.median(seen.gaps_s) == pytest.approx(seen.period_s, rel=0.05)
