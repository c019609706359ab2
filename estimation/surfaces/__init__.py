"""Surfaces of an object and how far points are from them, with parameters for how the surfaces deviate."""

from estimation.surfaces.distance import SignedDistance, cross, feature_table, signed_distance
from estimation.surfaces.feature import (
    DEVIATIONS,
    KINDS,
    Feature,
    Kind,
    Vector,
    bar_features,
    cone,
    cylinder,
    plane,
    plate_features,
    sphere_features,
    torus,
)

__all__ = [
    "DEVIATIONS",
    "KINDS",
    "Feature",
    "Kind",
    "SignedDistance",
    "Vector",
    "bar_features",
    "cone",
    "cross",
    "cylinder",
    "feature_table",
    "plane",
    "plate_features",
    "signed_distance",
    "sphere_features",
    "torus",
]
