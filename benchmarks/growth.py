"""How time grows with the number of points, and memory where points stream through."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.harness import medians, once, peak_mb
from benchmarks.localization import START, STD_M
from estimation.localization.alignment import align
from estimation.localization.voxels import Voxels
from estimation.shapes.fit import fit_surface
from estimation.surfaces.mesh import TriangleMesh
from estimation.transform import FloatArray, Transform, exp_pose
from tests.estimation.blade import blade_arrays, points_on
from tests.estimation.shapes.clouds import cloud

TITLE = "Growth"
COUNTS = [10**k for k in range(3, 8)]
STRIPE = 1000  # points
BATCH = 100  # stripes


def words(picture: Path) -> str:
    """The plot, the exponents of the last two decades, and the memory of streams."""
    from matplotlib.figure import Figure

    tasks: dict[str, Callable[[int], Callable[[], object]]] = {
        **{kind: _fit(kind) for kind in ("plane", "sphere", "cylinder", "cone", "torus")},
        "mesh localization": _localization(),
        "fusion of stripes": _stripes,
    }
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    axes = figure.subplots()
    text = "CPU time in seconds; covariance and checks are in the fits.\n\n| points | "
    text += " | ".join(f"1e{len(str(n)) - 1}" for n in COUNTS) + " | exponent, 1e5 to 1e7 |\n"
    text += "| --- " * (len(COUNTS) + 2) + "|\n"
    for name, task in tasks.items():
        seconds = []
        for count in COUNTS:
            seconds += medians(task(count), repeat=5) if count < 10**6 else [once(task(count))]
        exponent = np.polyfit(np.log(COUNTS[-3:]), np.log(seconds[-3:]), 1)[0]
        text += f"| {name} | " + " | ".join(f"{each:.2g}" for each in seconds) + f" | {exponent:.2f} |\n"
        axes.loglog(COUNTS, seconds, "o-", label=name)
        print(name, seconds, flush=True)
    axes.loglog(COUNTS, [2e-7 * count for count in COUNTS], "k:", label="linear")
    axes.set(xlabel="points", ylabel="seconds")
    axes.legend(fontsize="small")
    figure.savefig(picture, dpi=110)
    return text + f"\n![time against points]({picture.name})\n\n" + streams()


def streams() -> str:
    """Peak memory of stripes that pass over the same part once, ten and a hundred times."""
    peaks = [f"{peak_mb(_stripes(count)):.1f} MB at {count:.0e}" for count in (10**6, 10**7, 10**8)]
    return (
        "Stripes that pass over one part of 200 by 60 mm, batch by batch, once, ten and a hundred times: "
        + ", ".join(peaks)
        + " points, the peak beyond what the process held before.\n"
    )


def _fit(kind: str) -> Callable[[int], Callable[[], object]]:
    def task(count: int) -> Callable[[], object]:
        points = cloud(kind, seed=2, count=count).points_m
        return lambda: fit_surface(kind, points)

    return task


def _localization() -> Callable[[int], Callable[[], object]]:
    mesh = TriangleMesh(*blade_arrays(200, 200))

    def task(count: int) -> Callable[[], object]:
        rng = np.random.default_rng(1)
        points = points_on(mesh, count, rng)
        points += STD_M * rng.normal(size=(count, 3))
        return lambda: align(mesh, points, STD_M, Transform("base", "blade", START))

    return task


def _stripes(count: int) -> Callable[[], object]:
    """One batch of stripes, fused again and again with the sensor somewhere else over the part."""
    rng = np.random.default_rng(3)
    stripes = min(BATCH, count // STRIPE)
    y = np.linspace(-0.03, 0.03, STRIPE)
    z = 0.1 + 0.002 * np.sin(100 * y) + STD_M * rng.normal(size=(stripes, STRIPE))
    yz = np.stack([np.broadcast_to(y, z.shape), z], axis=-1).astype(np.float32)
    at: FloatArray = exp_pose(np.array([0.5, 0.2, 0.3, 0.3, 0.2, 0.1]))

    def run() -> object:
        voxels, number = Voxels(5e-4), 0
        for _ in range(count // (stripes * STRIPE)):
            poses = np.tile(at, (stripes, 1, 1))
            poses[:, 0, 3] += 2e-4 * ((number + np.arange(stripes)) % 1_000)
            voxels.add(yz, poses)
            number += stripes
        return voxels.points

    return run
