"""The whole odometry at any frame rate: recordings that are played faster or slower, as exact similarities."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.baselines.dead_reckoning import preintegrate
from dronevio.estimator.config import VioConfig
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.types import Calibration, Matches, Observations
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.errors import ate
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import CameraFrame, Health

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight, SyntheticFrontEnd

MakeFlight = Callable[..., "SyntheticFlight"]

RATE_HZ = 20.0
"""Frame rate of the recordings that are played."""
RATES_HZ = (12.5, 15.0, 25.0, 29.97)
"""Rates at which no frame is exactly as old as the window of an initialization is long."""


@pytest.fixture(scope="module")
def similarity(script: Callable[[str], Any]) -> Any:
    """The functions that play a recording."""
    return script("similarity")


@dataclass
class PlayedFrontEnd:
    """The front end of a synthetic flight at the frames of its copy, with the matches of a second camera."""

    flight: "SyntheticFlight"
    """The flight, whose rig has one or two cameras."""
    played_ns: npt.NDArray[np.int64]
    """(M,) Time stamps of the frames of the copy [ns]."""
    inner: "SyntheticFrontEnd" = field(init=False)
    now_ns: int = 0

    def __post_init__(self) -> None:
        self.inner = self.flight.front_end()
        self.rng = np.random.default_rng([self.flight.seed, 4])

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
    ) -> Observations:
        """Observe what the flight shows at the frame that is played."""
        self.now_ns = int(self.flight.frame_times_ns[np.searchsorted(self.played_ns, frame.t_ns)])
        return self.inner.track(replace(frame, t_ns=self.now_ns), R_cur_prev, rotation_sigma_rad)

    def replenish(self, calibration: Calibration | None = None, at_exposure_of: object = None) -> Observations:
        """Observe further landmarks, and match all of them in the second camera."""
        observations, cameras = self.inner.replenish(), self.flight.rig.cameras
        if len(cameras) == 1:
            return observations
        T_cam_world = inverse_pose(self.flight.state_at(self.now_ns).T_world_imu @ cameras[1].T_imu_cam)
        landmark = np.flatnonzero(self.inner._ids >= 0)
        landmark = landmark[np.argsort(self.inner._ids[landmark])]
        points = self.flight.landmarks[landmark] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        noise = self.flight.pixel_noise / cameras[1].model.fx * self.rng.normal(size=(len(points), 2))
        matches = Matches(observations.ids, np.ones(len(points), np.int64), points[:, :2] / points[:, 2:] + noise)
        return replace(observations, matches=matches)

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking features."""
        self.inner.discard(ids)


def errors_of(run: EstimatorRun, played: Any) -> tuple[float, float]:
    """Return the time of the first pose after the first frame [s], and the ATE [m]."""
    trajectory = run.trajectory
    assert len(trajectory), run.estimates[-1].health_report
    truth, rows = interpolate(played.ground_truth, trajectory.t_ns)
    first_s = (int(trajectory.t_ns[0]) - int(played.frame_times_ns[0])) * 1e-9
    return first_s, ate(truth.p_world_imu, trajectory.p_world_imu[rows]).rmse


# --- the similarity


def test_played_imu_moves_through_a_larger_world(make_flight: MakeFlight, similarity: Any) -> None:
    """Dead reckoning from the true state: the same orientations, and s² times the path."""
    flight, s = make_flight(1, rest_s=-5.0, duration_s=2.0, noisy=False), 1.6
    flight = replace(flight, ground_truth=flight.truth_at(flight.imu.t_ns))
    recordings: list[Any] = [flight, similarity.similar(flight, s, np.zeros(3))]
    ends = []
    for recording in recordings:
        buffer, truth = ImuBuffer(), recording.ground_truth
        buffer.add(recording.imu)
        buffer.take_until(int(truth.t_ns[0]))
        increments = buffer.take_until(int(truth.t_ns[-1]))
        dR, _, dp = preintegrate(increments, np.zeros(3), np.zeros(3))
        t, R, v = increments.duration_s, truth.rotations[0], truth.velocity_m_s[0]
        displacement = v * t + R @ dp - 0.5 * np.array([0.0, 0.0, GRAVITY_M_S2]) * t * t
        ends.append((R @ dR, displacement))
        np.testing.assert_allclose(displacement, truth.p_world_imu[-1] - truth.p_world_imu[0], atol=0.01)
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-9)
    np.testing.assert_allclose(ends[1][1], s**2 * ends[0][1], rtol=1e-6)
    velocities = [recording.ground_truth.velocity_m_s for recording in recordings]
    np.testing.assert_allclose(velocities[1], s * velocities[0])


def test_played_gyroscope_keeps_its_bias(make_flight: MakeFlight, similarity: Any) -> None:
    """A bias is an error of the sensor, which does not turn more slowly."""
    flight, s = make_flight(1, duration_s=1.0), 1.6
    bias = np.array([0.05, -0.02, 0.08])
    biased = replace(flight, gyro_bias=flight.gyro_bias + flight.motion.R_vehicle_imu @ bias)
    without, played = (similarity.similar(each, s, b) for each, b in ((flight, np.zeros(3)), (biased, bias)))
    np.testing.assert_allclose(played.imu.gyro_rad_s, without.imu.gyro_rad_s + bias, atol=1e-12)


