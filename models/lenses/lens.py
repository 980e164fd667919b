"""Protocol of lens models, and the models by name."""

from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from dronevio.models.lenses import equidistant, radtan

Array = npt.NDArray[np.float64]
Coefficients = tuple[float, float, float, float]
LensName = Literal["radtan", "equidistant"]


class Lens(Protocol):
    """A lens model. Image coordinates are relative to the principal point, in units of the focal length."""

    def valid_limit(self, coefficients: Coefficients) -> float:
        """Return the limit of the valid domain: a radius at depth 1 or an angle from the optical axis [rad]."""

    def project(self, p_cam: Array, coefficients: Coefficients) -> Array:
        """Return image coordinates (…, 2) of points (…, 3) in the camera frame; NaN outside the valid domain."""

    def unproject(self, uv: Array, coefficients: Coefficients) -> Array:
        """Return rays (…, 3), of arbitrary length, of image coordinates (…, 2); NaN where there is none."""


LENSES: dict[LensName, Lens] = {"radtan": radtan, "equidistant": equidistant}
"""The lens models by the names that Kalibr uses."""
