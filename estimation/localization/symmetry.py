"""Motions of an object that its measured features do not see, whatever points are taken on them."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from estimation.surfaces import Feature
from estimation.tasks import checks
from estimation.tasks.findings import Cause, Finding
from estimation.transform import FloatArray, skew

_UNSEEN: Final = 1e-4  # of the largest singular value: what noise and files leave of an exact symmetry


def unseen_motions(features: Sequence[Feature]) -> FloatArray:
    """Twists (k, 6), [t; w], w per size of the object, that move each of some features in itself.

    A plane slides and turns in itself, a cylinder slides along and turns about its axis, and so on.
    """
    if any(feature.shape is not None for feature in features):
        return np.zeros((0, 6))
    places = np.array([feature.point_m for feature in features])
    middle = places.mean(axis=0)
    radii = [feature.radius_m + feature.major_radius_m for feature in features]
    size_m = max(float(np.abs(places - middle).max()), *radii, np.finfo(float).tiny)
    rows = [
        _seen(feature, (place - middle) / size_m) for feature, place in zip(features, places, strict=True)
    ]
    _, singular, motions = np.linalg.svd(np.vstack(rows))
    return np.asarray(motions[int(np.sum(singular > _UNSEEN * singular[0])) :])


def check_symmetry(features: Sequence[Feature]) -> list[Finding]:
    """Whether an object may move unseen when these of its features are measured."""
    count = len(unseen_motions(features))
    if not count:
        return []
    if all(feature.kind == "plane" for feature in features):
        return checks.normals(np.array([feature.axis for feature in features]), np.arange(len(features)))
    return [
        Finding(
            Cause.SYMMETRIC,
            f"{', '.join(feature.name for feature in features)} look the same from {count} "
            f"direction{'s' if count > 1 else ''}: the object may turn or slide unseen",
            "Measure a feature that lies aside",
        )
    ]


def _seen(feature: Feature, place: FloatArray) -> FloatArray:
    """Rows (r, 6) by which a twist moves or turns a feature at a place (3,)."""
    axis = np.array(feature.axis)
    moved = np.hstack([np.eye(3), -skew(place)])  # of its point: t + w x place
    turned = np.hstack([np.zeros((3, 3)), -skew(axis)])
    if feature.kind == "sphere":
        return moved
    if feature.kind == "plane":
        moved = axis[None] @ moved
    elif feature.kind == "cylinder":
        moved = moved - np.outer(axis, axis) @ moved
    return np.vstack([moved, turned])
