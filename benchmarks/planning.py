"""24 of 100,000 candidates for a pose, against the greedy choice that one writes in numpy."""

from benchmarks.choice_speed import COUNT, box, plain_greedy
from benchmarks.harness import Row, medians, peak_mb
from estimation.design import CRITERIA, DesignProblem, choose

TITLE = "Planning"
WORDS = (
    "D criterion of the pose of a box; cost is the criterion, the geometric mean of the "
    "variances, lower is better. Ours whitens the candidates each time."
)


def rows() -> list[Row]:
    """Greedy alone, and with exchanges."""
    out = []
    _, plain = plain_greedy(box(1), COUNT)
    problem = box(1)

    def peer() -> object:
        return plain_greedy(problem, COUNT)

    for name, exchanges in (("greedy", 0), ("greedy and exchanges", 2)):
        fresh = [box(1) for _ in range(10)]  # nothing cached

        def ours(exchanges: int = exchanges, fresh: list[DesignProblem] = fresh) -> object:
            return choose(fresh.pop(), COUNT, CRITERIA["D"], exchanges)

        peer_s, ours_s = medians(peer, ours)
        value = choose(box(1), COUNT, CRITERIA["D"], exchanges).value
        out.append(
            Row(
                f"24 of 100,000, {name}",
                "numpy, rank-one updates",
                5.0 if not exchanges else None,
                peer_s,
                ours_s,
                peak_mb(peer),
                peak_mb(ours),
                cost_excess=value / plain - 1.0,
            )
        )
        print(out[-1], flush=True)
    return out
