"""Errors of the time stamps of frames: estimated for each frame from its innovation.

Cameras without a hardware trigger stamp frames when they arrive, which errs by milliseconds from frame to frame. A
constant error is part of the calibration; what varies has the same effect on all landmarks of a frame. If a frame is
exposed a time δ after its stamp, the innovation of a landmark is its velocity in the image times δ, besides the errors of
the prediction and of the image. δ is therefore fitted to the innovation of each frame by weighted least squares, with the
position and the orientation of the prediction as further unknowns and their covariance as prior.

The prior of δ is normal. Its variance is that of the stamps about a regular clock, until images show it: then it follows
from the differences between the fits of successive frames, from which errors of the prediction vanish that change slowly,
such as those of a wrong calibration. Stamps that are regular are taken as exact.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.innovation import Innovation, median
from dronevio.models.ranges import Range, Settings
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

MEDIAN_CHI2_1DOF = 0.4549
"""Median of the χ² distribution with one degree of freedom."""


@dataclass(frozen=True)
class StampErrorConfig(Settings):
    """How errors of the time stamps of frames are estimated."""

    online: bool = True
    """Whether they are estimated."""
    min_landmarks: Annotated[int, Range(4, 1000)] = 8
    """Smallest number of landmarks of a frame whose stamp is estimated."""
    memory: Annotated[int, Range(8, 1000)] = 30
    """Number of frames from which the standard deviation of the stamps is estimated."""
    min_frames: Annotated[int, Range(3, 1000)] = 8
    """Smallest number of these frames."""
    max_sigma_s: Annotated[float, Range(above=0.0, high=1.0)] = 0.003
    """Largest standard deviation of the estimate of a stamp's error that is used for it [s]. While a vehicle hovers, the
    image does not show when it was exposed."""
    min_error_s: Annotated[float, Range(low=0.0, high=1.0)] = 0.0003
    """Standard deviation of stamps up to which they are taken as exact [s]."""
    max_error_s: Annotated[float, Range(above=0.0, high=1.0)] = 0.02
    """Largest standard deviation of stamps [s]."""


class StampErrorEstimator:
    """Estimates the error of each frame's time stamp, and the standard deviation of these errors."""

    def __init__(self, config: StampErrorConfig) -> None:
        """Begin before the first frame."""
        self._config = config
        self._stamps_ns: tuple[int, ...] = ()
        self._irregularity_s = 0.0
        self._last: tuple[float, float] | None = None  # error of the last frame's stamp and its variance
        self._variances: tuple[float, ...] = ()  # of the stamps, by the differences of successive frames

    def add_stamp(self, t_ns: int) -> None:
        """Add the time stamp of the next frame [ns]."""
        c = self._config
        self._stamps_ns = (*self._stamps_ns, t_ns)[-c.memory - 1 :]
        if c.online and len(self._stamps_ns) > c.min_frames:
            found = irregularity_s(np.diff(self._stamps_ns) * 1e-9)
            self._irregularity_s = min(found, c.max_error_s) if found > c.min_error_s else 0.0

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the errors of the stamps [s]; 0 if they are taken as exact."""
        c = self._config
        if self._irregularity_s == 0.0 or len(self._variances) < c.min_frames:
            return self._irregularity_s
        variance = median(np.array(self._variances))
        return min(variance**0.5, c.max_error_s) if variance > c.min_error_s**2 else 0.0

    def estimate_s(self, innovation: Innovation, predicted: NavState, angular_velocity_rad_s: Array) -> float:
        """Return the time from a frame's stamp to its exposure [s].

        Args:
            innovation: The innovation of the frame.
            predicted: The state that the IMU predicts for the stamp.
            angular_velocity_rad_s: (3,) Angular velocity of the IMU at the frame, bias removed [rad/s].
        """
        c = self._config
        if self._irregularity_s == 0.0 or len(innovation) < c.min_landmarks:
            self._last = None
            return 0.0
        weighted, information = stamp_information(innovation, predicted, angular_velocity_rad_s)
        if information * c.max_sigma_s**2 > 1.0:
            self._update(weighted / information, 1.0 / information)
        else:
            self._last = None
        sigma_s = self.sigma_s
        return weighted / (information + sigma_s**-2) if sigma_s > 0.0 else 0.0

    def _update(self, error_s: float, variance: float) -> None:
        """Take the error of a stamp and its variance into account in the variance of the stamps."""
        last, self._last = self._last, (error_s, variance)
        if last is not None:
            found = 0.5 * ((error_s - last[0]) ** 2 / MEDIAN_CHI2_1DOF - variance - last[1])
            self._variances = (*self._variances, found)[-self._config.memory :]


def irregularity_s(intervals_s: Array) -> float:
    """Return the standard deviation of time stamps about a regular clock, some of whose ticks may be missing [s].

    Args:
        intervals_s: (N,) Intervals between successive stamps [s].
    """
    shortest_s = float(np.partition(intervals_s, len(intervals_s) // 8)[len(intervals_s) // 8])
    ticks = np.maximum(np.rint(intervals_s / shortest_s), 1.0)
    error_s = intervals_s - ticks * median(intervals_s / ticks)
    return (0.5 * median(error_s**2) / MEDIAN_CHI2_1DOF) ** 0.5


def stamp_information(
    innovation: Innovation, predicted: NavState, angular_velocity_rad_s: Array
) -> tuple[float, float]:
    """Return the information that a frame's innovation contains on the error of its stamp.

    Outliers are weighted down by Cauchy's loss, with the median of the residuals as scale.

    Args:
        innovation: The innovation of the frame.
        predicted: The state that the IMU predicts for the stamp.
        angular_velocity_rad_s: (3,) Angular velocity of the IMU at the frame, bias removed [rad/s].

    Returns:
        The estimate without prior [s] times its information, and the information [1/s²].
    """
    R, u = innovation.R_world_imu, innovation.uncertainty
    velocity = -np.cross(angular_velocity_rad_s, innovation.in_imu) - predicted.velocity_m_s @ R
    J, x, y, z = innovation.J_imu, *innovation.in_imu.T
    # Columns: δ, the position (3) and the orientation (3) of the prediction in the IMU frame, and the residual
    A = np.empty((len(innovation), 2, 8))
    A[..., 0] = J[..., 0] * velocity[:, :1] + J[..., 1] * velocity[:, 1:2] + J[..., 2] * velocity[:, 2:]
    A[..., 1:4] = -J
    A[..., 4] = J[..., 1] * z[:, None] - J[..., 2] * y[:, None]
    A[..., 5] = J[..., 2] * x[:, None] - J[..., 0] * z[:, None]
    A[..., 6] = J[..., 0] * y[:, None] - J[..., 1] * x[:, None]
    A[..., 7] = innovation.residual_px
    prior = np.zeros((6, 6))
    prior[:3, :3] = np.linalg.inv(R.T @ u.position_covariance @ R + 1e-10 * np.eye(3))
    prior[range(3, 6), range(3, 6)] = 1.0 / (u.rotation_variance + 1e-10)
    residual, weighted, information = innovation.residual_px, 0.0, 0.0
    for _ in range(2):
        squares = (residual**2).sum(axis=1)
        weight = np.sqrt(1.0 / (u.image_variance_px2 * (1.0 + squares / (median(squares) + u.image_variance_px2))))
        scaled = (A * weight[:, None, None]).reshape(-1, 8)
        H = scaled.T @ scaled
        nuisance = H[1:7, 1:7] + prior
        gain = np.linalg.solve(nuisance, H[1:7, [0, 7]])
        information = float(H[0, 0] - H[0, 1:7] @ gain[:, 0])
        weighted = float(H[0, 7] - H[0, 1:7] @ gain[:, 1])
        delta = weighted / max(information, 1e-6)
        others = gain[:, 1] - gain[:, 0] * delta
        residual = innovation.residual_px - A[..., 0] * delta - A[..., 1:7] @ others
    return weighted, information
