"""Whether an adjusted map agrees with the odometry that it corrects, and with a loaded map in which it lies.

Bundle adjustment weights images and IMU by models of their errors. Where these are wrong, as for an IMU on a vibrating
mount, its solution may be far from the path that the odometry has estimated with the same measurements, and which loops
confirm up to its drift. Scale, inclination and biases of the two are compared in their joint standard deviations, and
the poses in a loaded map with its loops; an adjusted map that contradicts one of them is not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustedMap, AdjustmentInputs, AdjustmentKeyframe
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.models.rotation import inverse_pose, log_so3

MAX_SIGMAS = 3.0
"""Largest difference that agrees, in standard deviations."""
SCALE_SIGMA = 0.001
"""Standard deviation of the scale of an adjusted map and of the comparison."""
TILT_SIGMA_DEG = 0.1
"""Standard deviation of the inclination of an adjusted map [°]."""
GYRO_BIAS_SIGMA_RAD_S, ACCEL_BIAS_SIGMA_M_S2 = 0.002, 0.02
"""Standard deviations of the biases of an adjusted map [rad/s] and [m/s²]."""
MIN_LENGTH_M = 5.0
"""Shortest path on which scales are compared [m]."""
MIN_DISTANCE_M = 1.0
"""Smallest distance from the first keyframe at which a keyframe bounds the error of scale of the odometry [m]."""


@dataclass(frozen=True)
class Difference:
    """A quantity of an adjusted map beside that of the odometry or of a loaded map."""

    name: str
    """Name of the quantity."""
    unit: str
    """Unit of the quantity."""
    value: float
    """Difference between the two."""
    sigma: float
    """Joint standard deviation of the difference."""
    other: str = "that of the odometry"
    """Reference of the comparison."""

    @property
    def agrees(self) -> bool:
        """Whether the two agree."""
        return abs(self.value) <= MAX_SIGMAS * self.sigma

    def __str__(self) -> str:
        """Return the difference as text."""
        by, sigma = f"{self.value:+.2g} {self.unit}", f"{self.sigma:.2g} {self.unit}"
        return f"{self.name} differs by {by} from {self.other} (joint standard deviation {sigma})"


def differences(inputs: AdjustmentInputs, adjusted: AdjustedMap) -> tuple[Difference, ...]:
    """Return the differences between an adjusted map and the odometry, and a loaded map.

    Args:
        inputs: The measurements.
        adjusted: The adjusted map.
    """
    newest = inputs.keyframes[-1]
    track = [keyframe for keyframe in inputs.keyframes if keyframe.track == newest.track]
    scale, saved = _scale(track, adjusted), _positions(inputs, adjusted)
    compared = (scale, _tilt(newest, adjusted), *_biases(newest, adjusted), saved)
    return tuple(each for each in compared if each is not None)


def _scale(track: Sequence[AdjustmentKeyframe], adjusted: AdjustedMap) -> Difference | None:
    """Return the difference of the scales; None for a path that is too short."""
    p = np.array([(adjusted.poses[k.number][:3, 3], k.estimate.T_odom_imu[:3, 3]) for k in track])
    adjusted_m, odometry_m = np.linalg.norm(np.diff(p, axis=0), axis=2).sum(axis=0)
    sigma = odometry_scale_sigma(track)
    if odometry_m < MIN_LENGTH_M or sigma is None:
        return None
    joint = float(np.hypot(sigma, SCALE_SIGMA))
    return Difference("scale", "%", 100.0 * float(adjusted_m / odometry_m - 1.0), 100.0 * joint)


def odometry_scale_sigma(track: Sequence[AdjustmentKeyframe]) -> float | None:
    """Return the standard deviation of the scale of an odometry; None if it stays near its first keyframe.

    The error of a position along the direction from the first keyframe contains that of the scale, times the distance.
    Its smallest ratio to the distance is an upper bound.

    Args:
        track: Keyframes of the same odometry frame.
    """
    first = track[0].estimate.T_odom_imu[:3, 3]
    bounds = []
    for keyframe in track[1:]:
        T, P = keyframe.estimate.T_odom_imu, keyframe.estimate.covariance[3:, 3:]
        distance_m = float(np.linalg.norm(T[:3, 3] - first))
        if distance_m >= MIN_DISTANCE_M:
            radial = T[:3, :3].T @ (T[:3, 3] - first) / distance_m
            bounds.append(float(np.sqrt(radial @ P @ radial)) / distance_m)
    return min(bounds, default=None)


def _tilt(newest: AdjustmentKeyframe, adjusted: AdjustedMap) -> Difference:
    """Return the angle between the verticals at the newest keyframe."""
    up, odometry = adjusted.poses[newest.number][2, :3], newest.estimate.T_odom_imu[2, :3]
    angle_deg = float(np.degrees(np.arccos(np.clip(up @ odometry, -1.0, 1.0))))
    variance = float(np.trace(newest.estimate.covariance[:3, :3]))
    return Difference("inclination", "°", angle_deg, float(np.hypot(np.degrees(np.sqrt(variance)), TILT_SIGMA_DEG)))


def _biases(newest: AdjustmentKeyframe, adjusted: AdjustedMap) -> list[Difference]:
    """Return the differences of the biases at the newest keyframe."""
    sigma = np.sqrt(np.diag(newest.bias_covariance))
    quantities = (
        (
            "gyroscope bias",
            "rad/s",
            adjusted.gyro_bias_rad_s - newest.gyro_bias_rad_s,
            sigma[:3],
            GYRO_BIAS_SIGMA_RAD_S,
        ),
        (
            "accelerometer bias",
            "m/s²",
            adjusted.accel_bias_m_s2 - newest.accel_bias_m_s2,
            sigma[3:],
            ACCEL_BIAS_SIGMA_M_S2,
        ),
    )
    biases = []
    for name, unit, difference, own, least in quantities:
        joint = np.hypot(own, least)
        worst = int(np.argmax(np.abs(difference) / joint))
        biases.append(Difference(name, unit, float(difference[worst]), float(joint[worst])))
    return biases


def _positions(inputs: AdjustmentInputs, adjusted: AdjustedMap) -> Difference | None:
    """Return by how much the loops with a loaded map contradict it, as RMS; None without any."""
    known = () if inputs.saved is None else inputs.saved.graph.poses
    loops = [loop for loop in inputs.loops if loop.first in known]
    if not loops:
        return None
    rms = float(np.sqrt(np.mean([_normalized(loop, adjusted) for loop in loops])))
    return Difference("pose", "σ", rms, 1.0, "the loops with the loaded map")


def _normalized(loop: RelativePose, adjusted: AdjustedMap) -> float:
    """Return the squared error of a loop in an adjusted map, a sixth of χ²."""
    T = inverse_pose(adjusted.poses[loop.first]) @ adjusted.poses[loop.second]
    error = inverse_pose(loop.T_first_second) @ T
    residual = np.concatenate([log_so3(error[:3, :3]), error[:3, 3]])
    return float(residual @ np.linalg.solve(loop.covariance, residual)) / len(residual)
