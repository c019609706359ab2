"""Seeded sessions on a wire with faults: many faults at once, or one whose discovery is timed.

What is true is known from the side of the simulators alone: see `pairs.py`.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tests.conformance.pairs import PAIRS, Pair
from tests.conformance.rig import Rig

FAULTS = ("late", "drop", "duplicate", "reorder", "truncate", "corrupt", "lose-byte", "double-byte", "split")
STORM_PIECES = 3  # of work, while the wire is bad
LATEST_MESSAGE = 12  # of a piece of work that a single fault may hit


def possible(pair: Pair) -> list[str]:
    """The faults that the protocol of this pair can reveal."""
    return [fault for fault in FAULTS if fault not in pair.unseen]


def storm(pair: Pair, seed: int) -> None:
    """Work on a wire with two kinds of faults, then without: no value is wrong, nothing hangs, all heals."""
    rng = np.random.default_rng((seed, 1))
    faults = rng.choice(possible(pair), 2, replace=False).tolist()
    if pair.unseen_together and all(set(kinds) & set(faults) for kinds in pair.unseen_together):
        faults = faults[:1]
    chance, late_s = float(rng.choice([0.01, 0.05, 0.2])), float(rng.uniform(0.0, pair.latest_s))
    if (
        "reorder" in faults
    ):  # it waits for the next message besides; both together must not be later than the worst
        late_s /= 2.0
    play(pair, seed, faults, chance, late_s)


def play(pair: Pair, seed: int, faults: Iterable[str], chance: float, late_s: float) -> None:
    """The same with these faults of each message."""
    rig = Rig(pair, seed, converter=bool(np.random.default_rng(seed).integers(2)))
    rig.driver.connect()
    for link in rig.links:
        for fault in faults:
            link.faults.add(fault, late_s if fault == "late" else None, chance=chance)
    for _ in range(STORM_PIECES):
        if not rig.timed_work():
            rig.release()
    for link in rig.links:
        link.faults.clear()
    rig.heal()


@dataclass(frozen=True)
class Discovery:
    """What became of a single fault."""

    fault: str
    struck: bool
    noticed_s: float = math.nan  # after it struck; nan if nothing was noticed, and nothing was wrong


def single(pair: Pair, seed: int) -> Discovery:
    """One fault in one message of a piece of work: it is noticed in time, or it did no harm at all."""
    rng = np.random.default_rng((seed, 2))
    fault = str(rng.choice(possible(pair)))
    rig = Rig(pair, seed, converter=bool(rng.integers(2)))
    rig.driver.connect()
    rig.work()
    link = rig.links[int(rng.integers(len(rig.links)))]
    value = float(rng.uniform(0.0, pair.latest_s)) if fault == "late" else None
    begun_s = rig.clock.now_s()
    chance = 1.0 / float(rng.integers(1, LATEST_MESSAGE + 1))
    link.faults.add(fault, value, from_s=begun_s + pair.skips_s, chance=chance, once=True)
    rig.watch()
    worked = rig.timed_work()
    ended_s = rig.clock.now_s()
    struck_s, noticed_s = link.faults.struck_s, rig.noticed_s
    if not worked and math.isnan(noticed_s):
        noticed_s = ended_s
    link.faults.clear()
    if not worked:
        assert struck_s >= begun_s, "it failed although nothing had happened"
    rig.heal()
    if struck_s < begun_s:
        return Discovery(fault, False)
    if not math.isnan(noticed_s):
        assert noticed_s - struck_s <= pair.budget_s, f"noticed {noticed_s - struck_s:.3f} s after the fault"
    return Discovery(fault, True, noticed_s - struck_s)


@dataclass
class Tally:
    """What came out of many sessions; the lists are by device."""

    sessions: Counter[str] = field(default_factory=Counter)
    found: defaultdict[str, list[Discovery]] = field(default_factory=lambda: defaultdict(list))
    failures: list[str] = field(default_factory=list)

    def table(self) -> str:
        """One line for each device, in Markdown."""
        lines = ["| Device | Sessions | Single faults | Noticed | Latest after (s) | Budget (s) |"]
        lines.append("| --- " * 6 + "|")
        for pair in PAIRS:
            found = [one for one in self.found[pair.kind] if one.struck]
            times_s = [one.noticed_s for one in found if not math.isnan(one.noticed_s)]
            latest = f"{max(times_s):.3f}" if times_s else ""
            cells = (pair.kind, self.sessions[pair.kind], len(found), len(times_s), latest, pair.budget_s)
            lines.append(f"| {' | '.join(str(cell) for cell in cells)} |")
        return "\n".join(lines)


def sessions(seeds: range) -> Tally:
    """One storm and one single fault in turn, over all pairs."""
    tally = Tally()
    for seed in seeds:
        pair = PAIRS[seed % len(PAIRS)]
        tally.sessions[pair.kind] += 1
        try:
            if seed // len(PAIRS) % 2:
                storm(pair, seed)
            else:
                tally.found[pair.kind].append(single(pair, seed))
        except Exception as error:
            tally.failures.append(f"seed {seed}, {pair.kind}: {error!r:.200}")
    return tally
