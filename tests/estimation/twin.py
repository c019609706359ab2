"""A bench cell in a few arrays, for tests of the estimators: own kinematics and rays, nothing of ours.

Only the containers `ArmModel`, `Belief`, `Feature`, `Observations` are shared with the code under test, so
that a sign or an order that is wrong in the estimation cannot be wrong here in the same way.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimation.belief import Belief
from estimation.kinematics import ArmModel
from estimation.measurement import Observations
from estimation.surfaces import Feature, bar_features, plane, plate_features
from estimation.transform import Transform

FloatArray = NDArray[np.float64]
DEG, MM = np.pi / 180, 1e-3

# theta, d, a, alpha, beta of the PRBT, and which are uncertain (gauge: ESTIMATION.md section 12)
TABLE = np.array(
    [
        [180 * DEG, 260.4 * MM, 0, 90 * DEG, 0],
        [90 * DEG, 0, 350 * MM, 180 * DEG, 0],
        [90 * DEG, 0, 0, 90 * DEG, 0],
        [180 * DEG, 307 * MM, 0, 90 * DEG, 0],
        [0, 0, 0, -90 * DEG, 0],
        [0, 84 * MM, 0, 0, 0],
    ]
)
NAMES = ("theta", "d", "a", "alpha", "beta")
FREE = tuple(
    (joint, name)
    for joint, names in enumerate(
        (
            ("a", "alpha"),
            ("theta", "a", "alpha", "beta"),
            ("theta", "d", "a", "alpha"),
            ("theta", "d", "a", "alpha"),
            ("theta", "d", "a", "alpha"),
        )
    )
    for name in names
)
START_RAD = np.array([0, -20, 110, 0, 50, 0]) * DEG
LASER = (80 * MM, 0.0, 60 * MM)


@dataclass(frozen=True)
class Sizes:
    """Standard uncertainties of the cell; defaults are the 'mid' case of ESTIMATION.md section 12."""

    angle_rad: float = 0.01 * DEG
    length_m: float = 0.1 * MM
    joint_rad: float = 0.0015 * DEG
    range_m: float = 0.03 * MM
    scale: float = 2e-4
    offset_m: float = 0.02 * MM
    mount_m: float = 2 * MM
    mount_rad: float = 0.7 * DEG
    placed_m: float = 3 * MM
    placed_rad: float = 0.5 * DEG
    form_m: float = 0.02 * MM

    def times(self, factor: float) -> "Sizes":
        """All of them smaller or larger: near zero everything is linear."""
        return Sizes(**{name: value * factor for name, value in vars(self).items()})


def arm() -> ArmModel:
    """The nominal arm of the estimator."""
    theta, d, a, alpha, beta = TABLE.T
    return ArmModel.from_dh(theta, d, a, alpha, beta, -LIMITS_RAD, LIMITS_RAD, FREE)


def pose(xi: FloatArray) -> FloatArray:
    """(..., 4, 4) from [t; rotation vector] (..., 6)."""
    matrix = np.zeros((*xi.shape[:-1], 4, 4))
    rotation = Rotation.from_rotvec(xi[..., 3:].reshape(-1, 3)).as_matrix()
    matrix[..., :3, :3] = rotation.reshape(*xi.shape[:-1], 3, 3)
    matrix[..., :3, 3] = xi[..., :3]
    matrix[..., 3, 3] = 1.0
    return matrix


def elementary(amount: FloatArray, freedom: int) -> FloatArray:
    """(..., 4, 4) of a motion along (0-2) or about (3-5) one axis."""
    matrix = np.zeros((*np.shape(amount), 4, 4))
    matrix[...] = np.eye(4)
    if freedom < 3:
        matrix[..., freedom, 3] = amount
    else:
        a, b = (freedom - 2) % 3, (freedom - 1) % 3
        matrix[..., a, a] = matrix[..., b, b] = np.cos(amount)
        matrix[..., b, a] = np.sin(amount)
        matrix[..., a, b] = -np.sin(amount)
    return matrix


def forward(table: FloatArray, q: FloatArray) -> FloatArray:
    """base_T_flange (..., 4, 4): elementary motions one after the other; table (..., 6, 5), q (..., 6)."""
    result = np.eye(4)
    for joint in range(6):
        theta, d, a, alpha, beta = np.moveaxis(table[..., joint, :], -1, 0)
        result = result @ elementary(theta + q[..., joint], 5)
        for amount, freedom in ((d, 2), (a, 0), (alpha, 3), (beta, 4)):
            result = result @ elementary(amount, freedom)
    return result


LIMITS_RAD = np.array([170, 145, 135, 170, 170, 179]) * DEG


PLATE_M = np.array([0.4, 0.0, 0.02])
BAR_M = np.array([0.32, 0.31, 0.1])
BAR_RPY = np.array([-90, 0, 90]) * DEG
PART_M = np.array([0.3, -0.4, 0.0])


def face_features(form: bool = True) -> tuple[Feature, ...]:
    """Five faces of a block of 100 x 150 x 100 mm, each with an offset of its own."""
    faces = {
        "top": ((0.05, 0.075, 0.1), (0, 0, 1)),
        "front": ((0.05, 0.0, 0.05), (0, -1, 0)),
        "back": ((0.05, 0.15, 0.05), (0, 1, 0)),
        "left": ((0.0, 0.075, 0.05), (-1, 0, 0)),
        "right": ((0.1, 0.075, 0.05), (1, 0, 0)),
    }
    return tuple(
        plane(name, np.array(point), np.array(normal, dtype=float), f"part.{name}" if form else None)
        for name, (point, normal) in faces.items()
    )


@dataclass(frozen=True)
class Truth:
    """Errors of one cell or of many (leading axis), as right perturbations and deviations from nominal."""

    kinematics: FloatArray  # (..., 18)
    laser: FloatArray  # (..., 6)
    scale: FloatArray
    offset_m: FloatArray
    plate: FloatArray  # (..., 6)
    bar: FloatArray  # (..., 6)
    part: FloatArray  # (..., 6)
    faces_m: FloatArray  # (..., 5)
    bump: FloatArray = field(default_factory=lambda: np.zeros(6))

    @staticmethod
    def drawn(rng: np.random.Generator, sizes: Sizes, cells: int | None = None) -> "Truth":
        """Errors of size `sizes`; those that nothing depends on are zero."""
        lead = () if cells is None else (cells,)
        spread = np.array([sizes.length_m if name in ("a", "d") else sizes.angle_rad for _, name in FREE])

        def placed(active: list[int], size_m: float, size_rad: float) -> FloatArray:
            mask = np.isin(np.arange(6), active)
            sigma = np.where(mask, np.repeat([size_m, size_rad], 3), 0.0)
            return np.asarray(rng.normal(size=(*lead, 6)) * sigma)

        return Truth(
            kinematics=rng.normal(size=(*lead, 18)) * spread,
            laser=placed([0, 1, 2, 3, 4], sizes.mount_m, sizes.mount_rad),
            scale=np.asarray(rng.normal(size=lead) * sizes.scale),
            offset_m=np.asarray(rng.normal(size=lead) * sizes.offset_m),
            plate=placed([2, 3, 4], sizes.placed_m, sizes.placed_rad),
            bar=placed([0, 1, 2, 3, 4], sizes.placed_m, sizes.placed_rad),
            part=placed([0, 1, 2, 3, 4, 5], sizes.placed_m, sizes.placed_rad),
            faces_m=rng.normal(size=(*lead, 5)) * sizes.form_m,
        )

    def table(self) -> FloatArray:
        """D-H parameters (..., 6, 5)."""
        table = np.broadcast_to(TABLE, (*self.kinematics.shape[:-1], 6, 5)).copy()
        for column, (joint, name) in enumerate(FREE):
            table[..., joint, NAMES.index(name)] += self.kinematics[..., column]
        return table

    def beams(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Origins and directions (..., m, 3) of the laser beam in base at joints (m, 6)."""
        mount = pose(np.array([*LASER, 0, 0, 0])) @ pose(self.laser) @ pose(self.bump)
        laser = forward(self.table()[..., None, :, :], q) @ mount[..., None, :, :]
        return laser[..., :3, 3], laser[..., :3, 2]

    def reading(self, distance_m: FloatArray) -> FloatArray:
        """What the laser says at a true distance (..., m)."""
        return (distance_m - self.offset_m[..., None]) / (1 + self.scale[..., None])

    def on_plane(
        self, q: FloatArray, object_T: FloatArray, point: FloatArray, normal: FloatArray
    ) -> FloatArray:
        """Distances (..., m) to the plane through points (m, 3) with normals (m, 3) of an object."""
        origin, beam = self.beams(q)
        inverse = np.linalg.inv(object_T)[..., None, :, :]
        o = np.einsum("...ij,...j->...i", inverse[..., :3, :3], origin) + inverse[..., :3, 3]
        b = np.einsum("...ij,...j->...i", inverse[..., :3, :3], beam)
        return np.asarray(np.sum((point - o) * normal, axis=-1) / np.sum(b * normal, axis=-1))

    def plate_readings(self, q: FloatArray) -> FloatArray:
        """Noise-free readings (..., m) on the plate."""
        placed = pose(np.array([*PLATE_M, 0, 0, 0])) @ pose(self.plate)
        zero = np.zeros((len(q), 3))
        return self.reading(self.on_plane(q, placed, zero, np.broadcast_to([0.0, 0.0, 1.0], (len(q), 3))))

    def part_readings(self, q: FloatArray, face: NDArray[np.intp]) -> FloatArray:
        """Noise-free readings (..., m) on faces of the part."""
        placed = pose(np.array([*PART_M, 0, 0, 0])) @ pose(self.part)
        features = face_features()
        normal = np.array([features[i].axis for i in face])
        point = np.array([features[i].point_m for i in face]) + self.faces_m[..., face, None] * normal
        return self.reading(self.on_plane(q, placed, point, normal))

    def bar_readings(self, q: FloatArray, second: NDArray[np.intp], radius_m: float = 0.015,
                     length_m: float = 0.2) -> FloatArray:  # fmt: skip
        """Noise-free readings (..., m) on the spheres of the bar."""
        placed = bar_pose() @ pose(self.bar)
        centre = np.zeros((len(q), 3))
        centre[:, 2] = length_m * second
        base_c = np.einsum("...ij,mj->...mi", placed[..., :3, :3], centre) + placed[..., None, :3, 3]
        origin, beam = self.beams(q)
        along = np.sum((base_c - origin) * beam, axis=-1)
        miss2 = np.sum((base_c - origin) ** 2, axis=-1) - along**2
        return self.reading(along - np.sqrt(radius_m**2 - miss2))

    def cell(self, number: int) -> "Truth":
        """One of many cells."""
        return replace(
            self, **{name: values[number] for name, values in vars(self).items() if name != "bump"}
        )

    def bumped(self, xi: FloatArray) -> "Truth":
        """The same cell after something hit the laser."""
        return replace(self, bump=xi)


