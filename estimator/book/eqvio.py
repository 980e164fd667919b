"""Half a minute of EuRoC's V1_01: the smoother of this package and GTSAM's equivariant filter on the same features.

The gtsam package includes the IMU samples of V1_01 and the features that EqVIO's front end tracked in its images, in
normalized coordinates; about one in five is an outlier. GTSAM's EqVIO returns position and velocity only.

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
from dronevio.estimator.frontend.protocol import AtExposure
from dronevio.estimator.frontend.ransac import epipolar_inliers
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.rig import EUROC_CAM0, Rig, RigCamera
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix
from dronevio.models.state import CameraFrame, Trajectory

_EXTRINSICS = tuple(f"T_ci_{key}" for key in ("qw", "qx", "qy", "qz", "tx", "ty", "tz"))


@dataclass(frozen=True, eq=False)
class FeatureRecording:
    """IMU samples and image features of a flight, without images; satisfies the `Recording` protocol."""

    name: str
    """Name of the recording."""
    rig: Rig
    """Calibration of cameras and IMU."""
    imu: ImuSamples
    """IMU samples of the whole recording."""
    frame_times_ns: Times
    """(M,) Time stamps of the frames [ns]."""
    features: tuple[tuple[npt.NDArray[np.int64], Array], ...]
    """M frames, each with identities (N,) in increasing order and normalized coordinates (N, 2)."""
    settings: FilterSettings
    """Settings of the filter that come with the data."""
    ground_truth: Trajectory | None = None
    """Ground truth, which the data do not include."""

    def frame(self, index: int) -> CameraFrame:
        """Return a frame without an image."""
        return CameraFrame(int(self.frame_times_ns[index]), ())


def read_feature_recording(path: Path | None = None) -> FeatureRecording:
    """Read the recording that comes with the gtsam package.

    Args:
        path: File of the same format to read instead.

    Raises:
        InputError: The file is missing or has another format.
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
                        _store_number(settings, row["key"], row["value"])
                    case "imu":
                        sample = [float(row[k]) for k in ("gx", "gy", "gz", "ax", "ay", "az")]
                        imu.append((_nanoseconds(row["t_abs"]), sample))
                    case "vision_feature":
                        feature = (int(row["landmark_id"]), float(row["u_norm"]), float(row["v_norm"]))
                        frames.setdefault(_nanoseconds(row["t_abs"]), []).append(feature)
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(path, f"cannot be read ({error})", "a table of IMU samples and image features") from None
    if not imu or not frames:
        raise InputError(path, f"{len(imu)} IMU samples and {len(frames)} frames", "at least one of each")
    names = tuple(field.name for field in fields(FilterSettings))
    missing = [key for key in (*_EXTRINSICS, *(f"eqf.{name}" for name in names)) if key not in settings]
    if missing:
        raise InputError(path, f"no setting {missing[0]}", "the camera's pose and the filter's settings")
    rates = np.array([sample for _, sample in imu])
    try:
        samples = ImuSamples(np.array([t for t, _ in imu], dtype=np.int64), rates[:, :3], rates[:, 3:])
    except ConfigError as error:
        raise InputError(path, str(error), "IMU samples in time order") from None
    times = np.array(sorted(frames), dtype=np.int64)
    features = tuple(_columns(sorted(frames[t])) for t in times.tolist())
    extrinsics = np.array([settings[key] for key in _EXTRINSICS])
    T_imu_cam = pose_matrix(matrix_from_quat_wxyz(extrinsics[:4]), extrinsics[4:])
    rig = Rig((RigCamera(EUROC_CAM0, T_imu_cam),))
    filter_settings = FilterSettings(**{name: settings[f"eqf.{name}"] for name in names})
    return FeatureRecording("V1_01, real IMU and features", rig, samples, times, features, filter_settings)


