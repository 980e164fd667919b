"""Settings of the health monitor."""

from dataclasses import dataclass
from typing import Annotated

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class HealthConfig(Settings):
    """Settings of the health monitor."""

    min_landmarks: Annotated[int, Range(1, 1000)] = 8
    """Smallest number of landmarks that constrain an estimate; with fewer, a single outlier dominates."""
    settling_s: Annotated[float, Range(0.0, 60.0)] = 0.42
    """Time for which tracked features suffice instead of landmarks [s], as at the end of a stationary interval. Three
    keyframes with parallax are needed to triangulate landmarks."""
    max_innovation_px: Annotated[float, Range(above=0.0, infinite=True)] = 12.0
    """Median innovation beyond which the landmarks contradict the estimate [px]. A time offset of 5 ms at 300 °/s
    causes it with the lens of EuRoC."""
    max_contradiction_s: Annotated[float, Range(low=0.0, infinite=True)] = 1.0
    """Time for which landmarks may contradict the estimate before it is lost [s]. Jolts and large passing objects take
    less."""
    consistency_window_s: Annotated[float, Range(0.05, 60.0)] = 0.6
    """Length of the window over which the median NIS of the innovations is taken [s]. A jolt or a passing object
    disturbs fewer frames."""
    max_consistent_nis: Annotated[float, Range(above=0.0, infinite=True)] = 12.0
    """Largest such median, in units of its expectation, at which the estimate counts as consistent. On rendered
    flights it reaches 10, on real images 4."""
    min_innovation_px: Annotated[float, Range(low=0.0)] = 0.3
    """Median innovation of a frame up to which it counts as consistent, whatever its NIS [px]. Motion blur and the
    errors of landmarks exceed the assumed noise in fast flight."""
    max_frame_nis: Annotated[float, Range(above=0.0, infinite=True)] = 45.0
    """Largest NIS of a frame at which the estimate counts as consistent."""
    recovery_s: Annotated[float, Range(low=0.0, infinite=True)] = 10.0
    """Time without inconsistent innovations after which the health of an estimate is tracking again [s]."""
    established_s: Annotated[float, Range(low=0.0, infinite=True)] = 10.0
    """Time of consistent motion after which an estimate is established [s]: what contradicts it later is more probably
    a disturbance than a wrong calibration."""
    established_nis_ratio: Annotated[float, Range(1.0, 100.0)] = 2.0
    """Ratio by which the largest NIS of an established estimate may be larger, in a frame and in the median."""
    disturbance_s: Annotated[float, Range(low=0.0, infinite=True)] = 0.6
    """Longest contradiction of an established estimate that counts as a disturbance, and the time for which the
    estimate must be consistent after it before its health is tracking [s]."""
    max_change_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 5.0
    """Largest change of the position by a correction of the calibration, in standard deviations of the published
    position, at which the estimate counts as consistent."""
    disconnected_s: Annotated[float, Range(low=0.0, infinite=True)] = 5.0
    """Time after a keyframe without a common feature with the one before, in which inconsistent innovations mean a loss
    [s]: the images show another place, as when they are exchanged or the vehicle is carried away."""
    max_bias_change_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 3.0
    """Largest change of the accelerometer bias in that time, in standard deviations before it, to which
    `max_accel_bias_change_m_s2` is added. A larger one hides that the direction of gravity is another one."""
    max_accel_bias_change_m_s2: Annotated[float, Range(above=0.0, infinite=True)] = 0.1
    """Largest change of an accelerometer bias that is known exactly [m/s²]; 0.1 m/s² are 0.6° of inclination."""
    max_nis: Annotated[float, Range(above=0.0, infinite=True)] = 60.0
    """Median NIS over the window beyond which the estimate is lost."""
    image_variance_bounds: Annotated[tuple[float, float], Range(1e-6, 1e6)] = (0.1, 10.0)
    """Bounds of the variance of image observations, relative to that of the smoother, in the covariance of innovations.
    It is the median over the last keyframes."""
    max_noise_ratio: Annotated[float, Range(above=0.0, infinite=True)] = 3.0
    """Largest ratio of the IMU's noise densities, as estimated in flight, to those of the data sheet in the covariance
    of innovations. A wrong calibration increases the estimates without bound. What the samples themselves show, at rest
    or by their spectrum, counts in full."""
    max_inertial_sigma_m: Annotated[float, Range(above=0.0, infinite=True)] = 1.0
    """Largest increase of the position's standard deviation while the IMU alone propagates the estimate [m]. The IMU of
    EuRoC reaches it in some 10 s."""
    max_speed_m_s: Annotated[float, Range(above=0.0, infinite=True)] = 60.0
    """Largest plausible speed [m/s], beyond that of racing drones."""
    gyro_bias_sigma_rad_s: Annotated[float, Range(1e-6, 10.0)] = 0.05
    """Lower bound of the standard deviation of the gyroscope bias [rad/s]. The bias of EuRoC is 0.08, where the data
    sheet states 0.01."""
    accel_bias_sigma_m_s2: Annotated[float, Range(1e-6, 100.0)] = 0.2
    """Lower bound of the standard deviation of the accelerometer bias [m/s²]. The bias of EuRoC reaches 0.5."""
    max_first_bias_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 2.5
    """Largest bias by an initialization in motion, in these standard deviations, at which its estimate counts as
    consistent from the beginning. A bias of the gyroscope explains wrong rotations for some tenths of a second."""
