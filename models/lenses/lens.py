"""Lenses by name: what bends the rays between the world and the image plane."""

from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from dronevio.models.lenses import equidistant, radtan

Array = npt.NDArray[np.float64]
Coefficients = tuple[float, float, float, float]
LensName = Literal["radtan", "equidistant"]


class Lens(Protocol):
    """A lens; the image plane is measured in focal lengths from the principal point."""

    def reach(self, coefficients: Coefficients) -> float:
        """Return how far off its axis the lens is defined: a radius at depth 1, or an angle [rad]."""

    def project(self, p_cam: Array, coefficients: Coefficients) -> Array:
        """Return where points (…, 3) of the camera frame are imaged (…, 2); NaN outside what the lens sees."""

    def rays(self, uv: Array, coefficients: Coefficients) -> Array:
        """Return rays (…, 3) of any length in the camera frame that are imaged at (…, 2); NaN where none is."""


LENSES: dict[LensName, Lens] = {"radtan": radtan, "equidistant": equidistant}
"""Every lens, by the name that Kalibr gives it."""
