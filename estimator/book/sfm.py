"""Structure from motion: bundle adjustment of five photographs of Villa Balbianello.

The reconstruction that comes with the gtsam package is Bundler's (Snavely, Seitz, Szeliski 2006), and optimal up to
details: its error is 126.9, that of the optimum 125.5. So that there is something to see, cameras and points are
perturbed before the adjustment. Each observation of a point in a photograph is a factor on that point and on the pose,
focal length and distortion of that camera. The first camera and the first point are fixed by priors and not perturbed,
because photographs determine neither position, orientation nor scale.

Source: Dellaert and Hutchinson, *Introduction to Robotics*, section 7.4.2.
"""

from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import P

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError

Indices = npt.NDArray[np.int64]

PIXEL_SIGMA = 1.0
"""Standard deviation of an observation [px]."""
ORIENTATION_SIGMA_RAD = 0.02
"""Standard deviation of the perturbation of each axis of an orientation [rad]."""
POSITION_SIGMA = 0.05
"""Standard deviation of the perturbation of each coordinate of a camera or a point, in units of the reconstruction: the
distance of the first camera from the last is 1.2, that from the villa 1.5."""
FOCAL_SIGMA = 0.02
"""Standard deviation of the perturbation of a focal length, relative to it."""


@dataclass(frozen=True, eq=False)
class SfmExperiment:
    """Bundle adjustment of C cameras and N points, in units of unknown scale."""

    Ts_world_cam: Array
    """(C, 4, 4) Poses of the cameras; x right, y down, z forward."""
    Ts_world_cam_initial: Array
    """(C, 4, 4) Poses of the cameras before the adjustment."""
    focal_px: Array
    """(C,) Focal lengths [px]."""
    photographs: tuple[Path, ...]
    """Image files of the C cameras."""
    points: Array
    """(N, 3) Points in the world frame."""
    points_initial: Array
    """(N, 3) Points before the adjustment."""
    points_bundler: Array
    """(N, 3) Points of Bundler's reconstruction."""
    colours: npt.NDArray[np.uint8]
    """(N, 3) Colours of the points: red, green, blue."""
    views: npt.NDArray[np.int64]
    """(N,) Number of photographs that observe each point."""
    observed_px: Array
    """(M, 2) Observations, measured from the centre of the photograph, x right and y down [px]."""
    reprojected_px: Array
    """(M, 2) Reprojections of the solution, measured in the same way [px]."""
    initially_reprojected_px: Array
    """(M, 2) Reprojections before the adjustment; NaN where a point was behind the camera [px]."""
    observation_camera: npt.NDArray[np.int64]
    """(M,) Camera of each observation."""
    observation_point: npt.NDArray[np.int64]
    """(M,) Point of each observation."""
    bundler_error: float
    """Error of the graph at Bundler's reconstruction: half the sum of the squared, whitened residuals."""
    initial_error: float
    """Error of the graph at the perturbed reconstruction, from which the adjustment starts."""
    final_error: float
    """Error of the graph at the solution."""
    iterations: int
    """Number of iterations of the optimizer."""

    @property
    def reprojection_rms_px(self) -> float:
        """Root mean square distance between observed and reprojected points [px]."""
        return _rms(self.observed_px - self.reprojected_px)

    @property
    def initial_reprojection_rms_px(self) -> float:
        """The same before the adjustment, over the points in front of their cameras [px]."""
        return _rms(self.observed_px - self.initially_reprojected_px)

    @property
    def initial_distance(self) -> float:
        """Median distance of the points from Bundler's before the adjustment, in units of unknown scale."""
        return _median_length(self.points_initial - self.points_bundler)

    @property
    def final_distance(self) -> float:
        """Median distance of the adjusted points from Bundler's, in units of unknown scale."""
        return _median_length(self.points - self.points_bundler)


def photograph_folder() -> Path:
    """Return the folder of the five photographs, which come with the gtsam package."""
    return Path(gtsam.findExampleDataFile("Balbianello/BalbianelloMedium-1.jpg")).parent


