"""Settings of the online calibration."""

from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

from dronevio.estimator.calibration.window import AdjustmentConfig
from dronevio.models.ranges import Range, Settings

FiveSigmas: TypeAlias = tuple[float, float, float, float, float]


@dataclass(frozen=True)
class CalibratedPart(Settings):
    """Settings of one part of the calibration, in the unit of its parameters."""

    online: bool
    """Whether this part is estimated online."""
    sigma: Annotated[float, Range(1e-6, 10.0)]
    """Prior standard deviation of the given calibration."""
    min_correction: Annotated[float, Range(low=0.0)]
    """Smallest correction that is applied: the length of the vector of its parameters. That of the rotations of several
    cameras is the root mean square over the cameras."""
    walk: Annotated[float, Range(0.0, 1.0)]
    """Random walk of the parameters, due to temperature and ageing, per √s."""
    significance: Annotated[float, Range(low=0.0)] = 3.0
    """Standard deviations by which an estimate must differ from the calibration in use before it is applied."""
    refinement: Annotated[float, Range(0.0, 1.0)] = 1.0
    """Smallest further correction once this part has been corrected, relative to `min_correction`."""


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """Settings of the online calibration."""

    time_offset: CalibratedPart = CalibratedPart(True, sigma=0.01, min_correction=0.001, walk=1e-5, refinement=0.3)
    """Time offset of the cameras [s]. The smallest correction is a fifth of a sampling interval of a 200 Hz IMU."""
    gravity: CalibratedPart = CalibratedPart(True, sigma=0.03, min_correction=0.01, walk=0.0, significance=1.5)
    """Magnitude of gravity [m/s²], 9.780 at the equator and 9.832 at the poles. One camera observes it only where the
    thrust varies, because scale and gravity are proportional otherwise. The significance is small, because the prior is
    the true distribution on Earth."""
    rotation: CalibratedPart = CalibratedPart(True, sigma=0.02, min_correction=0.005, walk=1e-5, refinement=0.1)
    """Rotation of each camera, about each axis [rad]. The smallest correction is a quarter of a degree."""
    translation: CalibratedPart = CalibratedPart(False, sigma=0.02, min_correction=0.005, walk=1e-6)
    """Translation of each camera in the IMU frame [m]."""
    focal: CalibratedPart = CalibratedPart(True, sigma=0.02, min_correction=0.005, walk=1e-6, refinement=0.1)
    """Focal length of each camera, relative."""
    principal: CalibratedPart = CalibratedPart(True, sigma=0.01, min_correction=0.005, walk=1e-6, refinement=0.1)
    """Principal point of each camera, in units of the focal lengths."""
    radial: CalibratedPart = CalibratedPart(True, sigma=0.01, min_correction=0.005, walk=1e-6, refinement=0.1)
    """First radial coefficient of the distortion of each camera."""
    gyro_scale_sigma: Annotated[float, Range(0.0, 0.1)] = 0.003
    """Standard deviation of the gyroscope's scale, relative. It is an unknown of the adjustments that is not corrected:
    where a camera turns, a wrong scale looks like a wrong focal length."""
    min_motion_correction: Annotated[float, Range(low=0.0)] = 0.01
    """Smallest first correction of the rotations by windows that begin in motion [rad], as the root mean square over
    the cameras. Smaller rotations have systematic causes there, which many windows share."""
    position_sigma_m: Annotated[float, Range(0.0, 1.0)] = 0.0005
    """Standard deviation of the positions of several cameras where `translation` is not estimated [m]. They are
    unknowns of the adjustment that are not corrected: errors that stereo matches have in common look like another
    direction of the baseline, and with known positions like a rotation of all cameras."""
    window_s: Annotated[float, Range(0.5, 60.0)] = 5.0
    """Length of the windows [s]. A window does not begin while the vehicle is stationary, but with the last stationary
    keyframe."""
    first_window_s: Annotated[float, Range(0.1, 60.0)] = 0.8
    """Length of the part of a window that is adjusted first if the vehicle is stationary at its beginning [s]. Longer
    parts follow until the window is complete."""
    max_keyframes: Annotated[int, Range(3, 100)] = 30
    """Largest number of keyframes in a window; a window that reaches it ends early."""
    min_keyframes: Annotated[int, Range(3, 100)] = 8
    """Smallest number of keyframes of a window that is adjusted."""
    min_landmarks: Annotated[int, Range(5, 1000)] = 20
    """Smallest number of landmarks of a window that is adjusted."""
    max_correction_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 5.0
    """Largest plausible correction of a parameter, in standard deviations of its prior: 5.7° of a rotation. The sum of
    the squares of all may be as many of its standard deviations above its mean. After larger corrections, which show
    that images and calibration do not belong together, the health is not tracking again."""
    inflation_sigmas: Annotated[FiveSigmas, Range(0.0, 10.0)] = (0.01, 0.02, 0.1, 0.005, 0.15)
    """Standard deviations of the error that a wrong calibration leaves in the state when it is corrected: orientation
    [rad], position [m], velocity [m/s], gyroscope bias [rad/s] and accelerometer bias [m/s²]. They correspond to a
    rotation of one degree or a time offset of 5 ms, and are proportional to smaller corrections."""
    gravity_inflation_sigmas: Annotated[FiveSigmas, Range(0.0, 10.0)] = (0.001, 0.002, 0.01, 0.0, 0.03)
    """Those that wrong gravity leaves. The accelerometer bias compensates most of it."""
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    """Settings of the adjustment of the windows."""
