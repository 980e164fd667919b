"""The odometry after a correction of the calibration in motion."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.frontend.protocol import AtExposure
from dronevio.estimator.keyframe_observer import OdometryKeyframe
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.types import Calibration, Matches, Observations
from dronevio.eval.metrics.consistency import errors_and_sigmas_m
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import CameraFrame, Estimate, Health, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]


class WindowLengths:
    """Records how many keyframes the window has at each keyframe."""

    def __init__(self) -> None:
        self.of_times: dict[int, int] = {}
        """Lengths of the window by the times of the keyframes [ns]."""

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Record the length of the window."""
        self.of_times[keyframe.t_ns] = len(keyframe.window_times_ns)

    def marginalized(self, estimate: KeyframeEstimate) -> None:
        """Ignore the estimate of a keyframe that leaves the window."""

    def lost(self) -> None:
        """Fail, because the flight is never lost."""
        raise AssertionError("the estimate was lost")


def test_a_correction_in_motion_keeps_the_window(make_flight: MakeFlight) -> None:
    """After the correction of a time offset of 6 ms, the next keyframe is added to the window of those before."""
    flight = make_flight(0, rest_s=-5.0, duration_s=10.0)
    front_end = replace(flight, rig=replace(flight.rig, time_offset_s=0.006)).front_end()
    lengths = WindowLengths()
    estimates = flight.run(front_end, observer=lengths)
    corrected_ns = [e.t_ns for e in estimates if any("calibration corrected: time offset" in x for x in e.events)]
    assert corrected_ns
    following = min(t_ns for t_ns in lengths.of_times if t_ns > corrected_ns[0])
    assert lengths.of_times[following] > 5


class WrongLenses:
    """A front end of one or two cameras whose pixels are normalized by other lenses."""

    def __init__(self, flight: "SyntheticFlight", rig: Rig) -> None:
        """Observe a flight, whose rig has the cameras of another one with wrong lenses."""
        self._flight, self._front_end, self._rig = flight, flight.front_end(), rig
        self._rng = np.random.default_rng([flight.seed, 4])
        self._t_ns = 0

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
    ) -> Observations:
        """Return the tracked features."""
        self._t_ns = frame.t_ns
        return self._normalized(self._front_end.track(frame, R_cur_prev, rotation_sigma_rad, calibration))

    def replenish(
        self, calibration: Calibration | None = None, at_exposure_of: AtExposure | None = None
    ) -> Observations:
        """Return further features, with matches in the second camera."""
        seen = self._normalized(self._front_end.replenish(calibration, at_exposure_of))
        if len(self._rig.cameras) == 1:
            return seen
        T_world_imu = self._flight.state_at(self._t_ns).T_world_imu
        T = inverse_pose(T_world_imu @ self._rig.cameras[1].T_imu_cam)
        landmarks = self._flight.landmarks[self._front_end.landmark_rows]
        model, in_camera = self._flight.rig.cameras[1].model, landmarks @ T[:3, :3].T + T[:3, 3]
        pixels = model.project(in_camera) + self._flight.pixel_noise * self._rng.normal(size=(len(landmarks), 2))
        inside = np.all((pixels > 12) & (pixels < [model.width - 13, model.height - 13]), axis=1)
        xy = self._rig.cameras[1].model.normalize(pixels[inside])
        return replace(seen, matches=Matches(seen.ids[inside], np.ones(len(xy), np.int64), xy))

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking features."""
        self._front_end.discard(ids)

    def _normalized(self, seen: Observations) -> Observations:
        return replace(seen, xy=self._rig.cameras[0].model.normalize(seen.pixels))


def stereo_flight(flight: "SyntheticFlight") -> "SyntheticFlight":
    """Return a flight with EuRoC's pair of cameras."""
    rig = replace(rig_named("euroc-stereo"), imu=flight.rig.imu, T_vehicle_imu=flight.rig.T_vehicle_imu)
    return replace(flight, rig=rig)


def estimated_by(flight: "SyntheticFlight", rig: Rig) -> list[Estimate]:
    """Return the estimates of a flight by a wrong calibration."""
    vio, estimates = VisualInertialOdometry(rig, front_end=WrongLenses(flight, rig)), []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimates.append(vio.add_frame(measurement))
    return estimates


def errors_of(flight: "SyntheticFlight", estimates: Sequence[Estimate]) -> tuple[Array, Array]:
    """Return the errors (N,) of the N published positions, and their standard deviations (N,) [m]."""
    estimated = Trajectory.from_states(e.state for e in estimates if e.state is not None)
    return errors_and_sigmas_m(flight.truth_at(estimated.t_ns), estimated)


