"""What is to be added to a rig's calibration, as numbers and as words."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

PER_CAMERA = 10
"""Parameters of a camera: turn (3), place (3), focal lengths (2), principal point (2)."""


@dataclass(frozen=True, eq=False)
class Corrections:
    """What is to be added to a rig's calibration, for C cameras.

    As a vector it is the time offset, and then for each camera its ten numbers.
    """

    time_offset_s: float
    """How much later than known the middle row is exposed [s]."""
    rotation_rad: Array
    """(C, 3) Turns of the cameras in their own axes: R_imu_cam exp(turn) [rad]."""
    translation_m: Array
    """(C, 3) Displacements of the cameras in the IMU frame [m]."""
    focal: Array
    """(C, 2) How much longer fx and fy are, relative."""
    principal: Array
    """(C, 2) Displacements of the principal points, in units of fx and fy."""

    @classmethod
    def from_vector(cls, x: Array) -> "Corrections":
        """Return the corrections that a vector (1 + 10 C,) holds."""
        rows = x[1:].reshape(-1, PER_CAMERA)
        return cls(float(x[0]), rows[:, 0:3], rows[:, 3:6], rows[:, 6:8], rows[:, 8:10])

    def __str__(self) -> str:
        """Return those that are not zero, for people."""
        said = [f"clock {1e3 * self.time_offset_s:+.1f} ms"] if self.time_offset_s else []
        for i, turn_deg in enumerate(np.degrees(self.rotation_rad)):
            said += [f"camera {i} turned by {_listed(turn_deg, 2)}°"] if turn_deg.any() else []
            said += [f"moved by {_listed(1e3 * self.translation_m[i], 0)} mm"] if self.translation_m[i].any() else []
            said += [f"focal lengths {_listed(1e2 * self.focal[i], 2)} %"] if self.focal[i].any() else []
            said += [f"principal point {_listed(1e3 * self.principal[i], 1)} mrad"] if self.principal[i].any() else []
        return ", ".join(said) or "none"


def _listed(numbers: Array, digits: int) -> str:
    return " ".join(f"{number:+.{digits}f}" for number in numbers.tolist())
