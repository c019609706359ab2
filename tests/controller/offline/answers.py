"""What `truecell estimate --json` answers, and whether the truth is in it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
Run = Callable[..., tuple[int, str, str]]


def inside(answer: dict[str, Any], name: str, truth_mm: np.ndarray) -> bool:
    """Whether the truth lies in the region of 99.9 % of a pose, over the freedoms that were estimated."""
    pose = np.array(answer["parameters"][name]["matrix_mm"])
    gap = np.linalg.inv(pose) @ truth_mm
    twist = np.concatenate([gap[:3, 3], np.degrees(Rotation.from_matrix(gap[:3, :3]).as_rotvec())])
    places = [i for i, label in enumerate(answer["parameter_names"]) if label.startswith(f"{name}.")]
    freedoms = [["tx", "ty", "tz", "rx", "ry", "rz"].index(answer["parameter_names"][i][-2:]) for i in places]
    covariance = np.array(answer["covariance"])[np.ix_(places, places)]
    error = twist[freedoms]
    return bool(error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, len(error)))
