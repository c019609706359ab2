"""Two robots to one base: base1_T_base2 from an object that both have measured, each with its own sensor."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from estimation.belief import POSE_FREEDOMS, Belief, Value
from estimation.errors import DegenerateGeometry, EstimationError
from estimation.model import values_of, vector_of
from estimation.surfaces import Feature
from estimation.tasks import checks
from estimation.tasks.camera import MarkerTask
from estimation.tasks.closed_forms import inverse
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.pairs import PosePairs
from estimation.tasks.sensing import SensorTask
from estimation.tasks.solve import Minimum, Result, descents, solve
from estimation.tasks.starts import nearest_rotation
from estimation.tasks.two_chains import OTHER_BASE, Names, TwoChains, merged, with_base
from estimation.transform import FloatArray, Transform

_MOST_ALONE: Final = 3  # solutions of one robot that are tried with those of the other
_FEWEST_MARKERS: Final = 3

Half = SensorTask | PosePairs


@dataclass(frozen=True, eq=False, kw_only=True)
class TwoRobots:
    """Both robots measure the same object, which stands still; what each task knows of its sensor, it keeps.

    A mount that is known from an earlier calibration is the prior of its task (`mount`, with `mount_std` or
    `mount_covariance`); without one it is calibrated along. Errors of the object (certificate, form, markers)
    are one unknown for both robots.

    Attributes
    ----------
    first, second : `PointLaserOnPlanes`, `TouchOnPlanes`, `CameraHandEye` or `PosePairs`, of the same object.
    same_sensor : one sensor was carried from one robot to the other, so that its scale, offset or ball are
        one unknown.
    """

    first: Half
    second: Half
    same_sensor: bool = False

    task: ClassVar[str] = "two-robots"

    @property
    def halves(self) -> tuple[Half, Half]:
        """The two tasks."""
        return self.first, self.second

    @cached_property
    def names(self) -> tuple[Names, Names]:
        """How each task's blocks are called here."""
        begin = tuple(prefix for half in self.halves for prefix in self._shared_prefixes(half))
        shared = frozenset(
            name
            for half in self.halves
            for name in half.belief().names
            if name.startswith(begin) or name == _markers(half)
        )
        first, second = self.halves
        return Names(1, first.sensor, shared | {first.object}), Names(2, second.sensor, shared)

    def _shared_prefixes(self, half: Half) -> tuple[str, ...]:
        of_sensor = (f"{half.sensor}.",) if self.same_sensor else ()
        return (f"{half.object}.", "form.", *of_sensor)

    @property
    def objects(self) -> tuple[str, str]:
        """Blocks of the object in either base."""
        return self.names[0](self.first.object), self.names[1](self.second.object)

    @property
    def consider(self) -> tuple[str, ...]:
        """Shared errors that either task considers only."""
        named = [
            name(each) for name, half in zip(self.names, self.halves, strict=True) for each in half.consider
        ]
        return tuple(dict.fromkeys(named))

    def check(self) -> Sequence[Finding]:
        """Everything wrong at sight; an empty list for sound data."""
        return checks.first_of(self._check_halves, self._check_object, self._check_count)

    def _check_halves(self) -> list[Finding]:
        found = []
        for number, half in enumerate(self.halves, 1):
            # Whether there are enough measurements is for both together to say.
            own = [finding for finding in half.check() if finding.cause is not Cause.TOO_FEW]
            found += [_of_robot(number, finding) for finding in own]
        return found

    def _check_object(self) -> list[Finding]:
        found = []
        for number, half in enumerate(self.halves, 1):
            if half.beside:
                problem = f"Robot {number} carries the object, which must stand still"
                found.append(Finding(Cause.WRONG_SHAPE, problem, "Measure it with sensors on the robots"))
            elif isinstance(half, SensorTask) and not _places(half):
                problem = f"The object of {half.task} leaves freedoms of the other base open"
                remedy = "Measure a part with three faces, three markers, or poses"
                found.append(Finding(Cause.SYMMETRIC, problem, remedy))
        if not found and _object(self.first) != _object(self.second):
            found.append(
                Finding(
                    Cause.WRONG_SURFACE,
                    "The two robots have not measured the same object",
                    "Give both tasks the same faces or markers, in the same frame and order",
                )
            )
        if self.same_sensor and (type(self.first), _sensor(self.first)) != (
            type(self.second),
            _sensor(self.second),
        ):
            problem = "Both are said to have used one sensor, but what is known of it differs"
            found.append(Finding(Cause.WRONG_SHAPE, problem, "Give both the same, or say that there are two"))
        return found

    def _check_count(self) -> list[Finding]:
        return checks.count(len(self.model()), int(self.rough().flat.sum()))

    def belief(self) -> Belief:
        return self._merged(self.first.belief(), self.second.belief())

    def rough(self) -> Belief:
        return self._merged(self.first.rough(), self.second.rough())

    def _merged(self, first: Belief, second: Belief) -> Belief:
        if self._unknown_markers:
            # They are estimated in the first base; where that is in the second has to be found.
            object = self.second.object
            second = second.without([object])
            second = second.with_block(object, Transform("base", object, np.eye(4)), std=np.inf)
        return merged(first, second, self.names)

    @property
    def _unknown_markers(self) -> bool:
        return isinstance(self.first, MarkerTask) and self.first.markers_m is None

    def model(self) -> TwoChains:
        blocks = [
            {
                block.name: 0 if isinstance(block.value, Transform) else block.value.size
                for block in half.belief().blocks
            }
            for half in self.halves
        ]
        models = self.first.model(), self.second.model()
        return TwoChains(models, self.names, (blocks[0], blocks[1]))

    def starts(self) -> Sequence[Mapping[str, Value]]:
        """Solutions of each robot alone, each with each."""
        alone = [_alone(half) for half in self.halves]
        for number, (found, reason) in enumerate(alone, 1):
            if not found:
                raise type(reason)(f"Robot {number}: {reason.problem}", reason.remedy)
        pairs = sorted(product(*(found for found, _ in alone)), key=lambda pair: pair[0].cost + pair[1].cost)
        return [self._joined(first.values, second.values) for first, second in pairs]

    def _joined(self, first: Mapping[str, Value], second: Mapping[str, Value]) -> dict[str, Value]:
        """A start from values of each robot's flat blocks."""
        joined = {
            self.names[i](name): self.names[i].value(value)
            for i, values in ((1, second), (0, first))
            for name, value in values.items()
        }
        if self._unknown_markers:
            bases, joined[_markers(self.first)] = self._from_markers(first, second)
            joined[self.objects[1]] = Transform("base2", self.second.object, inverse(bases))
        return joined

    def _from_markers(
        self, first: Mapping[str, Value], second: Mapping[str, Value]
    ) -> tuple[FloatArray, FloatArray]:
        """base1_T_base2 (4, 4) by the markers that both have seen, and all of them in base1 (3 n,)."""
        assert isinstance(self.first, MarkerTask) and isinstance(self.second, MarkerTask)
        here = vector_of(first, self.first.markers).reshape(-1, 3)
        there = vector_of(second, self.second.markers).reshape(-1, 3)
        both = np.intersect1d(self.first.marker_index, self.second.marker_index)
        middle, other = here[both].mean(axis=0), there[both].mean(axis=0)
        bases = np.eye(4)
        bases[:3, :3] = nearest_rotation((here[both] - middle).T @ (there[both] - other))
        bases[:3, 3] = middle - bases[:3, :3] @ other
        markers = np.zeros((max(len(here), len(there)), 3))
        markers[: len(there)] = there @ bases[:3, :3].T + bases[:3, 3]
        seen = np.unique(self.first.marker_index)
        markers[seen] = here[seen]
        return bases, markers.reshape(-1)

    def settled(self, values: Mapping[str, Value]) -> Mapping[str, Value]:
        """Each sensor as its own task settles it; the object spins about nothing."""
        everything = {**values_of(self.rough()), **values}
        settled = dict(values)
        model = self.model()
        for robot, half in enumerate(self.halves):
            called = self.names[robot](half.sensor)
            if called in values:
                own = half.settled({half.sensor: model.local(everything, robot)[half.sensor]})
                settled[called] = self.names[robot].value(own[half.sensor])
        return settled

    def explanations(self) -> Sequence[tuple[Finding, "TwoRobots"]]:
        """Mistakes with the data of one robot."""
        found: list[tuple[Finding, TwoRobots]] = []
        for number, name in enumerate(("first", "second"), 1):
            for finding, other in getattr(self, name).explanations():
                changed: dict[str, Any] = {name: other}
                found.append((_of_robot(number, finding), replace(self, **changed)))
        return found

    def diagnose(self, values: Mapping[str, Value], rejected: NDArray[np.bool_] | None) -> list[Finding]:
        """What each task says of its own measurements."""
        model, found = self.model(), []
        counts = [len(each) for each in model.models]
        everything = {**values_of(self.belief()), **values}
        for robot, half in enumerate(self.halves):
            place = slice(robot * counts[0], robot * counts[0] + counts[robot])
            own = None if rejected is None else rejected[place]
            said = half.diagnose(model.local(everything, robot), own)
            found += [_of_robot(robot + 1, finding) for finding in said]
        return found


