"""Samples and complete states of a batch plant."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.sim.physics.rotors import RotorState
from dronevio.sim.physics.vehicle_states import Mask, VehicleParameters
from dronevio.sim.physics.wind import AirState

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointSamples:
    """One noise-free point sample of the IMU of each of n vehicles."""

    gyro_rad_s: Array
    """(n, 3) Angular velocities in the IMU frame [rad/s]."""
    accel_m_s2: Array
    """(n, 3) Specific forces in the IMU frame [m/s²]."""


@dataclass(frozen=True, eq=False)
class PlantState:
    """Complete state of a `BatchPlant`."""

    physics: Array
    """(n, S) States of MuJoCo."""
    rotors: RotorState
    """States of rotors and batteries."""
    parameters: VehicleParameters
    """Physical parameters of the vehicles."""
    air: AirState
    """State of the air."""
    elapsed: npt.NDArray[np.int64]
    """(n,) IMU intervals since the resets."""
    touched: Mask
    """(n,) Which vehicles have collided."""
    diverged: Mask
    """(n,) Which simulations have diverged."""
    motion: Array
    """(13, n) Motion of the physics at the clock."""
    velocity_between: Array
    """(3, n) Velocities of the IMUs half an interval after the clock [m/s]."""
    samples: PointSamples
    """IMU samples of the clock."""