def run_sfm_experiment(rng: np.random.Generator, perturbation: float = 1.0) -> SfmExperiment:
    """Perturb the reconstruction of Villa Balbianello, and run the bundle adjustment.

    Args:
        rng: Random generator of the perturbations.
        perturbation: Factor on the standard deviations of the perturbations. With 0 the adjustment starts from
            Bundler's reconstruction, as in the chapter.

    Returns:
        The adjusted reconstruction, with that before.

    Raises:
        ConfigError: The factor is negative.
    """
    if not perturbation >= 0.0:
        raise ConfigError(f"perturbation {perturbation}; expected a number of 0 or more")
    data = gtsam.SfmData.FromBundlerFile(gtsam.findExampleDataFile("Balbianello.out"))
    graph = data.sfmFactorGraph(gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA))
    bundler = gtsam.initialCamerasAndPointsEstimate(data)
    initial = _perturbed(bundler, data.numberCameras(), data.numberTracks(), perturbation, rng)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial)
    result = optimizer.optimize()

    tracks = [data.track(j) for j in range(data.numberTracks())]
    camera_index = np.concatenate([track.indexVector() for track in tracks]).astype(np.int64)
    views = np.array([track.numberMeasurements() for track in tracks])
    point_index = np.repeat(np.arange(len(tracks)), views)
    cameras = _cameras(result, data.numberCameras())
    return SfmExperiment(
        Ts_world_cam=np.stack([camera.pose().matrix() for camera in cameras]),
        Ts_world_cam_initial=np.stack([camera.pose().matrix() for camera in _cameras(initial, len(cameras))]),
        focal_px=np.array([camera.calibration().fx() for camera in cameras]),
        photographs=tuple(_photograph(i) for i in range(len(cameras))),
        points=_points(result, len(tracks)),
        points_initial=_points(initial, len(tracks)),
        points_bundler=_points(bundler, len(tracks)),
        colours=np.round(255.0 * np.array([[t.r, t.g, t.b] for t in tracks])).astype(np.uint8),
        views=views,
        observed_px=np.concatenate([track.measurementMatrix() for track in tracks]),
        reprojected_px=_reprojected(result, camera_index, point_index),
        initially_reprojected_px=_reprojected(initial, camera_index, point_index),
        observation_camera=camera_index,
        observation_point=point_index,
        bundler_error=graph.error(bundler),
        initial_error=graph.error(initial),
        final_error=graph.error(result),
        iterations=optimizer.iterations(),
    )


def _perturbed(
    values: gtsam.Values, cameras: int, points: int, factor: float, rng: np.random.Generator
) -> gtsam.Values:
    """Return all values with Gaussian errors, except for the first camera and the first point."""
    perturbed = gtsam.Values()
    sigmas = factor * np.repeat([ORIENTATION_SIGMA_RAD, POSITION_SIGMA], 3)
    for i, camera in enumerate(_cameras(values, cameras)):
        errors, focal = (i > 0) * sigmas * rng.standard_normal(6), camera.calibration()
        fx = focal.fx() * (1.0 + (i > 0) * factor * FOCAL_SIGMA * rng.standard_normal())
        calibration = gtsam.Cal3Bundler(fx, focal.k1(), focal.k2(), focal.px(), focal.py())
        perturbed.insert(i, gtsam.PinholeCameraCal3Bundler(camera.pose().retract(errors), calibration))
    errors = factor * POSITION_SIGMA * rng.standard_normal((points, 3))
    errors[0] = 0.0
    for j, point in enumerate(_points(values, points) + errors):
        perturbed.insert(P(j), point)
    return perturbed


def _cameras(values: gtsam.Values, count: int) -> list[gtsam.PinholeCameraCal3Bundler]:
    return [values.atPinholeCameraCal3Bundler(i) for i in range(count)]


def _points(values: gtsam.Values, count: int) -> Array:
    """Return the points (N, 3)."""
    return np.stack([values.atPoint3(P(j)) for j in range(count)])


def _reprojected(values: gtsam.Values, cameras: Indices, points: Indices) -> Array:
    """Return the projection (M, 2) of a point into a camera for each observation; NaN behind the camera [px]."""
    projected = np.full((len(cameras), 2), np.nan)
    for row, (i, j) in enumerate(zip(cameras.tolist(), points.tolist(), strict=True)):
        pixel, valid = values.atPinholeCameraCal3Bundler(i).projectSafe(values.atPoint3(P(j)))
        if valid:
            projected[row] = pixel
    return projected


def _rms(differences: Array) -> float:
    """Return the root mean square length of differences (M, D), without those that are NaN."""
    return float(np.sqrt(np.nanmean(np.sum(differences**2, axis=1))))


def _median_length(differences: Array) -> float:
    return float(np.median(np.linalg.norm(differences, axis=1)))


def _photograph(camera: int) -> Path:
    return photograph_folder() / f"BalbianelloMedium-{camera + 1}.jpg"
