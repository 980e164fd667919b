"""Structure from motion: bundle adjustment of five photographs of Villa Balbianello.

The initial reconstruction is that of Bundler (Snavely, Seitz, Szeliski 2006). Each observation of a point in a
photograph is a factor on that point and on the pose, focal length and distortion of that camera. The first camera and
the distance of the first point are fixed, because photographs determine neither position, orientation nor scale.

Source: Dellaert and Hutchinson, *Introduction to Robotics*, section 7.4.2. The data come with the gtsam package.
"""

from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import P

Array = npt.NDArray[np.float64]

PIXEL_SIGMA = 1.0
"""Standard deviation of an observation [px]."""


@dataclass(frozen=True, eq=False)
class SfmExperiment:
    """Bundle adjustment of C cameras and N points, in units of unknown scale."""

    Ts_world_cam: Array
    """(C, 4, 4) Poses of the cameras; x right, y down, z forward."""
    focal_px: Array
    """(C,) Focal lengths [px]."""
    photographs: tuple[Path, ...]
    """Image files of the C cameras."""
    points: Array
    """(N, 3) Points in the world frame."""
    colours: npt.NDArray[np.uint8]
    """(N, 3) Colours of the points: red, green, blue."""
    views: npt.NDArray[np.int64]
    """(N,) Number of photographs that observe each point."""
    observed_px: Array
    """(M, 2) Observations, measured from the centre of the photograph, x right and y down [px]."""
    reprojected_px: Array
    """(M, 2) Reprojections of the solution, measured in the same way [px]."""
    observation_camera: npt.NDArray[np.int64]
    """(M,) Camera of each observation."""
    observation_point: npt.NDArray[np.int64]
    """(M,) Point of each observation."""
    initial_error: float
    """Error of the graph at the initial reconstruction: half the sum of the squared, whitened residuals."""
    final_error: float
    """Error of the graph at the solution."""
    iterations: int
    """Number of iterations of the optimizer."""

    @property
    def reprojection_rms_px(self) -> float:
        """Root mean square distance between observed and reprojected points [px]."""
        squares = np.sum((self.observed_px - self.reprojected_px) ** 2, axis=1)
        return float(np.sqrt(squares.mean()))


def run_sfm_experiment() -> SfmExperiment:
    """Run the bundle adjustment of Villa Balbianello.

    Returns:
        The adjusted reconstruction, with its errors before and after.
    """
    data = gtsam.SfmData.FromBundlerFile(gtsam.findExampleDataFile("Balbianello.out"))
    graph = data.sfmFactorGraph(gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA))
    initial = gtsam.initialCamerasAndPointsEstimate(data)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial)
    result = optimizer.optimize()

    cameras = [result.atPinholeCameraCal3Bundler(i) for i in range(data.numberCameras())]
    tracks = [data.track(j) for j in range(data.numberTracks())]
    points = np.stack([result.atPoint3(P(j)) for j in range(len(tracks))])
    camera_index = np.concatenate([track.indexVector() for track in tracks]).astype(np.int64)
    views = np.array([track.numberMeasurements() for track in tracks])
    point_index = np.repeat(np.arange(len(tracks)), views)
    return SfmExperiment(
        Ts_world_cam=np.stack([camera.pose().matrix() for camera in cameras]),
        focal_px=np.array([camera.calibration().fx() for camera in cameras]),
        photographs=tuple(_photograph(i) for i in range(len(cameras))),
        points=points,
        colours=np.round(255.0 * np.array([[t.r, t.g, t.b] for t in tracks])).astype(np.uint8),
        views=views,
        observed_px=np.concatenate([track.measurementMatrix() for track in tracks]),
        reprojected_px=np.stack(
            [cameras[i].project(points[j]) for i, j in zip(camera_index, point_index, strict=True)]
        ),
        observation_camera=camera_index,
        observation_point=point_index,
        initial_error=graph.error(initial),
        final_error=graph.error(result),
        iterations=optimizer.iterations(),
    )


def _photograph(camera: int) -> Path:
    return Path(gtsam.findExampleDataFile(f"Balbianello/BalbianelloMedium-{camera + 1}.jpg"))
