"""Problems of the estimator as data sets."""

from typing import Any

import numpy as np

from estimation.tasks.pairs import MovePairs, PairTask
from estimation.tasks.two_robots import TwoRobots


def poses() -> dict[str, Any]:
    """Forty poses at rest."""
    eye = np.eye(4).tolist()
    noise = {"position": "0.02 mm", "rotation": "0.002 deg"}
    return {"kind": "poses", "target": "base", "source": "flange", "noise": noise, "matrices": [eye] * 40}


def written(problem: Any) -> dict[str, Any]:
    """A problem of the estimator as a data set in metres and radians."""
    if isinstance(problem, TwoRobots):
        halves = {"first": written(problem.first), "second": written(problem.second)}
        return {"truecell_dataset": 1, "task": problem.task, **halves}
    motion = poses() | {"matrices": problem.motion.base_T_flange.tolist()}
    said: dict[str, Any] = {
        "truecell_dataset": 1,
        "task": problem.task,
        "units": {"length": "m", "angle": "rad"},
        "motion": motion,
    }
    if isinstance(problem, PairTask):
        return said | _reported(problem)
    arrays = {"reading_m": "readings", "profile_m": "points", "points_m": "points", "markers_m": "markers"}
    arrays |= {"pose_index": "pose", "marker_index": "marker"}
    for name, key in arrays.items():
        if getattr(problem, name, None) is not None:
            said[key] = getattr(problem, name).tolist()
    if hasattr(problem, "covariance"):
        said["noise"] = [f"{v} m" for v in np.sqrt(np.diag(problem.covariance))]
    else:
        std = problem.std_m
        said["noise"] = [f"{v} m" for v in std] if isinstance(std, tuple) else f"{std} m"
    if problem.mount_covariance is not None:
        said["prior"] = {
            "target": problem.mount.target,
            "source": problem.mount.source,
            "matrix": problem.mount.matrix.tolist(),
            "covariance": problem.mount_covariance.tolist(),
        }
    if hasattr(problem, "angle_std_rad"):
        said["angle_noise"] = f"{problem.angle_std_rad} rad"
    for name in ("radius", "ball_radius"):
        if getattr(problem, f"{name}_m", None) is not None:
            said[name] = f"{getattr(problem, f'{name}_m')} m"
    if hasattr(problem, "faces"):
        said["faces"] = [{"name": f.name, "point": f.point_m, "normal": f.axis} for f in problem.faces]
        said["face"] = [problem.faces[i].name for i in problem.face_index]
    return said


def _reported(problem: PairTask) -> dict[str, Any]:
    """The part of the sensor in a data set of pairs."""
    table = {
        "target": "first" if isinstance(problem, MovePairs) else "sensor",
        "source": "second" if isinstance(problem, MovePairs) else "object",
        "noise": {"position": f"{problem.std_m} m", "rotation": f"{problem.std_rad} rad"},
        "matrices": problem.given.tolist(),
    }
    if isinstance(problem, MovePairs):
        return {"moves": table | {"first": problem.first.tolist(), "second": problem.second.tolist()}}
    return {"seen": table}
