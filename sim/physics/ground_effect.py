"""Ground effect: the gain of thrust of rotors near the ground."""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.quadrotor import Quadrotor

_NEAREST_GROUND = 0.5  # in rotor radii: below, the potential flow is singular and there are no measurements


class GroundEffect:
    """Ratio of thrust near the ground to that in free air, of the rotors of one vehicle type.

    The model is potential flow with an image of each rotor below the ground, which acts on all rotors (Sanchez-Cuevas,
    Heredia, Ollero, "Characterization of the aerodynamic ground effect and its influence in multirotor control", Int.
    J. Aerospace Engineering 2017), without its last term, the fountain effect on the body, which requires measurements
    of each vehicle. Each rotor is seen at its own height.
    """

    def __init__(self, quadrotor: Quadrotor) -> None:
        """Define the distances between rotors from the vehicle type."""
        self._radius_m, reach = quadrotor.rotor_radius_m, quadrotor.reach_m
        places = quadrotor.rotor_positions_m
        self._heights_m = places[:, 2]
        apart = np.square(places[:, None, :2] - places[:, :2]).sum(axis=2)[~np.eye(len(places), dtype=bool)]
        relative = np.sort(np.round(apart / reach**2, 12).reshape(len(places), -1), axis=1)
        nearest = relative[relative > 0.0].min()
        side_m = reach * np.sqrt(nearest)
        self._alike = bool((relative == relative[0]).all())
        """Whether each rotor has the same distances from the others, as in a regular polygon."""
        distances, counts = (
            np.unique(relative[0], return_counts=True) if self._alike else (relative.T, [1] * len(relative.T))
        )
        self._images = [
            (squared / nearest * side_m * side_m, 0.5 * count) for squared, count in zip(distances, counts, strict=True)
        ]

    def ratio(self, height_m: Array) -> Array:
        """Return the ratio of each rotor (…, R) at its height (…, R) above the ground [m].

        If each rotor has the same distances from the others, heights of any shape may be given.
        """
        R = self._radius_m
        z = np.maximum(height_m, _NEAREST_GROUND * R)
        four = 4.0 * z * z
        others: Array | float = 0.0
        for squared, weight in self._images:
            slant = squared + four
            others = others + weight / (slant * np.sqrt(slant))
        return np.asarray(1.0 / (1.0 - R * R * (0.25 / four + z * others)))

    def mean_ratio(self, height_m: Array) -> Array:
        """Return the mean ratio (…) of the rotors of level vehicles, whose centres of mass have heights (…) [m]."""
        heights = self._heights_m
        if self._alike and (heights == heights[0]).all():
            return self.ratio(height_m + heights[0])
        return np.asarray(self.ratio(np.asarray(height_m)[..., None] + heights).mean(axis=-1))
