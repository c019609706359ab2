"""Can the limits of a job be met at all? Asked before anything moves."""

from collections.abc import Mapping
from dataclasses import dataclass

from controller.cellfile import Cell, Mistake, job
from controller.knowledge import first_belief, with_part, with_plate
from controller.planning.estimated import (
    choose,
    corner_points,
    hand_eye_points,
    plate_candidates_for,
)
