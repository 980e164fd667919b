"""Half a minute of a real flight: our back end beside GTSAM's equivariant filter, on the same image features.

The gtsam package carries the IMU of EuRoC's V1_01 and the features that EqVIO's own front end followed in its images,
in normalized coordinates, about one in five of them wrong. EqVIO estimates position and velocity only.

Sources: van Goor, Mahony, "EqVIO: an equivariant filter for visual-inertial odometry", T-RO 2023; Burri et al., "The
EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

import csv
import time
from dataclasses import dataclass, fields
from pathlib import Path

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.baselines.eqvio import EquivariantFilter, FilterSettings
from dronevio.estimator.frontend.ransac import epipolar_inliers
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import Observations
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.rig import EUROC_CAM0, Rig, RigCamera
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix
from dronevio.models.state import CameraFrame, Trajectory

Array = npt.NDArray[np.float64]

_MOUNTING = tuple(f"T_ci_{key}" for key in ("qw", "qx", "qy", "qz", "tx", "ty", "tz"))


@dataclass(frozen=True, eq=False)
class FeatureRecording:
    """A flight of which only the IMU and the image features are left; satisfies the `Recording` protocol."""

    name: str
    """What to call it."""
    rig: Rig
    """The calibration."""
    imu: ImuSamples
    """All IMU samples."""
    frame_times_ns: Times
    """(M,) Time stamps of the frames [ns]."""
    features: tuple[tuple[npt.NDArray[np.int64], Array], ...]
    """For each frame, identities (N,) in increasing order and normalized coordinates (N, 2)."""
    settings: FilterSettings
    """The filter's settings that come with the data."""
    ground_truth: Trajectory | None = None
    """Not in the data."""

    def frame(self, index: int) -> CameraFrame:
        """Return a frame without an image."""
        return CameraFrame(int(self.frame_times_ns[index]), ())


