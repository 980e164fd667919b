"""Visual SLAM around an odometry whose frames, keyframes and losses are given."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from dronevio.estimator.config import VioConfig
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.keyframe_observer import KeyframeObserver, OdometryKeyframe
from dronevio.estimator.slam import final_map, visual_slam
from dronevio.estimator.slam.adjustment.adjuster import AdjustmentOutcome
from dronevio.estimator.slam.adjustment.flight_measurements import FlightMeasurements
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.map.keyframe import NO_KEYFRAME_FEATURES, MapKeyframe
from dronevio.estimator.slam.schedule import DelayConfig
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.estimator.slam.worker.keyframe_messages import KeyframeMessages
from dronevio.estimator.slam.worker.map_builder import MarginalizedKeyframe
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rig import Rig
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState, Trajectory
from tests.estimator.slam.process.conftest import DRIFT_M, INTERVAL_NS, PLACES, SECOND_LAP_NS, keyframe, one_camera

T_SECOND_FIRST = pose_matrix(rotation_z(1.0), np.array([10.0, -20.0, 3.0]))
"""Pose of the first odometry frame in that after the loss."""
DELAY = 2
"""Delay of corrections in frames."""
CORRECTION_DELAY = DelayConfig(initial_s=DELAY * INTERVAL_NS * 1e-9, step_s=INTERVAL_NS * 1e-9)
"""The same as a time."""


@dataclass
class ScriptedOdometry:
    """An odometry that repeats given keyframes, each in a frame of its own, which is marginalized two frames later."""

    keyframes: Sequence[MarginalizedKeyframe | None]
    """The keyframe of each frame; None where the odometry is lost."""
    causal_error: Array = field(default_factory=lambda: np.eye(4))
    """Pose of the causal estimates in the frames of the final ones."""
    observer: KeyframeObserver | None = None
    frames: int = 0
    window: list[MarginalizedKeyframe] = field(default_factory=list)

    def __call__(self, rig: Rig, config: VioConfig | None, observer: KeyframeObserver) -> "ScriptedOdometry":
        """Be made like an odometry."""
        self.observer = observer
        return self

    @property
    def imu_noise(self) -> PreintegrationParams:
        """The noise of no particular IMU."""
        return PreintegrationParams.of(one_camera().imu, PreintegrationConfig())

    def add_imu(self, samples: ImuSamples) -> None:
        """Do nothing."""

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return the next pose."""
        assert self.observer is not None
        new = self.keyframes[self.frames]
        self.frames += 1
        if new is None:
            self.window = []
            self.observer.lost()
            return Estimate(frame.t_ns, Health.LOST, None)
        self.window.append(new)
        if len(self.window) > DELAY:
            self.observer.marginalized(self.window.pop(0).estimate)
        estimate = new.estimate
        T, covariance = estimate.T_odom_imu @ self.causal_error, 1e-5 * np.eye(15)
        state = NavState(estimate.t_ns, T, np.zeros(3), np.zeros(3), np.zeros(3), covariance)
        times = tuple(each.estimate.t_ns for each in self.window)
        calibration = Calibration(new.keyframe.rig)
        ids, landmarks = estimate.landmark_ids, estimate.landmarks_odom
        observations = new.keyframe.observations
        self.observer.added(
            OdometryKeyframe(estimate.t_ns, state, observations, calibration, True, True, times, ids, landmarks)
        )
        return Estimate(frame.t_ns, Health.TRACKING, state)


def in_second_frame(message: MarginalizedKeyframe) -> MarginalizedKeyframe:
    """Return a keyframe in the odometry frame after the loss."""
    T, landmarks = message.estimate.T_odom_imu, message.estimate.landmarks_odom
    moved = landmarks @ T_SECOND_FIRST[:3, :3].T + T_SECOND_FIRST[:3, 3]
    estimate = replace(message.estimate, T_odom_imu=T_SECOND_FIRST @ T, landmarks_odom=moved)
    R_odom_imu = estimate.T_odom_imu[:3, :3]
    return MarginalizedKeyframe(replace(message.keyframe, R_odom_imu=R_odom_imu), estimate)


