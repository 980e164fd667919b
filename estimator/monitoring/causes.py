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