def test_played_noise_is_that_of_the_samples(similarity: Any) -> None:
    """A density is the noise of a sample times the root of its interval; a walk changes a bias over time."""
    s = 1.6
    played = similarity.similar_imu(EUROC_IMU, s)
    of_samples, of_played = (np.sqrt(imu.rate_hz) for imu in (EUROC_IMU, played))
    assert played.gyro_noise_density * of_played == pytest.approx(EUROC_IMU.gyro_noise_density * of_samples / s)
    assert played.accel_noise_density * of_played == pytest.approx(EUROC_IMU.accel_noise_density * of_samples)
    walked = np.sqrt(s * 10.0)  # what a bias wanders by in 10 s of the recording: the gyroscope's is divided, too
    assert played.gyro_random_walk * walked == pytest.approx(EUROC_IMU.gyro_random_walk * np.sqrt(10.0) / s)
    assert played.accel_random_walk * walked == pytest.approx(EUROC_IMU.accel_random_walk * np.sqrt(10.0))
    assert played.gyro_turn_on_bias_rad_s == EUROC_IMU.gyro_turn_on_bias_rad_s


def test_played_rig_has_a_larger_baseline(similarity: Any) -> None:
    rig, s = replace(rig_named("euroc-stereo"), time_offset_s=0.004), 1.6
    played = similarity.similar_rig(rig, s)
    assert played.cameras[0].rate_hz == pytest.approx(RATE_HZ / s) and played.time_offset_s == pytest.approx(0.0064)
    for ours, theirs in zip(played.cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(ours.T_imu_cam[:3, 3], s**2 * theirs.T_imu_cam[:3, 3])
        np.testing.assert_array_equal(ours.T_imu_cam[:3, :3], theirs.T_imu_cam[:3, :3])


# --- the odometry


@pytest.mark.parametrize(("rate_hz", "jitter_s"), [*((rate_hz, 0.0) for rate_hz in RATES_HZ), (25.0, 1e-4)])
@pytest.mark.parametrize("cameras", [1, 2])
def test_flight_starts_in_motion_at_any_frame_rate(
    make_flight: MakeFlight, similarity: Any, cameras: int, rate_hz: float, jitter_s: float
) -> None:
    s, rig = RATE_HZ / rate_hz, rig_named("euroc-stereo")
    flight = make_flight(2, rest_s=-5.0, duration_s=4.0, max_features=120)
    flight = replace(flight, rig=replace(rig, cameras=rig.cameras[:cameras]))
    flight = replace(flight, ground_truth=flight.truth_at(flight.imu.t_ns))
    played = similarity.similar(flight, s, flight.gyro_bias @ flight.motion.R_vehicle_imu)
    jittered = similarity.jittered(played, jitter_s)
    config, front_end = VioConfig(), PlayedFrontEnd(flight, jittered.frame_times_ns)
    window_s = config.initialization.dynamic.window_s if cameras == 1 else config.initialization.dynamic.stereo_window_s
    run = estimate_recording(jittered, VisualInertialOdometry(played.rig, config, front_end))
    first_s, ate_m = errors_of(run, played)
    assert first_s <= 1.5 * window_s + 2.0 / rate_hz
    assert (
        ate_m <= (0.025 if cameras == 1 else 0.01) * s**2
    )  # slowly played, one camera sees little acceleration in a window
    assert all(estimate.health is not Health.LOST for estimate in run.estimates)


@pytest.mark.parametrize(
    ("cameras", "rate_hz", "limit_m"),
    [
        (1, 29.97, 0.008),
        (2, 25.0, 0.006),
        pytest.param(1, 12.5, 0.008, marks=pytest.mark.slow),
        pytest.param(1, 15.0, 0.008, marks=pytest.mark.slow),
        pytest.param(1, 25.0, 0.008, marks=pytest.mark.slow),
        pytest.param(2, 15.0, 0.006, marks=pytest.mark.slow),
    ],
)
def test_real_images_start_in_motion_at_any_frame_rate(
    data_folder: Path, similarity: Any, cameras: int, rate_hz: float, limit_m: float
) -> None:
    recording, s = open_recording(data_folder / "euroc" / "MH_01_real", cameras), RATE_HZ / rate_hz
    part = similarity.part_of(recording, np.arange(round(3.0 / min(s, 1.0) * RATE_HZ)))
    played = similarity.similar(part, s, similarity.gyro_bias_of(recording))
    run = estimate_recording(played, VisualInertialOdometry(played.rig))
    first_s, ate_m = errors_of(run, played)
    assert first_s <= 1.5 * (1.5 if cameras == 1 else 0.5) + 2.0 / rate_hz
    assert ate_m <= limit_m * s**2


def test_swapped_sensors_are_named(data_folder: Path, similarity: Any) -> None:
    """Two seconds of the flight suffice, and the units are not named."""
    recording = open_recording(data_folder / "euroc" / "MH_01_real", 1)
    part = similarity.part_of(recording, np.arange(54))
    imu = replace(part.imu, gyro_rad_s=part.imu.accel_m_s2, accel_m_s2=part.imu.gyro_rad_s)
    run = estimate_recording(replace(part, imu=imu), VisualInertialOdometry(part.rig))
    assert [text for _, text in run.warnings] == [f"probable cause: {Cause.SENSORS_SWAPPED}"]
    report = run.estimates[-1].health_report
    assert report is not None and Cause.SENSORS_SWAPPED in report.reason and "units" not in report.reason