def read_flight(path: Path | None = None) -> FeatureRecording:
    """Read the flight that comes with the gtsam package.

    Args:
        path: Another file of the same format.

    Raises:
        InputError: The file is missing or not of this format.
    """
    path = path or Path(gtsam.findExampleDataFile("eqvio_processed_30s.csv"))
    settings: dict[str, float] = {}
    imu: list[tuple[int, list[float]]] = []
    frames: dict[int, list[tuple[int, float, float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                match row["row_type"]:
                    case "meta":
                        _keep_number(settings, row["key"], row["value"])
                    case "imu":
                        rates = [float(row[k]) for k in ("gx", "gy", "gz", "ax", "ay", "az")]
                        imu.append((_nanoseconds(row["t_abs"]), rates))
                    case "vision_feature":
                        seen = (int(row["landmark_id"]), float(row["u_norm"]), float(row["v_norm"]))
                        frames.setdefault(_nanoseconds(row["t_abs"]), []).append(seen)
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(path, f"cannot be read ({error})", "a table of IMU samples and image features") from None
    if not imu or not frames:
        raise InputError(path, f"{len(imu)} IMU samples and {len(frames)} frames", "some of both")
    names = tuple(field.name for field in fields(FilterSettings))
    missing = [key for key in (*_MOUNTING, *(f"eqf.{name}" for name in names)) if key not in settings]
    if missing:
        raise InputError(path, f"no setting {missing[0]}", "the camera's pose and the filter's settings")
    measured = np.array([rates for _, rates in imu])
    try:
        samples = ImuSamples(np.array([t for t, _ in imu], dtype=np.int64), measured[:, :3], measured[:, 3:])
    except ConfigError as error:
        raise InputError(path, str(error), "IMU samples in time order") from None
    times = np.array(sorted(frames), dtype=np.int64)
    features = tuple(_columns(sorted(frames[t])) for t in times.tolist())
    mounting = np.array([settings[key] for key in _MOUNTING])
    T_imu_cam = pose_matrix(matrix_from_quat_wxyz(mounting[:4]), mounting[4:])
    rig = Rig((RigCamera(EUROC_CAM0, T_imu_cam),))
    filter_settings = FilterSettings(**{name: settings[f"eqf.{name}"] for name in names})
    return FeatureRecording("V1_01, real IMU and features", rig, samples, times, features, filter_settings)


class ReplayedFeatures:
    """A front end that hands out a flight's features, less those that disagree with one rigid motion."""

    def __init__(self, flight: FeatureRecording, config: TrackerConfig | None = None) -> None:
        self._index = {int(t): i for i, t in enumerate(flight.frame_times_ns)}
        self._features = flight.features
        self._camera = flight.rig.cameras[0].model
        self._config = config or TrackerConfig()
        self._rng = np.random.default_rng(self._config.seed)
        self._rejected: set[int] = set()
        self._last = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))

    def track(self, frame: CameraFrame, R_cur_prev: Array, rotation_sigma_rad: float = 0.0) -> Observations:
        """Return the features of a frame; one that was rejected once stays rejected."""
        ids, xy = self._features[self._index[frame.t_ns]]
        kept = ~np.isin(ids, list(self._rejected))
        ids, xy = ids[kept], xy[kept]
        _, i, j = np.intersect1d(self._last.ids, ids, assume_unique=True, return_indices=True)
        threshold = self._config.ransac_threshold_px / self._camera.fx + rotation_sigma_rad
        inliers = epipolar_inliers(self._last.xy[i], xy[j], R_cur_prev, threshold, self._rng)
        self._rejected.update(ids[j[~inliers]].tolist())
        ages = np.ones(len(ids), np.int64)
        ages[j] = self._last.ages[i] + 1
        good = np.ones(len(ids), dtype=np.bool_)
        good[j[~inliers]] = False
        pixels = self._camera.distort(xy) * [self._camera.fx, self._camera.fy] + [self._camera.cx, self._camera.cy]
        self._last = Observations(ids[good], pixels[good], xy[good], ages[good])
        return self._last

    def replenish(self) -> Observations:
        """Return the last frame's features: the flight brings its new ones by itself."""
        return self._last

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Hand out some features no more."""
        self._rejected.update(ids.tolist())

    def recalibrate(self, rig: Rig) -> None:
        """Do nothing: what was seen has been seen."""


@dataclass(frozen=True, eq=False)
class FilteredPath:
    """What the equivariant filter says."""

    t_ns: Times
    """(M,) Time stamps of the frames [ns]."""
    p_world_imu: Array
    """(M, 3) Positions [m], z up."""
    cpu_ms: Array
    """(M,) Processor time for each frame and the IMU before it [ms]."""


def run_eqvio(flight: FeatureRecording, progress: Progress = silent) -> FilteredPath:
    """Run GTSAM's equivariant filter over a flight, with the settings that come with it."""
    imu, done = flight.imu, 0
    vio = EquivariantFilter(flight.rig.cameras[0].T_imu_cam, flight.settings, imu.accel_m_s2[0])
    positions, cpu_ms = [], []
    for t_ns, (ids, xy) in zip(flight.frame_times_ns.tolist(), flight.features, strict=True):
        started = time.process_time()
        until = min(int(np.searchsorted(imu.t_ns, t_ns)), len(imu) - 1)
        vio.predict(_held(imu, done, until))
        vio.update(ids, xy)
        done = until
        positions.append(vio.position_m)
        cpu_ms.append((time.process_time() - started) * 1e3)
        progress(len(positions), len(flight.features))
    return FilteredPath(flight.frame_times_ns, np.array(positions), np.array(cpu_ms))


def _held(imu: ImuSamples, start: int, end: int) -> Increments:
    """Return what samples say that are held until the next, as the filter was tuned with."""
    dt_s = np.diff(imu.t_ns[start : end + 1]) * 1e-9
    return Increments(dt_s, imu.gyro_rad_s[start:end], imu.accel_m_s2[start:end])


def _nanoseconds(seconds: str) -> int:
    """Return whole nanoseconds of a decimal number of seconds, without rounding through a float."""
    whole, _, fraction = seconds.partition(".")
    return int(whole) * 10**9 + int(fraction.ljust(9, "0")[:9])


def _keep_number(settings: dict[str, float], key: str, value: str) -> None:
    """Store a setting if it is a number; names and paths are of no use here."""
    try:
        settings[key] = float(value)
    except ValueError:
        return


def _columns(rows: list[tuple[int, float, float]]) -> tuple[npt.NDArray[np.int64], Array]:
    return np.array([r[0] for r in rows], dtype=np.int64), np.array([r[1:] for r in rows])