def miscalibrated(rig: Rig, rng: np.random.Generator) -> Rig:
    """Return a rig of whose cameras rotation, focal length, principal point and distortion are wrong."""
    cameras = []
    for camera in rig.cameras:
        m, ratio, k1 = camera.model, 1.0 + 0.015 * rng.normal(), 0.01 * rng.normal()
        cx, cy = np.array([m.cx, m.cy]) + 4.0 * rng.normal(size=2)
        distortion = (m.distortion[0] + k1, *m.distortion[1:])
        model = replace(m, fx=ratio * m.fx, fy=ratio * m.fy, cx=cx, cy=cy, distortion=distortion)
        turned = pose_matrix(exp_so3(0.015 * rng.normal(size=3)), np.zeros(3))
        cameras.append(replace(camera, model=model, T_imu_cam=camera.T_imu_cam @ turned))
    return replace(rig, cameras=tuple(cameras))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_cameras_that_are_wrong_in_everything(make_flight: MakeFlight, seed: int) -> None:
    """By depths of a rig that is known to be wrong, errors would reach 7 to 37 standard deviations.

    Until the calibration is known again, the health says so.
    """
    flight = stereo_flight(make_flight(seed, rest_s=1.0, duration_s=12.0))
    estimates = estimated_by(flight, miscalibrated(flight.rig, np.random.default_rng(seed)))
    error_m, sigma_m = errors_of(flight, estimates)
    assert (error_m / sigma_m).max() < 4.0
    causes = [e.health_report.cause for e in estimates if e.health_report is not None]
    assert Cause.UNKNOWN_CALIBRATION in causes[:-1] and causes[-1] is not Cause.UNKNOWN_CALIBRATION


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exchanged_cameras_are_noticed(make_flight: MakeFlight, seed: int) -> None:
    """No calibration explains their matches, although corrections within the priors make many of them agree.

    With the third seed, three poses are wrong before.
    """
    flight = stereo_flight(make_flight(seed, rest_s=1.0, duration_s=12.0))
    first, second = flight.rig.cameras
    estimates = estimated_by(flight, replace(flight.rig, cameras=(second, first)))
    error_m, sigma_m = errors_of(flight, estimates)
    is_tracking = np.array([e.health is Health.TRACKING for e in estimates if e.state is not None])
    is_wrong = error_m > np.maximum(0.3, 5.0 * sigma_m)
    assert is_wrong.any() and np.sum(is_wrong & is_tracking) <= 3
    report = estimates[-1].health_report
    assert report is not None and report.cause is Cause.IMPLAUSIBLE_CALIBRATION


@pytest.mark.parametrize(("cameras", "wrong_m_s"), [(1, 0.15), (2, 0.12)])
def test_a_corrected_focal_length_mends_the_state_in_motion(
    make_flight: MakeFlight, cameras: int, wrong_m_s: float
) -> None:
    """Focal lengths 5 % off make the estimate drift; their correction ends that at once."""
    flight = stereo_flight(make_flight(0, rest_s=-5.0, duration_s=14.0))
    flight = replace(flight, rig=replace(flight.rig, cameras=flight.rig.cameras[:cameras]))
    models = [replace(c.model, fx=1.05 * c.model.fx, fy=1.05 * c.model.fy) for c in flight.rig.cameras]
    wrong = (replace(camera, model=model) for camera, model in zip(flight.rig.cameras, models, strict=True))
    estimates = estimated_by(flight, replace(flight.rig, cameras=tuple(wrong)))
    corrected = next(i for i, e in enumerate(estimates) if any("focal length" in x for x in e.events))

    def velocity_errors(rows: range) -> tuple[Array, Array]:
        """Return errors (N, 3) of the velocity [m/s], and the roots of their mean variances (N,) [m/s]."""
        found = [state for i in rows if (state := estimates[i].state) is not None]
        true = [flight.state_at(state.t_ns) for state in found]
        heading = [f.T_world_imu[:3, :3] @ t.T_world_imu[:3, :3].T for f, t in zip(found, true, strict=True)]
        errors = [f.velocity_m_s - R @ t.velocity_m_s for f, t, R in zip(found, true, heading, strict=True)]
        variances = [np.trace(f.covariance[6:9, 6:9]) / 3.0 for f in found if f.covariance is not None]
        return np.array(errors), np.sqrt(variances)

    def sigmas_of(row: int) -> tuple[float, float]:
        """Return the standard deviations of the position [m] and of the heading [rad]."""
        state = estimates[row].state
        assert state is not None and state.covariance is not None
        vertical = state.T_world_imu[2, :3]
        heading = float(vertical @ state.covariance[:3, :3] @ vertical)
        return float(np.sqrt(np.trace(state.covariance[3:6, 3:6]))), float(np.sqrt(heading))

    # The position does not become more certain by the correction, nor the heading less
    (position_m, heading_rad), (corrected_m, corrected_rad) = sigmas_of(corrected - 1), sigmas_of(corrected)
    assert corrected_m > 0.9 * position_m
    assert corrected_rad < 1.5 * heading_rad
    before, _ = velocity_errors(range(corrected - 20, corrected))
    after, sigmas = velocity_errors(range(corrected, corrected + 20))
    assert np.linalg.norm(before, axis=1).min() > wrong_m_s
    assert np.linalg.norm(after, axis=1).max() < 0.05
    assert np.all(np.linalg.norm(after, axis=1) < 3.0 * sigmas)
