"""The reference: a known point measured again, compared with itself."""

from dataclasses import dataclass

import numpy as np

from controller.cellfile import Cell
from controller.knowledge import first_belief, observations, with_plate
from controller.samples import Sample
from estimation.errors import DeviceError
from estimation.kinematics import ArmModel
from estimation.measurement import Chain
from estimation.model import evaluate

FACTOR = 4.0  # standard deviations: an honest cell fails one reference in 16,000


@dataclass(frozen=True, slots=True)
class Moved:
    """A reference that is not where it was."""

    moved_m: float
    limit_m: float


def reference_excess(cell: Cell, arm: ArmModel, before: Sample, again: Sample) -> Moved | None:
    """How far the surface seems to have moved along the beam, if that is more than noise.

    Both residuals are taken with the same model, so that its errors cancel.
    Raises DeviceError when the second measurement saw nothing.
    """
    if not again.good:
        raise DeviceError(
            f"The reference point cannot be measured: {again.why}", "Look at laser and plate, then Unhold"
        )
    belief = with_plate(first_belief(cell), cell)
    rows = evaluate(belief, Chain(arm, observations(cell, [before, again])))
    moved_m = float(abs(rows.residual_m[1] - rows.residual_m[0]))
    limit_m = float(FACTOR * np.sqrt(rows.noise_variance.sum()))
    return Moved(moved_m, limit_m) if moved_m > limit_m else None