class ReplayFrontEnd:
    """Front end that returns the features of a recording that are consistent with one rigid motion."""

    def __init__(self, recording: FeatureRecording, config: TrackerConfig | None = None) -> None:
        self._index = {int(t): i for i, t in enumerate(recording.frame_times_ns)}
        self._features = recording.features
        self._camera = recording.rig.cameras[0].model
        self._config = config or TrackerConfig()
        self._rng = np.random.default_rng(self._config.seed)
        self._rejected: set[int] = set()
        self._last = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
    ) -> Observations:
        """Return the features of a frame, without those rejected in this or an earlier frame."""
        ids, xy = self._features[self._index[frame.t_ns]]
        kept = ~np.isin(ids, list(self._rejected))
        ids, xy = ids[kept], xy[kept]
        _, i, j = np.intersect1d(self._last.ids, ids, assume_unique=True, return_indices=True)
        threshold = self._config.ransac_threshold_px / self._camera.fx + rotation_sigma_rad
        inliers = epipolar_inliers(self._last.xy[i], xy[j], R_cur_prev, threshold, self._rng)
        self._rejected.update(ids[j[~inliers]].tolist())
        ages = np.ones(len(ids), np.int64)
        ages[j] = self._last.ages[i] + 1
        kept = np.ones(len(ids), dtype=np.bool_)
        kept[j[~inliers]] = False
        pixels = self._camera.distort(xy) * [self._camera.fx, self._camera.fy] + [self._camera.cx, self._camera.cy]
        self._last = Observations(ids[kept], pixels[kept], xy[kept], ages[kept])
        return self._last

    def replenish(
        self, calibration: Calibration | None = None, at_exposure_of: AtExposure | None = None
    ) -> Observations:
        """Return the features of the last frame, which already include the new ones of the recording."""
        return self._last

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Reject features from now on."""
        self._rejected.update(ids.tolist())


@dataclass(frozen=True, eq=False)
class FilterRun:
    """Result of the equivariant filter over a recording."""

    t_ns: Times
    """(M,) Time stamps of the frames [ns]."""
    p_world_imu: Array
    """(M, 3) Positions in the world frame, z up [m]."""
    cpu_ms: Array
    """(M,) Processor time of each frame, with the IMU samples before it [ms]."""


def run_eqvio(recording: FeatureRecording, progress: Progress = silent) -> FilterRun:
    """Run GTSAM's equivariant filter over a recording, with the settings that come with it."""
    imu, start = recording.imu, 0
    running = EquivariantFilter(recording.rig.cameras[0].T_imu_cam, recording.settings, imu.accel_m_s2[0])
    positions, cpu_ms = [], []
    for t_ns, (ids, xy) in zip(recording.frame_times_ns.tolist(), recording.features, strict=True):
        started_s = time.process_time()
        end = min(int(np.searchsorted(imu.t_ns, t_ns)), len(imu) - 1)
        running.predict(_zero_order_hold(imu, start, end))
        running.update(ids, xy)
        start = end
        positions.append(running.position_m)
        cpu_ms.append((time.process_time() - started_s) * 1e3)
        progress(len(positions), len(recording.features))
    return FilterRun(recording.frame_times_ns, np.array(positions), np.array(cpu_ms))


def _zero_order_hold(imu: ImuSamples, start: int, end: int) -> Increments:
    """Return the increments of the samples ``start`` to ``end``, each held until the next, as the filter is tuned."""
    dt_s = np.diff(imu.t_ns[start : end + 1]) * 1e-9
    return Increments(dt_s, imu.gyro_rad_s[start:end], imu.accel_m_s2[start:end])


def _nanoseconds(seconds: str) -> int:
    """Return a decimal number of seconds in nanoseconds, without the rounding of a float."""
    whole, _, fraction = seconds.partition(".")
    return int(whole) * 10**9 + int(fraction.ljust(9, "0")[:9])


def _store_number(settings: dict[str, float], key: str, value: str) -> None:
    """Store a setting if it is a number; others, such as names and paths, are not needed."""
    try:
        settings[key] = float(value)
    except ValueError:
        return


def _columns(rows: list[tuple[int, float, float]]) -> tuple[npt.NDArray[np.int64], Array]:
    """Return identities (N,) and normalized coordinates (N, 2) of the features of a frame."""
    return np.array([r[0] for r in rows], dtype=np.int64), np.array([r[1:] for r in rows])
