"""What goes wrong on a flight, on purpose: the stress that an estimator is to survive."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.physics.rotors import MotorFailure

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Faults:
    """Everything that may go wrong; nothing does by default.

    What is *hidden* is missing from the calibration that goes with the recording: the estimator believes a rig that is
    not quite the one that flew. The truth of all of it is kept with the flight.
    """

    dropped_frames: float = 0.0
    """Share of the frames that are lost, drawn one by one; the first one never is."""
    stamp_jitter_s: float = 0.0
    """Standard deviation of the error of the frames' time stamps [s]."""
    dark_from_s: float = 0.0
    """When the camera goes dark, from the flight's start [s]."""
    dark_for_s: float = 0.0
    """How long it then shows nothing but noise [s]."""
    hidden_time_offset_s: float = 0.0
    """Beside the rig's own time offset: frames are taken so much later than the calibration says [s]."""
    hidden_tilt_rad: float = 0.0
    """How far each camera is turned from where the calibration has it, about an axis drawn for each [rad]."""
    imu_noise_factor: float = 1.0
    """White noise and bias walks of the IMU, relative to what the calibration says."""
    gyro_range_rad_s: float = float("inf")
    """The gyroscope reads no more than this about any axis [rad/s], whatever the calibration says."""
    failing_rotor: int = 0
    """Which rotor fails, 0 to 3."""
    rotor_fails_at_s: float = float("inf")
    """When it loses its power, from the flight's start [s]."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: One of them is impossible.
        """
        _require(0.0 <= self.dropped_frames < 1.0, "dropped_frames", self.dropped_frames, "from 0 to below 1")
        for name in ("stamp_jitter_s", "dark_from_s", "dark_for_s", "imu_noise_factor", "rotor_fails_at_s"):
            _require(getattr(self, name) >= 0.0, name, getattr(self, name), "0 or more")
        _require(self.gyro_range_rad_s > 0.0, "gyro_range_rad_s", self.gyro_range_rad_s, "more than 0")
        _require(self.failing_rotor in range(4), "failing_rotor", self.failing_rotor, "0, 1, 2 or 3")
        for name in ("hidden_time_offset_s", "hidden_tilt_rad"):
            _require(abs(getattr(self, name)) < 1.0, name, getattr(self, name), "less than 1, else nothing hides it")

    @property
    def motor_failure(self) -> MotorFailure | None:
        """Which rotor fails and when; None if none does."""
        return MotorFailure(self.failing_rotor, self.rotor_fails_at_s) if np.isfinite(self.rotor_fails_at_s) else None

    def true_rig(self, calibrated: Rig, rng: np.random.Generator) -> Rig:
        """Return the rig that really flies where the calibration says ``calibrated``.

        Args:
            calibrated: What an estimator is told.
            rng: Draws the axes about which the cameras are turned.
        """
        axes = rng.standard_normal((len(calibrated.cameras), 3))
        tilts = self.hidden_tilt_rad * axes / np.linalg.norm(axes, axis=1, keepdims=True)
        cameras = tuple(
            replace(camera, T_imu_cam=camera.T_imu_cam @ pose_matrix(exp_so3(tilt), np.zeros(3)))
            if self.hidden_tilt_rad
            else camera
            for camera, tilt in zip(calibrated.cameras, tilts, strict=True)
        )
        offset_s = calibrated.time_offset_s + self.hidden_time_offset_s
        return replace(calibrated, cameras=cameras, imu=self._true_imu(calibrated.imu), time_offset_s=offset_s)

    def _true_imu(self, calibrated: ImuModel) -> ImuModel:
        """Return the IMU that really flies."""
        factor = self.imu_noise_factor
        return replace(
            calibrated,
            gyro_noise_density=factor * calibrated.gyro_noise_density,
            gyro_random_walk=factor * calibrated.gyro_random_walk,
            accel_noise_density=factor * calibrated.accel_noise_density,
            accel_random_walk=factor * calibrated.accel_random_walk,
            gyro_range_rad_s=min(self.gyro_range_rad_s, calibrated.gyro_range_rad_s),
        )


def _require(holds: bool, name: str, value: float, expected: str) -> None:
    """Raise ConfigError unless a number is as expected."""
    if not holds:
        raise ConfigError(f"faults.{name} {value:g}; expected {expected}")