def run(
    monkeypatch: pytest.MonkeyPatch, keyframes: Sequence[MarginalizedKeyframe | None], causal_error: Array | None = None
) -> tuple[VisualSlam, list[Estimate]]:
    """Return visual SLAM after a flight, and its estimates."""
    odometry = ScriptedOdometry(keyframes, np.eye(4) if causal_error is None else causal_error)
    monkeypatch.setattr(visual_slam, "VisualInertialOdometry", odometry)
    config = SlamConfig(worker=False, correction_delay=CORRECTION_DELAY)
    slam, estimates, t_ns = VisualSlam(one_camera(), config=config), [], 0
    for message in keyframes:
        t_ns = t_ns + 50_000_000 if message is None else message.estimate.t_ns
        images = (np.zeros((8, 8), np.uint8),) if message is None else message.keyframe.images
        if causal_error is not None:
            slam.add_imu(ImuSamples(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3))))
        estimates.append(slam.add_frame(CameraFrame(t_ns, images)))
    return slam, estimates


def places(second_lap: Sequence[int]) -> list[MarginalizedKeyframe | None]:
    """Return a lap through the places, a loss, and keyframes at other places in another odometry frame."""
    rig = one_camera()
    first = [keyframe(rig, place, 0) for place in range(PLACES)]
    return [*first, None, *(in_second_frame(keyframe(rig, place, 1)) for place in second_lap)]


def test_after_a_loss_a_recognized_place_gives_the_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slam, estimates = run(monkeypatch, places(range(PLACES)))
    before, after = estimates[:PLACES], estimates[PLACES + 1 :]
    assert all(estimate.T_map_odom is not None for estimate in before)
    joined = next(i for i, estimate in enumerate(after) if estimate.T_map_odom is not None)
    assert DELAY <= joined < PLACES - 1
    assert after[joined].events == ("track joined with the map",)
    for estimate in after[joined:]:
        # The second lap of the odometry is off by its drift.
        T = estimate.T_map_odom
        assert T is not None
        expected = pose_matrix(np.eye(3), np.array([0.0, -DRIFT_M, 0.0]))
        np.testing.assert_allclose(T @ T_SECOND_FIRST, expected, atol=0.5 * DRIFT_M)
        assert estimate.map_covariance is not None
    for estimate in after[:joined]:
        assert estimate.T_map_odom is None and estimate.T_map_imu is None and estimate.map_covariance is None
    assert slam.summary.separate_tracks == 0


def test_the_correction_at_keyframes_has_the_schedule_of_the_newest_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = one_camera()
    _, estimates = run(monkeypatch, [keyframe(rig, place, lap) for lap in range(2) for place in range(PLACES)])
    corrections = [estimate.map_correction for estimate in estimates]
    known: MapCorrection | None = None
    for index, (estimate, found) in enumerate(zip(estimates, corrections, strict=True)):
        assert found is not None and estimate.track == 0 and estimate.T_map_odom is not None
        # A keyframe is marginalized DELAY frames later, and its correction is due after a time.
        marginalized_ns = [estimates[k + DELAY].t_ns for k in range(max(index + 1 - DELAY, 0))]
        keyframes = sum(t_ns + DELAY * INTERVAL_NS <= estimate.t_ns for t_ns in marginalized_ns)
        assert len(found.t_ns) == keyframes
        assert found.t_ns.tolist() == [earlier.t_ns for earlier in estimates[:keyframes]]
        if keyframes:
            np.testing.assert_array_equal(found.Ts_map_odom[-1], estimate.T_map_odom)
            assert found is known or len(found.t_ns) > len(known.t_ns if known else ())
        known = found
    # The loops have moved the second lap back, and the first one not by much.
    last = corrections[-1]
    assert last is not None
    moved_m = last.Ts_map_odom[:, 1, 3] + DRIFT_M * (last.t_ns >= SECOND_LAP_NS)
    assert len(moved_m) > PLACES + 2 and np.abs(moved_m).max() < 0.4 * DRIFT_M


def test_the_correction_at_keyframes_after_a_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    _, estimates = run(monkeypatch, places(range(PLACES)))
    after = estimates[PLACES:]
    assert [estimate.track for estimate in estimates] == PLACES * [0] + (PLACES + 1) * [1]
    before = estimates[PLACES - 1].map_correction
    assert before is not None and len(before.t_ns) >= 2
    for estimate in after:
        found = estimate.map_correction
        assert found is not None and found.of_track(0, 0) is not None
        assert (found.of_track(1, estimate.t_ns) is None) == (1 not in (found.track if found.track is not None else ()))
        np.testing.assert_array_equal(np.isnan(found.at(np.array([estimate.t_ns]))[:, 0, 0]), [1 not in found.track])  # type: ignore[operator]
    last = after[-1].map_correction
    assert last is not None and after[-1].T_map_odom is not None
    T = last.of_track(1, after[-1].t_ns)
    assert T is not None
    np.testing.assert_allclose(T, after[-1].T_map_odom, atol=1e-9)


