"""Initializations that are not possible yet: the reason, and the probable cause where measurements disagree."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ROTATION_DISAGREES = (
    "gyroscope and images disagree about the rotation: check the camera-IMU extrinsics, the lens model, the axes and "
    "units of the gyroscope, and the time stamps"
)
"""Cause of a failed initialization where no plausible gyroscope bias explains the epipolar geometry."""
ACCEL_DISAGREES = (
    "accelerometer and images disagree about the translation: check the axes and units of the accelerometer, and the "
    "lens model, or most of what is visible moves"
)
"""Cause of a failed initialization where the gyroscope agrees with the images during rotations."""
MOTION_DISAGREES = (
    "IMU and images disagree: check the camera-IMU extrinsics, the lens model, the axes and units of the IMU, and the "
    "time stamps, or most of what is visible moves"
)
"""Cause of a failed initialization where the rotations are too slow to tell gyroscope from accelerometer."""
FORCE_IS_NOT_GRAVITY = "the specific force is not that of gravity: check the units of the accelerometer"
"""Cause of a failed initialization where the accelerometer cannot measure m/s²."""
MAX_GRAVITY_RATIO = 2.5
"""Largest plausible ratio, in either direction, of the median specific force during an initialization to gravity."""


@dataclass(frozen=True)
class NotObservable:
    """The result of an initialization whose state is not observable yet."""

    reason: str
    """The reason, as a text for people."""
    cause: str = ""
    """The probable cause, where measurements disagree with each other."""

    def __str__(self) -> str:
        return "; ".join(filter(None, (f"not observable yet: {self.reason}", self.cause)))


def implausible_force(accel_m_s2: Array, gravity_m_s2: float) -> NotObservable | None:
    """Return why specific forces cannot be used, or None where they can.

    Args:
        accel_m_s2: (N, 3) Specific forces during an initialization [m/s²].
        gravity_m_s2: Magnitude of gravity [m/s²].
    """
    if len(accel_m_s2) == 0:
        return NotObservable("no samples of the IMU")
    force_m_s2 = float(np.median(np.linalg.norm(accel_m_s2, axis=1)))
    if 1.0 / MAX_GRAVITY_RATIO < force_m_s2 / gravity_m_s2 < MAX_GRAVITY_RATIO:
        return None
    reason = f"a median specific force of {force_m_s2:.2f} m/s², where about {gravity_m_s2:.2f} is expected"
    return NotObservable(reason, FORCE_IS_NOT_GRAVITY)
