"""Vibration of the airframes of many vehicles by their rotors, as their IMUs measure it, sample by sample."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig
from dronevio.sim.inertial.vibration import Tones

Rows = npt.NDArray[np.intp]


class HarmonicsState(NamedTuple):
    """State of a `BatchHarmonics`."""

    angle_rad: Array
    """(n, R) Angles of the rotors at the last sample [rad]."""
    speed_rad_s: Array
    """(n, R) Speeds of the rotors from the last sample on [rad/s]."""


class BatchHarmonics:
    """`RotorHarmonics` of n vehicles of one type, for one point sample of each at a time."""

    def __init__(self, quadrotor: Quadrotor, rig: Rig, count: int) -> None:
        """Define vehicles and IMUs; `renew` has to draw the angles of the rotors.

        Args:
            quadrotor: Positions, directions of rotation and vibration parameters of the rotors.
            rig: Mounting, rate and bandwidths of the IMU.
            count: Number of vehicles.
        """
        self._tones = Tones(quadrotor, rig)
        self._interval_s = 1.0 / rig.imu.rate_hz
        standstill = np.zeros((count, quadrotor.rotor_count))
        self.state = HarmonicsState(standstill, standstill)
        """State of the rotors, whose arrays are never modified."""

    def renew(self, rows: Rows, rng: np.random.Generator) -> None:
        """Draw new angles of the rotors of k vehicles (k,)."""
        angle, speed = self.state.angle_rad.copy(), self.state.speed_rad_s.copy()
        angle[rows], speed[rows] = rng.uniform(0.0, 2.0 * np.pi, (len(rows), angle.shape[1])), 0.0
        self.state = HarmonicsState(angle, speed)

    def first(self, rotor_speeds_rad_s: Array | None, rows: Rows) -> Array:
        """Return the vibration (k, 6) of some vehicles at their renewal.

        Args:
            rotor_speeds_rad_s: (k, R) Speeds of their rotors [rad/s]; None is standstill.
            rows: (k,) Indices of the vehicles.
        """
        speed = self.state.speed_rad_s.copy()
        speed[rows] = 0.0 if rotor_speeds_rad_s is None else rotor_speeds_rad_s
        self.state = HarmonicsState(self.state.angle_rad, speed)
        return self._at(self.state.angle_rad[rows], speed[rows])

    def following(self, rotor_speeds_rad_s: Array | None) -> Array:
        """Return the vibration (n, 6) of all vehicles one sample later: angular velocities and specific forces.

        Args:
            rotor_speeds_rad_s: (n, R) Speeds of the rotors from this sample on [rad/s]; None is standstill.
        """
        angle = self.state.angle_rad + self.state.speed_rad_s * self._interval_s
        speed = np.zeros_like(angle) if rotor_speeds_rad_s is None else np.array(rotor_speeds_rad_s)
        self.state = HarmonicsState(angle, speed)
        return self._at(angle, speed)

    def _at(self, angle: Array, speeds: Array) -> Array:
        """Return the vibration (k, 6) at angles (k, R) [rad] and speeds (k, R) [rad/s]."""
        return np.concatenate(self._tones.at(angle, np.zeros_like(speeds), speeds), axis=1)
