"""Protocol of lens models, and the models by name."""

from collections.abc import Mapping
from typing import Literal, Protocol

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.lenses import ds, equidistant, eucm, fov, omni, radtan
from dronevio.models.ranges import Range

Coefficients = tuple[float, ...]
LensName = Literal["radtan", "equidistant", "fov", "ds", "eucm", "omni"]


class Lens(Protocol):
    """A lens model. Image coordinates are relative to the principal point, in units of the focal length."""

    COEFFICIENTS: Mapping[str, Range]
    """Names and ranges of the coefficients, in their order."""
    COUNTS: tuple[int, ...]
    """Allowed numbers of coefficients; those that are left out are zero."""

    def central_scale(self, coefficients: Coefficients) -> float:
        """Return the radius in the image, in focal lengths, per radian from the optical axis, near the axis."""

    def project(self, p_cam: Array, coefficients: Coefficients) -> Array:
        """Return image coordinates (…, 2) of points (…, 3) in the camera frame; NaN outside the valid domain."""

    def unproject(self, uv: Array, coefficients: Coefficients) -> Array:
        """Return rays (…, 3), of arbitrary length, of image coordinates (…, 2); NaN where there is none."""


LENSES: dict[LensName, Lens] = {
    "radtan": radtan,
    "equidistant": equidistant,
    "fov": fov,
    "ds": ds,
    "eucm": eucm,
    "omni": omni,
}
"""The lens models by the names that Kalibr uses."""


def check_coefficients(lens: LensName, coefficients: Coefficients) -> None:
    """Check the number of the coefficients of a lens, and their ranges.

    Raises:
        ConfigError: The number is wrong, or a value is outside its range; the message names the coefficients.
    """
    model = LENSES[lens]
    names = tuple(model.COEFFICIENTS)
    if len(coefficients) not in model.COUNTS:
        expected = " or ".join(f"{count} numbers ({', '.join(names[:count])})" for count in model.COUNTS)
        raise ConfigError(f"camera distortion of {len(coefficients)} numbers; expected {expected} for the lens {lens}")
    for (name, allowed), value in zip(model.COEFFICIENTS.items(), coefficients, strict=False):
        if value not in allowed:
            raise ConfigError(f"camera {name} = {value}; expected a number, {allowed}, for the lens {lens}")
