"""Stripes in voxels against a plain dictionary, in any split, and in memory that does not grow with them."""

import tracemalloc
from collections import defaultdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimation.errors import EstimationError
from estimation.localization import voxels as module
from estimation.localization.voxels import Voxels
from estimation.transform import FloatArray

SIZE_M = 5e-4


def stripes(count: int, width: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Stripes over a wavy floor, 0.1 mm apart, some readings missing."""
    rng = np.random.default_rng(seed)
    y = np.linspace(-0.02, 0.02, width)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    poses[:, :3, 3] = [0.6, -0.3, 0.2]
    poses[:, 0, 3] += 1e-4 * np.arange(count)
    z = 0.1 + 0.002 * np.sin(200 * y) + 1e-5 * rng.normal(size=(count, width))
    yz = np.stack([np.broadcast_to(y, z.shape), z], axis=-1).astype(np.float32)
    yz[rng.random((count, width)) < 0.02] = np.nan
    return yz, poses


@pytest.mark.parametrize("compiled", [True, False])
def test_means_are_those_of_a_dictionary(compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if compiled and not module.COMPILED:
        pytest.skip("numba is not installed")
    monkeypatch.setattr(module, "COMPILED", compiled)
    yz, poses = stripes(40, 200, 1)
    cells: dict[tuple[int, ...], list[FloatArray]] = defaultdict(list)
    for stripe, pose in zip(yz, poses, strict=True):
        for y, z in stripe[np.isfinite(stripe).all(axis=1)].astype(np.float64):
            point = pose[:3, 1] * y + pose[:3, 2] * z + pose[:3, 3]
            cells[tuple(np.floor(point / SIZE_M).astype(int))].append(point)
    voxels = Voxels(SIZE_M)
    voxels.add(yz[:7], poses[:7])
    voxels.add(yz[7:], poses[7:])
    points, counts = voxels.points
    expected = sorted(cells.items())
    assert counts.tolist() == [len(each) for _, each in expected]
    assert points == pytest.approx(np.array([np.mean(each, axis=0) for _, each in expected]), abs=1e-12)


@pytest.mark.skipif(not module.COMPILED, reason="numba is not installed")
def test_memory_grows_with_the_surface_not_with_the_stripes() -> None:
    yz, poses = stripes(200, 640, 2)
    voxels = Voxels(SIZE_M)
    voxels.add(yz, poses)
    before = len(voxels.points[0])
    tracemalloc.start()
    for _ in range(20):
        voxels.add(yz, poses)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(voxels.points[0]) == before
    assert peak < 2.0 * yz.nbytes  # checks of one shot, never all of them


@pytest.mark.skipif(not module.COMPILED, reason="numba is not installed")
def test_a_full_table_grows() -> None:
    yz, poses = stripes(300, 640, 3)
    fine = Voxels(2e-5)
    fine.add(yz, poses)
    points, counts = fine.points
    assert len(points) > 65_536 and counts.sum() == np.isfinite(yz).all(axis=2).sum()


def test_stripes_that_cannot_be_are_refused() -> None:
    yz, poses = stripes(2, 10, 4)
    with pytest.raises(EstimationError, match=r"\(2, 10, 2\)"):
        Voxels(SIZE_M).add(yz, poses[:1])
    with pytest.raises(EstimationError, match="Give metres"):
        Voxels(SIZE_M).add(1e4 * yz, poses)
    with pytest.raises(EstimationError, match="Choose between"):
        Voxels(0.0)
