"""Faults of vehicle and sensors that a scenario introduces on purpose, to test the robustness of estimators."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dronevio.models.imu import ImuModel
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.rotors import MOST_ROTORS
from dronevio.sim.physics.rotors import MotorFailure


@dataclass(frozen=True)
class Faults(Settings):
    """Faults of one flight; there are none by default.

    Faults called *hidden* are not part of the calibration that is stored with the recording: the estimator receives a
    rig that differs from the one that flew. The true values of all faults are stored with the flight.
    """

    dropped_frames: Annotated[float, Range(0.0, below=1.0)] = 0.0
    """Fraction of the frames that are lost, each drawn independently; the first frame is never lost."""
    stamp_jitter_s: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Standard deviation of the error of the time stamps of the frames [s]."""
    dark_from_s: Annotated[float, Range(low=0.0)] = 0.0
    """Time from the start of the flight at which the images become dark [s]."""
    dark_for_s: Annotated[float, Range(low=0.0)] = 0.0
    """Duration of the darkness, during which the images contain noise only [s]."""
    hidden_time_offset_s: Annotated[float, Range(above=-1.0, below=1.0)] = 0.0
    """Time offset of the cameras that the calibration does not contain: frames are taken later than calibrated [s]."""
    hidden_tilt_rad: Annotated[float, Range(above=-1.0, below=1.0)] = 0.0
    """Angle of a rotation of each camera that the calibration does not contain, about a random axis [rad]."""
    imu_noise_factor: Annotated[float, Range(0.0, 1e6)] = 1.0
    """Factor of the white noise and bias random walk of the IMU relative to the calibration."""
    gyro_range_rad_s: Annotated[float, Range(above=0.0, infinite=True)] = float("inf")
    """Measurement range of the gyroscope on each axis, if smaller than the calibrated range [rad/s]."""
    failing_rotor: Annotated[int, Range(0, MOST_ROTORS - 1)] = 0
    """Index of the rotor that fails, from 0 in the order of the vehicle's rotors."""
    rotor_fails_at_s: Annotated[float, Range(low=0.0, infinite=True)] = float("inf")
    """Time from the start of the flight at which the rotor loses its power [s]."""

    @property
    def motor_failure(self) -> MotorFailure | None:
        """The failing rotor and the time of its failure; None without a failure."""
        return MotorFailure(self.failing_rotor, self.rotor_fails_at_s) if np.isfinite(self.rotor_fails_at_s) else None

    def true_rig(self, calibrated: Rig, rng: np.random.Generator) -> Rig:
        """Return the true rig of a flight whose calibration is ``calibrated``.

        Args:
            calibrated: The rig that the estimator receives.
            rng: Generator of the rotation axes of the cameras.
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
        """Return the true IMU of a flight."""
        factor = self.imu_noise_factor
        return replace(
            calibrated,
            gyro_noise_density=factor * calibrated.gyro_noise_density,
            gyro_random_walk=factor * calibrated.gyro_random_walk,
            accel_noise_density=factor * calibrated.accel_noise_density,
            accel_random_walk=factor * calibrated.accel_random_walk,
            gyro_range_rad_s=min(self.gyro_range_rad_s, calibrated.gyro_range_rad_s),
        )
