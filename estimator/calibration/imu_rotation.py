"""The rotation of an unknown IMU in the frame of a camera, by the rotation of the images against the gyroscope.

The rotations between frames that the images show, in the frame of the camera, are those of the gyroscope in that of
the IMU, turned by the rotation between both. It is the solution of Wahba's problem at the time offset and the gyroscope
bias that suit best (Markley, "Attitude determination using vector observations and the singular value decomposition",
J. Astronautical Sciences 1988). It is determined if the rotation of the images is about two axes or more.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.calibration.image_rotation import RelativeRotations
from dronevio.estimator.calibration.rotation_offset import GRID_S, MIN_EXPLAINED, MIN_PAIRS
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples

MAX_SIGMA_RAD = 0.05
"""Largest standard deviation of a significant rotation, about the axis that is known least [rad]."""

_ITERATIONS = 5
_NOISE_RAD = 2e-4  # least noise of a rotation by the images, some tenths of a pixel


@dataclass(frozen=True, eq=False)
class ImuRotation:
    """The rotation of an IMU in the frame of a camera, and what shows whether it is known."""

    R_imu_cam: Array
    """(3, 3) Rotation from the frame of the camera into that of the IMU."""
    offset_s: float
    """Time offset, t_imu = t_cam + offset [s]."""
    sigma_rad: float
    """Standard deviation of the rotation about the axis that is known least [rad]."""
    explained: float
    """Share of the images' rotation about its mean that the gyroscope explains."""

    @property
    def is_significant(self) -> bool:
        """Whether the gyroscope explains the rotation of the images, and that is about two axes or more."""
        return self.explained >= MIN_EXPLAINED and self.sigma_rad <= MAX_SIGMA_RAD


def imu_rotation(measured: RelativeRotations, imu: ImuSamples, max_offset_s: float = 0.3) -> ImuRotation | None:
    """Return the rotation of the IMU.

    Args:
        measured: Relative rotations by the images alone, in the frame of the camera.
        imu: Samples of the IMU.
        max_offset_s: The time offsets from minus to plus this one are tried [s].

    Returns:
        The best rotation, significant or not; None if there are too few pairs of frames.
    """
    t_s, angle = _integral(imu)
    start_s, end_s = ((t_ns - imu.t_ns[0]) * 1e-9 for t_ns in (measured.start_ns, measured.end_ns))
    usable = (start_s - max_offset_s >= t_s[0]) & (end_s + max_offset_s <= t_s[-1]) & np.isfinite(measured.sigma_rad)
    if usable.sum() < MIN_PAIRS:
        return None
    pairs, start_s, end_s = measured[usable], start_s[usable], end_s[usable]
    candidates: list[ImuRotation] = []
    steps = int(np.ceil(max_offset_s / GRID_S))
    for offset_s in (GRID_S * np.arange(-steps, steps + 1)).tolist():
        at_end, at_start = (_at(t_s, angle, times + offset_s) for times in (end_s, start_s))
        R, sigma_rad, explained = _aligned(at_end - at_start, pairs)
        candidates.append(ImuRotation(R, offset_s, sigma_rad, explained))
    return max(candidates, key=lambda candidate: candidate.explained)


def _integral(imu: ImuSamples) -> tuple[Array, Array]:
    """Return times (N,) from the first sample on [s] and the integral (N, 3) of the angular velocity up to them [rad].

    The rotations of pairs are small, so that the order of rotations within a pair does not matter.
    """
    t_s = (imu.t_ns - imu.t_ns[0]) * 1e-9
    means = 0.5 * (imu.gyro_rad_s[1:] + imu.gyro_rad_s[:-1]) if imu.sampling == "point" else imu.gyro_rad_s[1:]
    return t_s, np.concatenate([np.zeros((1, 3)), np.cumsum(means * np.diff(t_s)[:, None], axis=0)])


def _at(t_s: Array, values: Array, times_s: Array) -> Array:
    """Return values (N, 3) at other times (P,) by linear interpolation."""
    return np.stack([np.interp(times_s, t_s, column) for column in values.T], axis=1)


def _aligned(gyro_rad: Array, pairs: RelativeRotations) -> tuple[Array, float, float]:
    """Return the rotation, its standard deviation [rad] and the share of the images' rotation that it explains.

    Args:
        gyro_rad: (P, 3) Rotations by the gyroscope, in its frame [rad].
        pairs: Rotations by the images.
    """
    span_s, image_rad = pairs.span_s[:, None], pairs.rotation_rad
    noise_rad = np.maximum(pairs.sigma_rad, _NOISE_RAD)
    weights, R, bias = noise_rad**-2, np.eye(3), np.zeros(3)
    for _ in range(_ITERATIONS):
        total = (weights[:, None] * span_s**2).sum()
        means = [(weights[:, None] * span_s * each).sum(axis=0) / total for each in (gyro_rad, image_rad)]
        centred = [each - span_s * mean for each, mean in zip((gyro_rad, image_rad), means, strict=True)]
        U, _, Vt = np.linalg.svd((weights[:, None] * centred[0]).T @ centred[1])
        R = U @ np.diag([1.0, 1.0, float(np.linalg.det(U @ Vt))]) @ Vt
        bias = means[0] - R @ means[1]
        residual = np.linalg.norm(gyro_rad - image_rad @ R.T - span_s * bias, axis=1) / noise_rad
        scale = max(float(np.median(residual)), 1e-9)
        weights = noise_rad**-2 / (1.0 + (residual / (3.0 * scale)) ** 2) ** 2
    turned = centred[1] @ R.T
    moment = (weights[:, None] * turned).T @ turned
    information = np.trace(moment) * np.eye(3) - moment
    smallest = float(np.linalg.eigvalsh(information)[0])
    sigma_rad = scale / np.sqrt(smallest) if smallest > 0.0 else np.inf
    rates = image_rad / span_s
    constant = np.linalg.norm(image_rad - span_s * np.median(rates, axis=0), axis=1) / noise_rad
    return R, float(sigma_rad), 1.0 - float(residual.sum() / max(constant.sum(), 1e-12))
