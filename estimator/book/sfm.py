"""Structure from motion: five photographs of Villa Balbianello, where they were taken from and what they show.

Bundler (Snavely, Seitz, Szeliski 2006) matched the photographs and left its reconstruction; bundle adjustment polishes
it: every observation of a point in a photograph is a factor on that point and on that camera's pose, focal length and
distortion. The first camera and the distance of the first point are held, since photographs know neither where the
world begins nor its scale.

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
    """The reconstruction before and after bundle adjustment, C cameras and N points, in units of unknown scale."""

    Ts_world_cam: Array
    """(C, 4, 4) Poses of the cameras (x right, y down, z forward)."""
    focal_px: Array
    """(C,) Focal lengths [px]."""
    photographs: tuple[Path, ...]
    """The C photographs."""
    points: Array
    """(N, 3) Points in the world."""
    colours: npt.NDArray[np.uint8]
    """(N, 3) Their colours in the photographs: red, green, blue."""
    views: npt.NDArray[np.int64]
    """(N,) In how many photographs each point is seen."""
    observed_px: Array
    """(M, 2) Observations, from the photograph's centre, x right and y down [px]."""
    reprojected_px: Array
    """(M, 2) Where the solution puts them [px]."""
    observation_camera: npt.NDArray[np.int64]
    """(M,) The camera that made each observation."""
    observation_point: npt.NDArray[np.int64]
    """(M,) The point that it shows."""
    initial_error: float
    """Error of the graph at Bundler's reconstruction: half the sum of the squared, whitened residuals."""
    final_error: float
    """Error of the graph at the solution."""
    iterations: int
    """Steps that the optimizer took."""

    @property
    def reprojection_rms_px(self) -> float:
        """Root mean square distance between observed and reprojected points [px]."""
        squares = np.sum((self.observed_px - self.reprojected_px) ** 2, axis=1)
        return float(np.sqrt(squares.mean()))


def run_sfm_experiment() -> SfmExperiment:
    """Adjust the bundle of Villa Balbianello.

    Returns:
        The reconstruction and how much better it fits.
    """
    data = gtsam.SfmData.FromBundlerFile(gtsam.findExampleDataFile("Balbianello.out"))
    graph = data.sfmFactorGraph(gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA))
    initial = gtsam.initialCamerasAndPointsEstimate(data)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial)
    result = optimizer.optimize()

    cameras = [result.atPinholeCameraCal3Bundler(i) for i in range(data.numberCameras())]
    tracks = [data.track(j) for j in range(data.numberTracks())]
    points = np.stack([result.atPoint3(P(j)) for j in range(len(tracks))])
    camera_of = np.concatenate([track.indexVector() for track in tracks]).astype(np.int64)
    views = np.array([track.numberMeasurements() for track in tracks])
    point_of = np.repeat(np.arange(len(tracks)), views)
    return SfmExperiment(
        Ts_world_cam=np.stack([camera.pose().matrix() for camera in cameras]),
        focal_px=np.array([camera.calibration().fx() for camera in cameras]),
        photographs=tuple(_photograph(i) for i in range(len(cameras))),
        points=points,
        colours=np.round(255.0 * np.array([[t.r, t.g, t.b] for t in tracks])).astype(np.uint8),
        views=views,
        observed_px=np.concatenate([track.measurementMatrix() for track in tracks]),
        reprojected_px=np.stack([cameras[i].project(points[j]) for i, j in zip(camera_of, point_of, strict=True)]),
        observation_camera=camera_of,
        observation_point=point_of,
        initial_error=graph.error(initial),
        final_error=graph.error(result),
        iterations=optimizer.iterations(),
    )


def _photograph(camera: int) -> Path:
    return Path(gtsam.findExampleDataFile(f"Balbianello/BalbianelloMedium-{camera + 1}.jpg"))