def test_the_correction_has_the_stamps_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of a keyframe is that of the clock of the IMU, from which the cameras' clock may differ."""
    monkeypatch.setattr(
        visual_slam, "VisualInertialOdometry", ScriptedOdometry([keyframe(one_camera(), p, 0) for p in range(PLACES)])
    )
    slam, offset_ns = (
        VisualSlam(one_camera(), config=SlamConfig(worker=False, correction_delay=CORRECTION_DELAY)),
        -7_000_000,
    )
    known = [keyframe(one_camera(), place, 0) for place in range(PLACES)]
    stamps_ns = [each.estimate.t_ns - offset_ns for each in known]
    estimates = [slam.add_frame(CameraFrame(t, k.keyframe.images)) for t, k in zip(stamps_ns, known, strict=True)]
    found = estimates[-1].map_correction
    assert found is not None and len(found.t_ns) >= 3
    assert found.t_ns.tolist() == stamps_ns[: len(found.t_ns)]


def test_a_track_without_known_places_is_not_in_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, estimates = run(monkeypatch, places(range(20, 20 + PLACES)))
    assert all(estimate.T_map_odom is None for estimate in estimates[PLACES:])
    assert slam.summary.separate_tracks == 1
    trajectory = Trajectory.from_states(estimate.state for estimate in estimates if estimate.state is not None)
    final = slam.final_map()
    assert final is not None and len(trajectory) == 2 * PLACES
    np.testing.assert_array_equal(trajectory.corrected(final.correction).t_ns, trajectory.t_ns[:PLACES])


def test_covariance_before_the_first_correction(monkeypatch: pytest.MonkeyPatch) -> None:
    _, estimates = run(monkeypatch, places([]))
    np.testing.assert_array_equal(estimates[0].map_covariance, 1e-5 * np.eye(6))


def test_final_path_has_the_keyframes_at_their_final_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The causal estimates differ from those when the keyframes leave the window, which the map has."""
    monkeypatch.setattr(
        final_map, "solved", lambda inputs, config: AdjustmentOutcome(None, "not used")
    )  # the pose graph gives the final poses
    causal_error = pose_matrix(np.eye(3), np.array([0.04, 0.0, -0.02]))
    rig = one_camera()
    slam, estimates = run(monkeypatch, [keyframe(rig, p, lap) for lap in range(2) for p in range(PLACES)], causal_error)
    final = slam.final_map()
    assert final is not None and len(final.closed) >= 2 and final.adjustment == "not used"
    trajectory = Trajectory.from_states(estimate.state for estimate in estimates if estimate.state is not None)
    found = trajectory.corrected(final.correction)
    at_keyframes = np.isin(found.t_ns, final.t_ns)
    np.testing.assert_allclose(found.p_world_imu[at_keyframes], final.Ts_map_imu[:, :3, 3], atol=1e-9)


def test_a_map_without_loops_is_exported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rig = one_camera()
    messages = [keyframe(rig, place, 0) for place in range(PLACES)]
    slam, _ = run(monkeypatch, messages, np.eye(4))
    found = slam.reconstruction()
    assert found.stamps_ns.tolist() == [message.estimate.t_ns for message in messages[:-DELAY]]
    for T_map_cam, message in zip(found.reconstruction.Ts_world_cam, messages[:-DELAY], strict=True):
        np.testing.assert_allclose(T_map_cam, message.estimate.T_odom_imu @ rig.cameras[0].T_imu_cam, atol=1e-9)
    slam.save_graph(tmp_path / "graph.g2o")
    assert (tmp_path / "graph.g2o").read_text().count("EDGE") == PLACES - DELAY - 1


def test_a_map_without_keyframes_is_not_exported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    slam, _ = run(monkeypatch, [keyframe(one_camera(), 0, 0)], np.eye(4))
    for save in (
        lambda: slam.save_graph(tmp_path / "graph.g2o"),
        lambda: slam.save_ply(tmp_path / "points.ply"),
        slam.reconstruction,
    ):
        with pytest.raises(ConfigError, match=r"map without keyframes.*; expected one or more"):
            save()
    assert not list(tmp_path.iterdir())


def test_keyframes_that_leave_together_have_measurements() -> None:
    rig, messages = one_camera(), KeyframeMessages(window_s=3.0)
    noise = PreintegrationParams.of(rig.imu, PreintegrationConfig())
    pair = [keyframe(rig, place, 0) for place in range(2)]
    for each in pair:
        t_ns = each.estimate.t_ns
        messages.add_imu(ImuSamples(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3))))
        messages.begin_frame(CameraFrame(t_ns, each.keyframe.images), noise, has_map_pose=True)
        state = NavState(t_ns, each.estimate.T_odom_imu, np.zeros(3), np.zeros(3), np.zeros(3))
        times = tuple(other.estimate.t_ns for other in pair)
        known = each.estimate.landmark_ids, each.estimate.landmarks_odom
        calibration = Calibration(rig)
        messages.added(
            OdometryKeyframe(t_ns, state, each.keyframe.observations, calibration, True, True, times, *known)
        )
    for each in pair:
        messages.marginalized(each.estimate)
    found = [m.measured for m in messages.take() if isinstance(m, MarginalizedKeyframe)]
    assert [m is not None and len(m.imu) for m in found] == [2, 0]


def test_images_of_keyframes_are_found_by_their_stamps() -> None:
    """The time of a keyframe is that of the clock of the IMU, from which the cameras' clock may differ."""
    rig, known, offset_ns = one_camera(), keyframe(one_camera(), 0, 0), -7_000_000
    messages, measurements = KeyframeMessages(window_s=3.0), FlightMeasurements(rig.imu)
    noise, t_ns = PreintegrationParams.of(rig.imu, PreintegrationConfig()), known.estimate.t_ns
    messages.add_imu(ImuSamples(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3))))
    messages.begin_frame(CameraFrame(t_ns - offset_ns, known.keyframe.images), noise, has_map_pose=True)
    state = NavState(t_ns, known.estimate.T_odom_imu, np.zeros(3), np.zeros(3), np.zeros(3))
    landmarks = known.estimate.landmark_ids, known.estimate.landmarks_odom
    added = OdometryKeyframe(
        t_ns, state, known.keyframe.observations, Calibration(rig), True, True, (t_ns,), *landmarks
    )
    messages.added(added)
    messages.marginalized(known.estimate)
    (message,) = messages.take()
    assert isinstance(message, MarginalizedKeyframe) and message.measured is not None
    measurements.add(message.estimate, message.measured)
    of_map = MapKeyframe(0, t_ns, known.estimate.T_odom_imu, NO_KEYFRAME_FEATURES, *landmarks)
    assert measurements.stamps_ns([of_map]).tolist() == [t_ns - offset_ns]