def join(problem: TwoRobots, explain: bool = True) -> Result:
    """The result, with base1_T_base2 as block "base2" in the place of the object in the second base."""
    result = solve(problem, explain)
    if result.estimate is None:
        return result
    one, other = problem.objects
    belief = with_base(result.belief, one, other)
    shown = (OTHER_BASE, *(name for name in result.shown if name != other))
    return replace(result, estimate=replace(result.estimate, belief=belief), shown=shown)


def _alone(half: Half) -> tuple[list[Minimum], EstimationError]:
    """The best solutions of one robot, lowest cost first; or why there is none."""
    try:
        model = half.model()
        found, reason = descents(half, model, half.starts(), np.ones(len(model), dtype=np.bool_))
    except DegenerateGeometry as error:
        return [], error
    return found[:_MOST_ALONE], reason


def _markers(half: Half) -> str:
    """The block of positions of markers, or nothing."""
    return half.markers if isinstance(half, MarkerTask) else ""


def _of_robot(number: int, finding: Finding) -> Finding:
    return replace(finding, problem=f"Robot {number}: {finding.problem}")


def _places(half: SensorTask) -> bool:
    """Whether the object, once found, has no freedom left."""
    if isinstance(half, MarkerTask) and half.markers_m is None:
        return len(np.unique(half.marker_index)) >= _FEWEST_MARKERS
    return half.object_freedoms == POSE_FREEDOMS


def _object(half: Half) -> object:
    """What is known of the object, to be compared."""
    if isinstance(half, MarkerTask):
        markers = None if half.markers_m is None else np.asarray(half.markers_m).tolist()
        return half.object, markers, half.marker_std_m
    faces: tuple[Feature, ...] = getattr(half, "faces", ())
    shapes = [(face.name, face.kind, tuple(face.point_m), tuple(face.axis)) for face in faces]
    return half.object, shapes, getattr(half, "form_std_m", 0.0)


def _sensor(half: Half) -> object:
    """What is known of the sensor, to be compared."""
    names = ("scale_std", "offset_std_m", "ball_radius_m", "ball_std_m")
    return [getattr(half, name, None) for name in names]
