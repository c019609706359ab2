"""What a distance sensor sees of the world."""

from typing import Protocol

from estimation.transform import FloatArray


class Beam(Protocol):
    """A ray along the sensor's axis."""

    def beam_lengths_m(self, times_s: FloatArray) -> FloatArray:
        """True distances (n,) at past instants (n,); nan where no light returns."""