def bar_pose() -> FloatArray:
    """Nominal base_T_bar."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", BAR_RPY).as_matrix()
    matrix[:3, 3] = BAR_M
    return matrix


def laser_belief(sizes: Sizes, kinematics: bool = True) -> Belief:
    """Priors of arm and laser."""
    belief = Belief()
    if kinematics:
        spread = [sizes.length_m if name in ("a", "d") else sizes.angle_rad for _, name in FREE]
        belief = belief.with_block(
            "kinematics", np.zeros(18), std=spread, freedoms=[f"{name}{joint + 1}" for joint, name in FREE]
        )
    mount = Transform("flange", "laser", pose(np.array([*LASER, 0, 0, 0])))
    sigma = [sizes.mount_m] * 3 + [sizes.mount_rad] * 2
    belief = belief.with_block("laser", mount, std=sigma, freedoms=("tx", "ty", "tz", "rx", "ry"))
    belief = belief.with_block("laser.scale", 0.0, std=sizes.scale)
    return belief.with_block("laser.offset", 0.0, std=sizes.offset_m)


def with_plate(belief: Belief, sizes: Sizes) -> Belief:
    """And of the plate."""
    placed = Transform("base", "plate", pose(np.array([*PLATE_M, 0, 0, 0])))
    sigma = [sizes.placed_m, sizes.placed_rad, sizes.placed_rad]
    return belief.with_block("plate", placed, std=sigma, freedoms=("tz", "rx", "ry"))


def with_bar(belief: Belief, sizes: Sizes) -> Belief:
    """And of the two-sphere bar."""
    sigma = [sizes.placed_m] * 3 + [sizes.placed_rad] * 2
    return (
        belief.with_block(
            "bar", Transform("base", "bar", bar_pose()), std=sigma, freedoms=("tx", "ty", "tz", "rx", "ry")
        )
        .with_block("bar.length", 0.2, std=3e-6)
        .with_block("bar.radius", 0.015, std=1e-6)
    )


def with_part(belief: Belief, sizes: Sizes, form: bool = True) -> Belief:
    """And of the part, with an offset for each face."""
    placed = Transform("base", "part", pose(np.array([*PART_M, 0, 0, 0])))
    sigma = [sizes.placed_m] * 3 + [sizes.placed_rad] * 3
    belief = belief.with_block("part", placed, std=sigma)
    for feature in face_features() if form else ():
        belief = belief.with_block(
            feature.blocks[0], 0.0, std=sizes.form_m, freedoms=("offset",), source="form"
        )
    return belief


def laser_observations(
    object: str,
    q: FloatArray,
    readings: FloatArray,
    sizes: Sizes,
    index: NDArray[np.intp] | None = None,
    features: tuple[Feature, ...] | None = None,
) -> Observations:
    """A batch as the engine would make it; the noise is what `noisy` adds."""
    if features is None:
        features = {"plate": plate_features, "bar": bar_features, "part": face_features}[object]()
    m = len(q)
    return Observations(
        "laser",
        object,
        q,
        np.full((m, 6), sizes.joint_rad**2),
        readings,
        np.full(m, sizes.range_m**2),
        np.zeros(m),
        features,
        np.zeros(m, dtype=np.intp) if index is None else index,
    )


def noisy(
    rng: np.random.Generator, q: FloatArray, readings: FloatArray, sizes: Sizes
) -> tuple[FloatArray, FloatArray]:
    """Joints and readings with fresh noise; readings (..., m), so joints become (..., m, 6)."""
    joints = q + rng.normal(size=(*readings.shape, 6)) * sizes.joint_rad
    return joints, readings + rng.normal(size=readings.shape) * sizes.range_m