def test_samples_are_kept_from_a_window_before_a_track_on() -> None:
    """Before it, and after a loss, those of the longest window of an initialization suffice; then, all are needed."""
    rig, messages = one_camera(), KeyframeMessages(window_s=3.0)
    noise = PreintegrationParams.of(rig.imu, PreintegrationConfig())
    first = keyframe(rig, 0, 0)
    begin_ns = first.estimate.t_ns - 60 * 10**9

    def fly(start_ns: int, end_ns: int) -> None:
        for t_ns in range(start_ns, end_ns + 1, 10**8):
            messages.add_imu(ImuSamples(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3))))
            messages.begin_frame(CameraFrame(t_ns, first.keyframe.images), noise, has_map_pose=True)

    def join() -> ImuSamples:
        t_ns = first.estimate.t_ns
        state = NavState(t_ns, first.estimate.T_odom_imu, np.zeros(3), np.zeros(3), np.zeros(3))
        known = first.estimate.landmark_ids, first.estimate.landmarks_odom
        messages.added(
            OdometryKeyframe(t_ns, state, first.keyframe.observations, Calibration(rig), True, True, (t_ns,), *known)
        )
        fly(t_ns + 10**8, t_ns + 20 * 10**9)
        messages.marginalized(first.estimate)
        (found,) = [m.measured for m in messages.take() if isinstance(m, MarginalizedKeyframe)]
        assert found is not None
        return found.imu

    fly(begin_ns, first.estimate.t_ns)
    for _ in range(2):
        imu = join()
        assert imu.t_ns[0] == first.estimate.t_ns - 3 * 10**9
        assert imu.t_ns[-1] == first.estimate.t_ns + 20 * 10**9
        np.testing.assert_array_equal(np.diff(imu.t_ns), 10**8)
        messages = KeyframeMessages(window_s=3.0)
        fly(begin_ns, first.estimate.t_ns - 10**8)
        messages.lost()
        fly(first.estimate.t_ns, first.estimate.t_ns)
