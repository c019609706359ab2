"""Checks of the job: order, names and budgets of its phases."""

from collections.abc import Callable, Iterator
from typing import Final

from controller.cellfile.job import CheckPhase, HandEyePhase, Job, LocalizePhase
from controller.cellfile.lasers import Laser
from controller.cellfile.lines import KeyPath
from controller.cellfile.mistakes import nearest
from controller.cellfile.objects import Part
from controller.cellfile.part_checks import repeated
from controller.quantities import format_length

Finding = tuple[KeyPath, str, str]

# A phase of the kind on the right uses what the one on the left has found.
FOLLOWS: Final = (("noise", "hand_eye"), ("hand_eye", "localize"), ("localize", "inspect"))
NEEDED: Final = {"localize": "hand_eye", "inspect": "localize"}
# What a check must say, by the kind of the phase that it checks.
CHECK_KEYS: Final = {"hand_eye": ("points_per_sphere", "plate_poses"), "localize": ("points",)}
IN_WORDS: Final = {"hand_eye": "hand-eye", "localize": "localization"}


def phase_names(job: Job) -> Iterator[Finding]:
    """Phases have names of their own."""
    yield from repeated(("job", "phases"), "name", [phase.name for phase in job.phases])


def order(job: Job) -> Iterator[Finding]:
    """Nothing is used before it was found, and nothing is found twice."""
    kinds = [phase.kind for phase in job.phases]
    for index, kind in enumerate(kinds):
        path = ("job", "phases", index, "kind")
        if (needed := NEEDED.get(kind)) is not None and needed not in kinds:
            yield path, f"needs a phase of kind {needed} before it", "add one"
        for first, second in FOLLOWS:
            if kind == first and second in kinds[:index]:
                yield path, f"must stand before the phase of kind {second}", "move it up"
        if kind in ("hand_eye", "localize", "inspect") and kind in kinds[:index]:
            yield path, "this kind stands in the job already", "remove one of them"


def checks(job: Job) -> Iterator[Finding]:
    """A check names an earlier phase, says what to measure, and comes before its result is used."""
    earlier: dict[str, str] = {}
    for index, phase in enumerate(job.phases):
        if isinstance(phase, CheckPhase):
            yield from _check(phase, index, earlier, [later.name for later in job.phases[index:]])
        earlier.setdefault(phase.name, phase.kind)


def _check(phase: CheckPhase, index: int, earlier: dict[str, str], later: list[str]) -> Iterator[Finding]:
    path: KeyPath = ("job", "phases", index)
    checkable = [name for name, kind in earlier.items() if kind in CHECK_KEYS]
    if phase.of not in earlier:
        reason = "this phase does not come before it" if phase.of in later else "no such phase"
        yield (*path, "of"), reason, nearest(phase.of, checkable)
        return
    kind = earlier[phase.of]
    if kind not in CHECK_KEYS:
        yield (*path, "of"), f"a phase of kind {kind} cannot be checked", nearest(phase.of, checkable)
        return
    users = [user for user, needed in NEEDED.items() if needed == kind and user in earlier.values()]
    if users:
        yield (
            (*path, "kind"),
            f"must stand before the phase of kind {users[0]}, which uses the result",
            "move it up",
        )
    for of_kind, keys in CHECK_KEYS.items():
        for key in keys:
            given = getattr(phase, key)
            if of_kind == kind and not given:
                yield (*path, key), f"a check of a {IN_WORDS[kind]} needs it", f"write for example {key} = 8"
            elif of_kind != kind and given:
                yield (*path, key), f"a check of a {IN_WORDS[kind]} does not have it", "remove it"


def budgets(job: Job) -> Iterator[Finding]:
    """The budget is at least what is planned."""
    for index, phase in enumerate(job.phases):
        if isinstance(phase, HandEyePhase | LocalizePhase) and phase.most_measurements < phase.measurements:
            yield (
                ("job", "phases", index, "most_measurements"),
                f"less than measurements ({phase.measurements})",
                "write at least that",
            )


def gated_ranges(job: Job, laser: Laser) -> Iterator[Finding]:
    """The uncertainty is gated where the laser may measure."""
    shortest_m, longest_m = laser.working_range_m
    for index, phase in enumerate(job.phases):
        for position, range_m in enumerate(phase.gated_ranges_m if isinstance(phase, HandEyePhase) else ()):
            if shortest_m < longest_m and not shortest_m <= range_m <= longest_m:
                yield (
                    ("job", "phases", index, "gated_ranges", position),
                    "outside the working range of the laser",
                    f"write {format_length(shortest_m)} to {format_length(longest_m)}",
                )


def faces(job: Job, part: Part) -> Iterator[Finding]:
    """Localization measures features of the part, each once."""
    known = [feature.name for feature in part.features]
    for index, phase in enumerate(job.phases):
        named = phase.faces if isinstance(phase, LocalizePhase) else ()
        for position, face in enumerate(named):
            path = ("job", "phases", index, "faces", position)
            if face not in known:
                yield path, "no such feature", nearest(face, known)
            elif face in named[:position]:
                yield path, "stands twice", "remove one of them"


def inspection(job: Job, part: Part) -> Iterator[Finding]:
    """An inspection has something to inspect."""
    for index, phase in enumerate(job.phases):
        if phase.kind == "inspect" and not part.characteristics:
            yield (
                ("job", "phases", index, "kind"),
                "the part has no characteristics",
                "add [[part.characteristics]]",
            )


CHECKS: Final[tuple[Callable[..., Iterator[Finding]], ...]] = (
    phase_names,
    order,
    checks,
    budgets,
    gated_ranges,
    faces,
    inspection,
)
