"""Settings of structure from motion; this module imports none of the libraries that it uses."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class FeatureConfig(Settings):
    """Detection of features."""

    max_features: Annotated[int, Range(50, 50_000)] = 2000
    """Largest number of features of an image; of the largest ones, those of highest contrast are kept."""
    contrast_threshold: Annotated[float, Range(above=0.0, high=1.0)] = 0.02
    """Smallest contrast of a keypoint, in the scale of OpenCV."""
    max_side_px: Annotated[int, Range(100, 100_000)] = 3200
    """Longer side to which an image is reduced before the detection [px]; one of 50 megapixels would take 10 GB."""


@dataclass(frozen=True)
class PairConfig(Settings):
    """Pairs of images that are matched."""

    method: Literal["automatic", "exhaustive", "sequential", "retrieval"] = "automatic"
    """All pairs, neighbours in the sequence and similar images, or similar images alone; ``automatic`` matches all
    pairs of at most `max_exhaustive` images, and otherwise decides by whether the images are a sequence."""
    max_exhaustive: Annotated[int, Range(0, 10_000)] = 40
    """Largest number of images of which ``automatic`` matches all pairs."""
    overlap: Annotated[int, Range(1, 1000)] = 10
    """Number of next images in a sequence to which an image is matched."""
    similar: Annotated[int, Range(0, 1000)] = 10
    """Number of similar images to which an image is matched, besides its neighbours in the sequence."""


@dataclass(frozen=True)
class MatchingConfig(Settings):
    """Matching of features."""

    ratio: Annotated[float, Range(above=0.0, high=1.0)] = 0.8
    """Largest ratio of the distance to the nearest descriptor and to the second nearest."""
    max_angle_rad: Annotated[float, Range(above=0.0, high=3.2)] = 0.7
    """Largest angle between the descriptors of a match [rad]."""


@dataclass(frozen=True)
class VerificationConfig(Settings):
    """Geometric verification of matches."""

    max_error_px: Annotated[float, Range(above=0.0, high=100.0)] = 3.0
    """Largest distance of an inlier from its epipolar line [px]."""
    min_inliers: Annotated[int, Range(5, 100_000)] = 15
    """Smallest number of inliers of a verified pair."""
    max_iterations: Annotated[int, Range(10, 1_000_000)] = 5000
    """Largest number of hypotheses of RANSAC."""


@dataclass(frozen=True)
class TriangulationConfig(Settings):
    """Triangulation of tracks."""

    max_error_px: Annotated[float, Range(above=0.0, high=100.0)] = 4.0
    """Largest reprojection error of an inlier [px]."""
    min_angle_deg: Annotated[float, Range(above=0.0, high=90.0)] = 1.5
    """Smallest angle between two rays of a point [deg]."""


@dataclass(frozen=True)
class ResectionConfig(Settings):
    """Registration of images."""

    max_error_px: Annotated[float, Range(above=0.0, high=100.0)] = 6.0
    """Largest reprojection error of an inlier [px]."""
    min_inliers: Annotated[int, Range(4, 100_000)] = 15
    """Smallest number of inliers of a registered image."""
    max_iterations: Annotated[int, Range(10, 1_000_000)] = 5000
    """Largest number of hypotheses of RANSAC."""


@dataclass(frozen=True)
class CompletionConfig(Settings):
    """Longer tracks of a finished reconstruction."""

    merge: bool = True
    """Whether tracks of the same point are merged."""
    guided: bool = True
    """Whether features near the projections of points are added to their tracks."""
    merge_error_px: Annotated[float, Range(above=0.0, high=100.0)] = 2.0
    """Largest reprojection error of the observations of merged tracks [px]."""
    merge_angle_rad: Annotated[float, Range(above=0.0, high=3.2)] = 0.5
    """Largest angle between the mean descriptors of merged tracks [rad]."""
    guided_error_px: Annotated[float, Range(above=0.0, high=100.0)] = 1.0
    """Largest distance between an added feature and the projection of its point [px]."""
    guided_angle_rad: Annotated[float, Range(above=0.0, high=3.2)] = 0.35
    """Largest angle between the descriptor of an added feature and the mean descriptor of its track [rad]."""


@dataclass(frozen=True)
class MapperConfig(Settings):
    """Incremental mapping."""

    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)
    """Triangulation of tracks."""
    resection: ResectionConfig = field(default_factory=ResectionConfig)
    """Registration of images."""
    max_iterations: Annotated[int, Range(1, 1000)] = 50
    """Largest number of iterations of the last adjustment."""
    final_cauchy_sigmas: Annotated[float, Range(0.01, 1e3)] = 1.0
    """Scale of the Cauchy loss of the last adjustment, relative to the noise of the observations."""


@dataclass(frozen=True)
class InertialConfig(Settings):
    """Gravity and scale from the IMU of a recording."""

    use: Literal["automatic", "required", "off"] = "automatic"
    """``automatic`` uses the IMU if the motion suffices, ``required`` fails if it does not, ``off`` ignores the IMU."""
    max_scale_sigma: Annotated[float, Range(above=0.0)] = 0.03
    """Largest standard deviation of the scale, relative to the scale, at which the result is in metres."""
    max_tilt_sigma_deg: Annotated[float, Range(above=0.0)] = 1.0
    """Largest standard deviation of the direction of gravity at which the z axis of the result points up [deg]."""
    noise_inflation: Annotated[float, Range(0.01, 1e3)] = 5.0
    """Factor on the white noise of the accelerometer, which also senses the vibration of the airframe."""
    accel_bias_m_s2: Annotated[float, Range(1e-6, 100.0)] = 0.1
    """Standard deviation of the accelerometer bias [m/s²]."""


@dataclass(frozen=True)
class GpsConfig(Settings):
    """World frame from the positions of photographs (GPS) and of ground control points."""

    use: Literal["automatic", "required", "off"] = "automatic"
    """``automatic`` uses positions if they determine the world frame, ``required`` fails if they do not, ``off``
    ignores them."""
    max_scale_sigma: Annotated[float, Range(above=0.0)] = 0.1
    """Largest standard deviation of the scale, relative to the scale, at which the result is in metres."""
    max_rotation_sigma_deg: Annotated[float, Range(above=0.0)] = 10.0
    """Largest standard deviation of north and of the vertical at which the result is in east, north, up [deg]."""


@dataclass(frozen=True)
class SfmConfig(Settings):
    """Structure from motion."""

    features: FeatureConfig = field(default_factory=FeatureConfig)
    """Detection of features."""
    pairs: PairConfig = field(default_factory=PairConfig)
    """Pairs of images that are matched."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    """Matching of features."""
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    """Geometric verification of matches."""
    mapper: MapperConfig = field(default_factory=MapperConfig)
    """Incremental mapping of the images."""
    completion: CompletionConfig = field(default_factory=CompletionConfig)
    """Longer tracks of a finished reconstruction."""
    inertial: InertialConfig = field(default_factory=InertialConfig)
    """Gravity and scale from the IMU of a recording."""
    gps: GpsConfig = field(default_factory=GpsConfig)
    """World frame from the positions of photographs (GPS) and of ground control points."""
    threads: Annotated[int, Range(1, 256)] = 2
    """Number of threads that detect and match features."""
