"""The time offset of camera and IMU from the rotation of the images against the gyroscope, without a prior.

The rotation between two frames, which the images show without the gyroscope (`image_rotations`), equals the gyroscope's
integral between the two exposures. Where the clocks differ, it equals the integral over an interval that is shifted by
the offset (Mair et al., "Spatio-temporal initialization for IMU to camera registration", ROBIO 2011; Furgale et al.,
"Unified temporal and spatial calibration for multi-sensor systems", IROS 2013). All offsets of a range are tried, with
the gyroscope bias that suits each, by the sum of the residuals' absolute values, which tolerates wrong rotations. The
best one is refined by least squares. It means something only where the gyroscope explains most of the rotation there,
and clearly more than anywhere else.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.calibration.image_rotation import RelativeRotations
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.rotation import exp_so3, integrated_rotations, log_so3

GRID_S = 0.004
"""Step of the offsets that are tried [s]; vehicles do not turn back and forth within some of them."""
MIN_PAIRS = 10
"""Smallest number of relative rotations that an offset is estimated from."""
MIN_EXPLAINED = 0.7
"""Smallest share of the images' rotation that the gyroscope explains at a significant offset. Over 1.5 s, it is 0.94 or
more on the ten seconds of MH_01 with real images, and 0.48 or less with the IMU of three other flights."""
MAX_AMBIGUITY = 0.75
"""Largest ratio of the remainder at a significant offset to that at the best offset which is not near it."""
MAX_SIGMA_S = 0.002
"""Largest standard deviation of a significant offset [s]."""
MIN_GAIN = 2.0
"""Smallest gain at which an offset is one, and not the error of few rotations in front of little texture. An offset of
10 ms on MH_01 gains 2.6 or more; in a room with 15 to 20 features, one of 11 ms that does not exist gained 1.4."""
ITERATIONS = 10
"""Number of Gauss-Newton steps of the refinement."""


@dataclass(frozen=True)
class RotationOffset:
    """A time offset of camera and IMU, and what shows whether it is significant."""

    offset_s: float
    """Time offset, t_imu = t_cam + offset [s]."""
    sigma_s: float
    """Its standard deviation, by the residuals [s]."""
    explained: float
    """Share of the images' rotation about its mean that the gyroscope explains at this offset: 1 is all of it, 0 no
    more than a constant rate does; negative where it is worse."""
    ambiguity: float
    """Ratio of the remainder at the best offset to the least beyond its valley, or at its rim, both on the grid of
    offsets: 1 if both are equally good."""
    gain: float
    """Ratio of the remainder without an offset to that at this one."""
    is_inside: bool
    """Whether the best offset is inside the range, not at an end of it."""

    @property
    def is_significant(self) -> bool:
        """Whether the gyroscope explains the rotation at this offset, and only there."""
        return (
            self.is_inside
            and self.explained >= MIN_EXPLAINED
            and self.ambiguity <= MAX_AMBIGUITY
            and self.sigma_s <= MAX_SIGMA_S
        )

    @property
    def excludes_zero(self) -> bool:
        """Whether the offset is significant, and the rotation contradicts clocks without an offset."""
        return self.is_significant and self.gain >= MIN_GAIN


def rotation_offset(measured: RelativeRotations, imu: ImuSamples, max_offset_s: float) -> RotationOffset | None:
    """Return the time offset at which the gyroscope agrees best with the rotation of images.

    Args:
        measured: Relative rotations by the images alone; their times are those of the camera's clock.
        imu: Samples of the IMU, by its own clock. Pairs of frames for which samples are missing at any of the offsets
            are left out.
        max_offset_s: The offsets from minus to plus this one are tried [s].

    Returns:
        The best offset, significant or not; None if there are too few rotations, or none at all that differ.
    """
    gyro = _Gyroscope.of(imu)
    margin_ns = round((max_offset_s + GRID_S) * 1e9)
    usable = (measured.start_ns - margin_ns >= gyro.t_ns[0]) & (measured.end_ns + margin_ns <= gyro.t_ns[-1])
    usable &= np.isfinite(measured.sigma_rad)
    if usable.sum() < MIN_PAIRS:
        return None
    pairs = measured[usable]
    steps = int(np.ceil(max_offset_s / GRID_S))
    offsets_s: Array = GRID_S * np.arange(-steps, steps + 1, dtype=np.float64)
    differences = pairs.rotation_rad - gyro.rotations(pairs, offsets_s)  # (D, P, 3)
    costs = _absolute_sum(differences, pairs)
    constant = float(_absolute_sum(pairs.rotation_rad[None], pairs)[0])
    if constant == 0.0:
        return None
    best = int(costs.argmin())
    left, right = _valley(costs, best)
    runner_up = float(np.r_[costs[: left + 1], costs[right:]].min())
    inside = 0 < best < len(costs) - 1
    offset_s, sigma_s = _refined(pairs, gyro, float(offsets_s[best]))
    cost = float(_absolute_sum(pairs.rotation_rad - gyro.rotations(pairs, np.array([offset_s])), pairs)[0])
    if abs(offset_s - offsets_s[best]) > 2.0 * GRID_S:
        offset_s, cost, sigma_s = float(offsets_s[best]), float(costs[best]), np.inf
    least = min(cost, float(costs[best]))
    explained, ambiguity = 1.0 - least / constant, float(costs[best]) / max(runner_up, 1e-12)
    gain = float(costs[steps]) / max(least, 1e-12)
    return RotationOffset(offset_s, sigma_s, explained, ambiguity, gain, inside)


@dataclass(frozen=True, eq=False)
class _Gyroscope:
    """The orientation of the IMU by the gyroscope without bias."""

    t_ns: Times  # (N,)
    R: Array  # (N, 3, 3) R_first_t at these times
    rate_rad_s: Array  # (N, 3) mean rates over the intervals that begin at these times

    @classmethod
    def of(cls, imu: ImuSamples) -> "_Gyroscope":
        means = imu.increments()
        start_ns = imu.t_ns[:1] if imu.sampling == "point" else imu.t_ns[:1] - 1
        rates = means.gyro_rad_s
        t_ns = np.concatenate([start_ns, means.t_ns])
        R = integrated_rotations(rates * (np.diff(t_ns) * 1e-9)[:, None])
        return cls(t_ns, R, np.concatenate([rates, rates[-1:]]) if len(rates) else np.zeros((1, 3)))

    def orientations(self, t_ns: Times) -> Array:
        """Return R_first_t (…, 3, 3) at times (…) within the samples."""
        row = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, len(self.t_ns) - 1)
        part = self.rate_rad_s[row] * ((t_ns - self.t_ns[row]) * 1e-9)[..., None]
        return np.asarray(self.R[row] @ exp_so3(part))

    def rotations(self, pairs: RelativeRotations, offsets_s: Array) -> Array:
        """Return the rotation vectors (D, P, 3) between the frames of pairs at offsets (D,) [rad]."""
        shift_ns = np.rint(offsets_s * 1e9).astype(np.int64)[:, None]
        start, end = self.orientations(pairs.start_ns + shift_ns), self.orientations(pairs.end_ns + shift_ns)
        return log_so3(np.swapaxes(start, -1, -2) @ end)


def _absolute_sum(rotation_rad: Array, pairs: RelativeRotations) -> Array:
    """Return the sums (D,) of the lengths of residual rotations (D, P, 3), less the constant rate that suits each.

    The lengths are in standard deviations, and the constant rate is the median, an unknown gyroscope bias.
    """
    span_s = pairs.span_s[:, None]
    bias = np.median(rotation_rad / span_s, axis=1, keepdims=True)
    return np.asarray((np.linalg.norm(rotation_rad - bias * span_s, axis=-1) / pairs.sigma_rad).sum(axis=-1))


def _valley(costs: Array, best: int) -> tuple[int, int]:
    """Return the first and last index of the valley around the least of some costs: up to the tops on both sides."""
    left, right = best, best
    while left > 0 and costs[left - 1] >= costs[left]:
        left -= 1
    while right < len(costs) - 1 and costs[right + 1] >= costs[right]:
        right += 1
    return left, right


def _refined(pairs: RelativeRotations, gyro: _Gyroscope, offset_s: float) -> tuple[float, float]:
    """Return the offset and its standard deviation [s] by weighted least squares, with the bias as further unknown."""
    step_s = 0.5 * GRID_S
    J = np.empty((len(pairs), 3, 4))
    J[:, :, 1:] = pairs.span_s[:, None, None] * np.eye(3)
    x, sigma_s = np.array([offset_s, 0.0, 0.0, 0.0]), np.inf
    for _ in range(ITERATIONS):
        predicted = gyro.rotations(pairs, x[0] + np.array([-step_s, 0.0, step_s]))
        J[:, :, 0] = (predicted[2] - predicted[0]) / (2.0 * step_s)
        residual = pairs.rotation_rad - predicted[1] - pairs.span_s[:, None] * x[1:]
        squares = (residual**2).mean(axis=1) / pairs.sigma_rad**2
        scale = float(np.median(squares)) / 0.79  # the median of the mean of three squares of normal variables is 0.79
        weights = 1.0 / (1.0 + squares / max(4.0 * scale, 1e-12)) ** 2 / pairs.sigma_rad**2
        H = np.einsum("pij,p,pik->jk", J, weights, J)
        try:
            step = np.linalg.solve(H, np.einsum("pij,p,pi->j", J, weights, residual))
            sigma_s = float(np.sqrt(max(scale, 1e-12) * np.linalg.inv(H)[0, 0]))
        except np.linalg.LinAlgError:
            return offset_s, np.inf
        x[1:] += step[1:]
        x[0] += float(np.clip(step[0], -GRID_S, GRID_S))
        if abs(step[0]) < 1e-5:
            break
    return float(x[0]), sigma_s
