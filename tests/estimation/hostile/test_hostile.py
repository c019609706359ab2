"""Hostile data are refused or flagged with their cause, and sound data are not; in CI a few draws of each."""

from collections import Counter

import pytest

from estimation.tasks.findings import Cause, Status
from tests.estimation.hostile.campaign import hostile, sound, table
from tests.estimation.hostile.kinds import ALL, KINDS, LOCALIZATION, OF_PLACES, Kind

SLOW = (Cause.SWAPPED_JOINTS, Cause.WRONG_SURFACE, Cause.WRONG_UNITS, Cause.INVERTED)
by_kind = pytest.mark.parametrize(
    "kind",
    KINDS + OF_PLACES,
    ids=lambda kind: kind.cause.name + "-of-localization" * (kind in OF_PLACES),
)


def test_there_are_twenty_kinds() -> None:
    assert len({kind.cause for kind in KINDS}) == len(KINDS) == 20


@by_kind
def test_hostile_data_are_recognised(kind: Kind) -> None:
    draws = hostile(kind, 1 if kind.cause in SLOW else 5, first=1000)
    assert [draw for draw in draws if draw.wrong] == []


@pytest.mark.campaign
@by_kind
def test_two_hundred_draws_of_hostile_data(kind: Kind) -> None:
    draws = hostile(kind, 200)
    print(table([(kind.cause.value, draws)])[-1])
    assert [draw for draw in draws if draw.wrong] == []


@pytest.mark.campaign
def test_four_thousand_sound_sets() -> None:
    draws = sound(4000)
    for task in ALL:
        print(table([(task, [draw for draw in draws if draw.task == task])])[-1])
    refused = [draw for draw in draws if draw.status is Status.REFUSED]
    print(Counter(cause.value for draw in refused for cause in draw.causes))
    assert len(refused) <= 40
    assert [draw for draw in draws if draw.wrong and draw.status is not Status.REFUSED] == []


def test_sound_localizations_pass() -> None:
    assert [draw for draw in sound(5, first=1000, names=(LOCALIZATION,)) if draw.wrong] == []


@pytest.mark.campaign
def test_four_hundred_sound_localizations() -> None:
    draws = sound(400, names=(LOCALIZATION,))
    print(table([(LOCALIZATION, draws)])[-1])
    assert [draw for draw in draws if draw.wrong] == []
