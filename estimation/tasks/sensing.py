"""What the tasks have in common in which a sensor on or beside an arm sees points of an object."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.belief import POSE_FREEDOMS, Belief, Value
from estimation.model import pose_of, values_of, vector_of
from estimation.surfaces import Feature
from estimation.tasks import checks, starts
from estimation.tasks.chain import Markers, Readings, SensorChain, Surfaces
from estimation.tasks.findings import Cause, Finding
from estimation.tasks.mistakes import other_units
from estimation.tasks.motion import Motion
from estimation.tasks.rolling import Few, OnPlanes, OnSphere, Rolled, rolled
from estimation.transform import FloatArray, Transform

OTHER_SIZE: Final = Finding(
    Cause.WRONG_SURFACE,
    "The readings fit a sphere of another radius than named",
    "Check which sphere was measured, and its certificate",
)
_MOST_FOR_A_START: Final = 50  # readings: a start needs no more, and its cost grows with them
# Starts that roll down together, how many readings they see, steps, and whether outliers weigh less.
_ROUNDS: Final = ((150, 40, 4, False), (40, 150, 12, False), (20, 150, 8, True), (20, 150, 4, True))
_FEW: Final = 6  # of them are different and good enough to go on with
_HOPELESS: Final = 100.0  # times the lowest cost: no outlier makes up for that
_APART_RAD: Final = np.deg2rad(3.0)  # two that come closer than this roll into the same minimum
_ON_A_FACE: Final = 5.0  # standard deviations
_ASYMMETRIC: Final = 1e-6  # of the largest element: rounding in a file


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorTask:
    """Estimates where the sensor is mounted and where the object is, from readings at many poses.

    Attributes
    ----------
    motion : `Poses` or `Joints` of the arm.
    mount, mount_std : prior of the mount (near_T_sensor, where near is "flange", or "base" of a sensor
        that stands beside), std of each of its freedoms, m and rad; both or neither. Zeros hold it.
    mount_covariance : (k, k) of its k freedoms instead, form A, as an earlier calibration leaves it.
    scale_std, offset_std_m : shared errors of the sensor; 0 leaves them out.
    consider : names of shared errors that are carried and not updated.
    """

    motion: Motion
    mount: Transform | None = None
    mount_std: ArrayLike | None = None
    mount_covariance: FloatArray | None = None
    scale_std: float = 0.0
    offset_std_m: float = 0.0
    consider: tuple[str, ...] = ()

    task: ClassVar[str] = ""
    sensor: ClassVar[str] = ""
    object: ClassVar[str] = ""
    beside: ClassVar[bool] = False
    mount_freedoms: ClassVar[tuple[str, ...]] = POSE_FREEDOMS

    def readings(self) -> Readings:
        """The points in the frame of the sensor."""
        raise NotImplementedError

    def target(self) -> Surfaces | Markers:
        """What they are points of."""
        raise NotImplementedError

    @property
    def object_freedoms(self) -> tuple[str, ...]:
        """Freedoms of the object's pose that matter."""
        return POSE_FREEDOMS

    def arrays(self) -> Mapping[str, tuple[Any, tuple[int | None, ...]]]:
        """The arrays as they were given, each with the shape that it must have; None for any length."""
        raise NotImplementedError

    def with_object_priors(self, belief: Belief) -> Belief:
        """Adds what is known of the object: certificate, form."""
        return belief

    def candidates(
        self, pose: FloatArray, readings: Readings, rows: NDArray[np.intp]
    ) -> list[Mapping[str, Value]]:
        """Starts (mount, object and what else is flat) from some rows, poses (k, 4, 4) from near to far."""
        raise NotImplementedError

    @property
    def frames(self) -> tuple[str, str]:
        """Frames at the near and the far end of the arm."""
        return ("base", "flange") if self.beside else ("flange", "base")

    def indices(self) -> Mapping[str, tuple[Any, int]]:
        """Indices as they were given, each with the count that it must stay below."""
        return {}

    @property
    def labels(self) -> NDArray[np.intp]:
        """(m,) which surface or marker each reading is of."""
        return self.target().index

    def check(self) -> Sequence[Finding]:
        """Everything wrong at sight; an empty list for sound data."""
        return checks.first_of(
            lambda: list(self.motion.check()),
            lambda: checks.numbers(self.arrays()),
            lambda: checks.indices(self.indices()),
            self._check_noise,
            self._check_mount,
            lambda: checks.lengths(self._lengths()),
            self._check_geometry,
        )

    def _lengths(self) -> dict[str, FloatArray]:
        return {name: np.asarray(given) for name, (given, _) in self.arrays().items() if name.endswith("_m")}

    def _check_noise(self) -> list[Finding]:
        covariance = self.readings().covariance
        return checks.deviations({"variance of readings": np.linalg.eigvalsh(covariance)})

    def _check_mount(self) -> list[Finding]:
        covariance, count = self.mount_covariance, len(self.mount_freedoms)
        if covariance is None:
            return []
        found = checks.numbers({"mount_covariance": (covariance, (count, count))})
        if not found and np.abs(covariance - covariance.T).max() > _ASYMMETRIC * np.abs(covariance).max():
            found = [Finding(Cause.NOISE, "mount_covariance is not symmetric", "Give P, not its square root")]
        return found or checks.deviations({"variance of the mount": np.linalg.eigvalsh(covariance)})

    def _check_geometry(self) -> list[Finding]:
        belief, readings = self.belief(), self.readings()
        unknowns, rows_each = int(belief.flat.sum()), self.model().group
        keys = np.column_stack([self.motion.keys[readings.pose_index], readings.points_m, self.labels])
        found = checks.repeated(keys, unknowns, rows_each)
        found += checks.count(rows_each * len(readings.points_m), unknowns)
        poses = self.motion.at(values_of(belief)).pose
        if self.sensor in belief and belief.block(self.sensor).flat:
            found += checks.orientations(poses)
        return found + checks.positions(poses) + self.check_object() + self.check_readings()

    def check_readings(self) -> list[Finding]:
        """What is odd about the readings as such."""
        return []

    def check_object(self) -> list[Finding]:
        """What is wrong with the surfaces or markers that were measured."""
        return []

    def diagnose(self, values: Mapping[str, Value], rejected: NDArray[np.bool_] | None) -> Sequence[Finding]:
        """Why data leave something open (None), or readings do not fit, seen from values that fit best."""
        return []

    def seen_points(self, values: Mapping[str, Value], sensor_p: FloatArray | None = None) -> FloatArray:
        """(m, 3) the readings, or other points in the frame of the sensor, in the frame of the object, m."""
        readings = self.readings()
        points = readings.points_m if sensor_p is None else sensor_p
        pose = self.motion.at(values).pose
        pose = np.asarray(np.linalg.inv(pose) if self.beside else pose)[readings.pose_index]
        near_p = pose_of(values, self.sensor).points(points)
        far_p = np.einsum("mij,mj->mi", pose[:, :3, :3], near_p) + pose[:, :3, 3]
        return pose_of(values, self.object).inverse().points(far_p)

    def belief(self) -> Belief:
        near, far = self.frames
        belief = Belief()
        pose = self.mount if self.mount is not None else Transform(near, self.sensor, np.eye(4))
        freedoms = self.mount_freedoms
        if self.mount is not None and self.mount_covariance is not None:
            belief = belief.with_block(self.sensor, pose, covariance=self.mount_covariance, freedoms=freedoms)
        else:
            known = self.mount is not None and self.mount_std is not None
            std = np.asarray(self.mount_std, dtype=np.float64) if known else np.inf
            belief = belief.with_block(self.sensor, pose, std=std, freedoms=freedoms)
        holder = Transform(far, self.object, np.eye(4))
        belief = belief.with_block(self.object, holder, std=np.inf, freedoms=self.object_freedoms)
        if self.scale_std:
            belief = belief.with_block(f"{self.sensor}.scale", 0.0, std=self.scale_std)
        if self.offset_std_m:
            belief = belief.with_block(f"{self.sensor}.offset", 0.0, std=self.offset_std_m)
        return self.model().with_priors(self.with_object_priors(belief))

    def rough(self) -> Belief:
        return self.belief().without([self.model().shared])

    def model(self) -> SensorChain:
        return self._chain

    @cached_property
    def _chain(self) -> SensorChain:
        return SensorChain(
            self.motion, self.readings(), self.target(), self.sensor, self.object, beside=self.beside
        )

    def starts(self) -> Sequence[Mapping[str, Value]]:
        belief, readings = self.belief(), self.readings()
        rows = np.arange(len(readings.points_m))
        if len(rows) > _MOST_FOR_A_START:
            rows = np.unique(np.linspace(0, len(rows) - 1, _MOST_FOR_A_START).astype(np.intp))
        pose = self.motion.at(values_of(belief)).pose
        if self.beside:
            pose = np.asarray(np.linalg.inv(pose))
        flat = {
            block.name for block in belief.blocks if block.flat and len(block.flat) == len(block.freedoms)
        }
        found = self.candidates(pose[readings.pose_index[rows]], readings, rows)
        return [{name: value for name, value in values.items() if name in flat} for values in found]

    def settled(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """A frame that may spin about its z gets the x axis of a rule."""
        poses = ((self.sensor, self.mount_freedoms), (self.object, self.object_freedoms))
        spun = {
            name: starts.spun(pose_of(values, name))
            for name, freedoms in poses
            if name in values and "rx" in freedoms and "rz" not in freedoms
        }
        return {**values, **spun}

    def explanations(self) -> Sequence[tuple[Finding, "SensorTask"]]:
        """Mistakes with units, which are quickest to make, with motion and with labels."""
        found: list[tuple[Finding, SensorTask]] = []
        lengths = self._lengths()
        together = [tuple(lengths)] if len(lengths) > 1 else []
        for names in (*((name,) for name in lengths), *together):
            fit = f"The data fit when {' and '.join(names)} {'is' if len(names) == 1 else 'are'}"
            for finding, factor in other_units(fit):
                scaled: dict[str, Any] = {name: lengths[name] / factor for name in names}
                found.append((finding, replace(self, **scaled)))
        found += [(finding, replace(self, motion=motion)) for finding, motion in self.motion.mistakes()]
        return found + self.relabelled()

    def relabelled(self) -> list[tuple[Finding, "SensorTask"]]:
        """The same with surfaces or markers named differently."""
        return []

    def mount_grid(self) -> FloatArray:
        """Rotations of the sensor to try: the prior's alone when there is one."""
        if self.mount is not None:
            return self.mount.rotation[None]
        return starts.rotations() if "rz" in self.mount_freedoms else starts.directions()

    def poses(self, near_T_sensor: FloatArray, far_T_object: FloatArray) -> dict[str, Value]:
        """The two pose blocks of a start."""
        near, far = self.frames
        return {
            self.sensor: Transform(near, self.sensor, near_T_sensor),
            self.object: Transform(far, self.object, far_T_object),
        }

    def rolled(
        self,
        pose: FloatArray,
        sensor_p: FloatArray,
        target: OnPlanes | OnSphere,
        mount: FloatArray,
        holder: FloatArray,
        radius_m: FloatArray | None = None,
    ) -> list[Mapping[str, Value]]:
        """The best of starts near_T_sensor, far_T_object (g, 4, 4) and radii (g,), rolled down.

        pose (m, 4, 4), sensor_p (m, 3) and the target are of the readings that a start is made from.
        """
        belief = self.belief()
        flat = belief.block(self.sensor).flat if self.sensor in belief else ()
        free = np.array(
            [
                *(name in flat for name in POSE_FREEDOMS),
                *(name in self.object_freedoms for name in POSE_FREEDOMS),
                "sphere.radius" in belief and bool(belief.block("sphere.radius").flat),
            ]
        )
        radius_m = np.zeros(len(mount)) if radius_m is None else radius_m
        if not len(flat):
            mount = np.broadcast_to(pose_of(values_of(belief), self.sensor).matrix, mount.shape)
        every, found = Few(pose, sensor_p, target), Rolled(mount, holder, radius_m, np.zeros(len(mount)))
        for count, readings, steps, robust in _ROUNDS:
            few = every.thinned(readings)
            found = rolled(few, found, free, 0, robust)
            chosen = starts.best(found.square_m2, *self._turns(found), count=count, apart_rad=_APART_RAD)
            found = rolled(few, found.at(chosen), free, steps, robust)
        best = starts.best(found.square_m2, *self._turns(found), count=_FEW, apart_rad=_APART_RAD)
        return [
            {**self.poses(found.mount[i], found.holder[i]), "sphere.radius": found.radius_m[i : i + 1]}
            for i in best
            if found.square_m2[i] <= _HOPELESS * found.square_m2[best[0]]
        ]

    def _turns(self, found: Rolled) -> list[FloatArray]:
        """What tells starts apart: rotations, or the z axes of what may spin."""
        pairs = ((found.mount, self.mount_freedoms), (found.holder, self.object_freedoms))
        return [
            pose[:, :3, :3] if "rz" in freedoms else pose[:, :3, 2:3]
            for pose, freedoms in pairs
            if "rx" in freedoms
        ]


def along_z(reading_m: FloatArray, std_m: float | FloatArray) -> Readings:
    """Readings (m,) of a point laser, one a pose."""
    count = len(reading_m)
    points, covariance = np.zeros((count, 3)), np.zeros((count, 3, 3))
    points[:, 2] = reading_m
    covariance[:, 2, 2] = np.square(std_m)
    return Readings(points, covariance, np.arange(count))


def plane_starts(
    task: SensorTask,
    pose: FloatArray,
    sensor_p: FloatArray,
    features: tuple[Feature, ...],
    index: NDArray[np.intp],
    ball_m: float = 0.0,
) -> list[Mapping[str, Value]]:
    """Starts from readings on planes; one plane has no spin of its own to try."""
    normal = np.array([feature.axis for feature in features])[index]
    point = np.array([feature.point_m for feature in features])[index]
    offset = np.einsum("mi,mi->m", normal, point) + ball_m
    grid = starts.directions() if len(features) == 1 else starts.rotations()
    mount, holder = starts.on_planes(pose, sensor_p, normal, offset, grid)
    return task.rolled(pose, sensor_p, OnPlanes(normal, offset), mount, holder)


def mislabelled(
    task: SensorTask, faces: tuple[Feature, ...], values: Mapping[str, Value], rejected: NDArray[np.bool_]
) -> list[Finding]:
    """Rejected readings that lie on another face than the one named for them."""
    sigma = np.sqrt(task.model().rows(values).noise_variance)
    points = task.seen_points(values)
    ball_m = float(vector_of(values, "probe.radius", 1)[0]) if "probe.radius" in values else 0.0
    axes, places = np.array([face.axis for face in faces]), np.array([face.point_m for face in faces])
    distance = points @ axes.T - np.einsum("fi,fi->f", axes, places) - ball_m
    nearest = np.argmin(np.abs(distance), axis=1)
    close = np.abs(distance[np.arange(len(points)), nearest]) < _ON_A_FACE * sigma
    wrong = np.flatnonzero(rejected & close & (nearest != task.labels))
    if not len(wrong):
        return []
    first = wrong[0]
    return [
        Finding(
            Cause.WRONG_SURFACE,
            f"{len(wrong)} readings lie on another face than named: reading {first} is on "
            f"{faces[nearest[first]].name}, not on {faces[task.labels[first]].name}",
            "Check which reading is of which",
            refuses=False,
        )
    ]


def face_features(features: tuple[Feature, ...], form_std_m: float) -> tuple[Feature, ...]:
    """The faces, each with a form error of its own where there is one."""
    if not form_std_m:
        return features
    return tuple(
        replace(feature, deviations=("offset",), blocks=(f"form.{feature.name}",)) for feature in features
    )


def with_form(belief: Belief, features: tuple[Feature, ...], form_std_m: float) -> Belief:
    """The belief with the form error of each face."""
    for feature in features if form_std_m else ():
        belief = belief.with_block(
            f"form.{feature.name}", 0.0, std=form_std_m, freedoms=("offset",), source="form"
        )
    return belief
