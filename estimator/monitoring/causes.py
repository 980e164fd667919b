"""Why an estimate has its health: the causes, as texts whose numbers are filled in for a frame."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Self


class Cause(StrEnum):
    """Cause of a health. The values are texts for people, with the names of numbers in braces."""

    # Tracking
    LANDMARKS = "constrained by {landmarks} landmarks"
    STATIONARY = "stationary"
    NO_IMAGE = "no image for {inertial_only_s:.2f} s"
    NOT_TRIANGULATED = "features are tracked and not triangulated yet"

    # Inertial-only
    FEW_LANDMARKS = "constrained by {landmarks} landmarks; {min_landmarks} are needed"
    INCONSISTENT = "images and prediction have recently been inconsistent"
    IMPLAUSIBLE_CALIBRATION = (
        "images and calibration do not belong together: check the camera-IMU extrinsics, the lens model, the order of"
        " the cameras, and the time stamps"
    )
    UNKNOWN_CALIBRATION = "the calibration of the cameras is wrong, and not known again yet"
    EXCESSIVE_NOISE = (
        "vibration makes the IMU many times noisier than its data sheet: check its mount, its range and filter, and"
        " that no samples are left out without averaging"
    )

    # Lost
    NOT_FINITE = "the state is not finite"
    SPEED = "a speed of {speed_m_s:.0f} m/s"
    BIAS = "a bias of {bias_sigmas:.0f} standard deviations"
    CONTRADICTED = "landmarks have contradicted the estimate for {contradicted_s:.1f} s"
    DISCONNECTED = (
        "no feature connects the images with those of {disconnected_s:.1f} s ago, and they contradict the IMU"
    )
    INNOVATIONS = "images and prediction are inconsistent: a NIS of {nis:.0f} over {window_s:g} s"
    DRIFT = "the position has drifted by {drift_m:.1f} m (one sigma) on the IMU alone"
    ROTATION_JUMP = "a rotation of {turned_deg:.0f}° in {dt_s:.2f} s, which the gyroscope does not measure"
    VELOCITY_JUMP = "a velocity that changes by {change_m_s:.1f} m/s in {dt_s:.2f} s, which the IMU does not measure"
    POSITION_JUMP = "a position that jumps by {jump_m:.1f} m, which the velocity does not explain"
    TIME_OFFSET = "the time offset of camera and IMU is another one"

    # Without a state
    NOT_OBSERVABLE = "{reason}"
    CONTRADICTION = "not observable yet: images and IMU contradict each other; rotation shows whether clocks differ"

    # Probable causes of failed initializations
    ROTATION_DISAGREES = (
        "gyroscope and images disagree about the rotation: check the camera-IMU extrinsics, the lens model, the axes"
        " and units of the gyroscope, and the time stamps"
    )
    """Where no plausible gyroscope bias explains the epipolar geometry."""
    ACCEL_DISAGREES = (
        "accelerometer and images disagree about the translation: check the axes and units of the accelerometer, and"
        " the lens model, or most of what is visible moves"
    )
    """Where the gyroscope agrees with the images during rotations."""
    MOTION_DISAGREES = (
        "IMU and images disagree: check the camera-IMU extrinsics, the lens model, the axes and units of the IMU, and"
        " the time stamps, or most of what is visible moves"
    )
    """Where the rotations are too slow to tell gyroscope from accelerometer."""
    CLOCKS_DISAGREE = (
        "the clocks of camera and IMU disagree: check the time stamps, and the time offset of the calibration"
    )
    """Where another time offset explains images and IMU much better."""
    FORCE_IS_NOT_GRAVITY = "the specific force is not that of gravity: check the units of the accelerometer"
    """Where the accelerometer cannot measure m/s²."""
    SENSORS_SWAPPED = (
        "the gyroscope reads what an accelerometer should, and the reverse: they are probably swapped; check the order"
        " of the IMU's columns, or its topics"
    )
    """Where the gyroscope measures a constant magnitude, that of gravity."""


@dataclass(frozen=True)
class Reason:
    """A cause with the numbers of a frame."""

    cause: Cause
    """The cause."""
    text: str
    """The cause in these numbers."""

    def __str__(self) -> str:
        return self.text

    @classmethod
    def of(cls, cause: Cause, **numbers: float | str) -> Self:
        """Return a cause with the numbers that its text names."""
        return cls(cause, cause.value.format(**numbers))
