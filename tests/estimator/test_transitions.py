"""From one state of the odometry to the next: what a publication, a correction and another time offset leave behind."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.calibration.calibrator import Correction
from dronevio.estimator.calibration.rotation_offset import RotationOffset
from dronevio.estimator.config import VioConfig
from dronevio.estimator.imu.buffer import NO_INCREMENTS
from dronevio.estimator.imu.noise import ImuNoiseEstimator
from dronevio.estimator.initialization.gauge import LastPublished
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.monitoring.health import Assessment
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.odometry_state import Initializing, Tracking
from dronevio.estimator.output import MIN_CAUSE_NS
from dronevio.estimator.pipeline import MeasurementPipeline
from dronevio.estimator.transitions import publish, with_offset
from dronevio.estimator.types import NO_FEATURES, CalibrationSigmas, FramePacket, Observations
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.rig import euroc_rig
from dronevio.models.state import NO_IMAGE, CameraFrame, NavState

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

FRAME_NS = 50_000_000


def push(vio: VisualInertialOdometry, feed: Iterator[ImuSamples | CameraFrame], frames: int) -> None:
    """Push measurements into an odometry, up to a number of frames."""
    for measurement in feed:
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
            continue
        vio.add_frame(measurement)
        frames -= 1
        if not frames:
            return


@pytest.fixture(scope="module")
def short_flight(make_flight: Callable[..., "SyntheticFlight"]) -> "SyntheticFlight":
    return make_flight(0, rest_s=1.0, duration_s=3.0)


@pytest.fixture
def vio(short_flight: "SyntheticFlight") -> VisualInertialOdometry:
    """An odometry that tracks, after all of a flight."""
    vio = VisualInertialOdometry(short_flight.rig, front_end=short_flight.front_end())
    push(vio, iter(measurements(short_flight)), len(short_flight.frame_times_ns))
    assert isinstance(vio._state.phase, Tracking)
    return vio


def next_packet(vio: VisualInertialOdometry) -> FramePacket:
    """Return a frame without measurements after the newest one."""
    return FramePacket(vio._state.estimate.t_ns + FRAME_NS, NO_INCREMENTS, NO_FEATURES)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_pose_is_the_gauge_only_if_landmarks_agree_with_it(vio: VisualInertialOdometry, share: float) -> None:
    """After a loss, the odometry goes on from the last pose with which the landmarks agreed."""
    parts, before = vio._parts, vio._state
    assert isinstance(before.phase, Tracking)
    estimated = before.phase.smoother.state
    innovation_px = share * parts.config.health.max_innovation_px
    known = Assessment(landmarks=50, innovation_px=innovation_px)
    after = publish(parts, before, replace(before.phase, limits=None), next_packet(vio), estimated, known)
    if share > 1.0:
        assert after.gauge is before.gauge
    else:
        assert isinstance(after.gauge, LastPublished) and after.gauge.published is after.estimate.state


def test_another_time_offset_withdraws_the_causes(vio: VisualInertialOdometry) -> None:
    """They were those of the offset before; the next state is not held to be inconsistent for them."""
    parts, packet = vio._parts, next_packet(vio)
    for k in range(2):
        at = replace(packet, t_ns=packet.t_ns + k * MIN_CAUSE_NS)
        parts.publisher.not_initialized(at, NotObservable("the landmarks disagree", Cause.MOTION_DISAGREES))
    stated = [parts.publisher.has_stated_cause]
    before_s, offset = (
        vio.time_offset_s,
        RotationOffset(0.05, 0.001, explained=1.0, ambiguity=0.1, gain=9.0, is_inside=True),
    )
    state = with_offset(parts, vio._state, packet, offset)
    assert isinstance(state.phase, Initializing) and state.phase.is_consistent
    assert [*stated, parts.publisher.has_stated_cause] == [True, False]
    assert vio.time_offset_s == pytest.approx(before_s + 0.05, abs=1e-12)
    assert state.estimate.events[-1].startswith("time offset")


class CorrectsGravity:
    """A calibrator that corrects gravity with each keyframe; all else is that of another one."""

    def __init__(self, calibrator: Any) -> None:
        self._calibrator, self.gravity_m_s2 = calibrator, 9.7

    def __getattr__(self, name: str) -> Any:
        return getattr(self._calibrator, name)

    def add_keyframe(self, smoother: KeyframeSmoother, *_: Any, **__: Any) -> Correction:
        return Correction(smoother, True, False, ())


def test_a_correction_of_gravity_is_used_at_once(make_flight: Callable[..., "SyntheticFlight"]) -> None:
    """By the preintegration and between frames."""
    flight = make_flight(0, rest_s=1.0, duration_s=4.0)
    vio, feed = VisualInertialOdometry(flight.rig, front_end=flight.front_end()), iter(measurements(flight))
    push(vio, feed, frames=50)
    calibrator: Any = CorrectsGravity(vio._parts.calibrator)
    vio._parts = replace(vio._parts, calibrator=calibrator)
    push(vio, feed, frames=20)
    assert vio.imu_noise.gravity_m_s2 == vio._parts.imu_rate._params.gravity_m_s2 == calibrator.gravity_m_s2


def test_changes_of_biases_by_a_correction_are_no_random_walk(
    make_flight: Callable[..., "SyntheticFlight"], monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, are_corrected = make_flight(0, rest_s=1.0, duration_s=4.0), list[bool]()
    vio, feed = VisualInertialOdometry(flight.rig, front_end=flight.front_end()), iter(measurements(flight))

    def add_biases(_: ImuNoiseEstimator, state: NavState, **known: bool) -> None:
        are_corrected.append(known["are_corrected"])

    monkeypatch.setattr(ImuNoiseEstimator, "add_biases", add_biases)
    push(vio, feed, frames=50)
    keyframes, calibrator = len(are_corrected), cast(Any, CorrectsGravity(vio._parts.calibrator))
    vio._parts = replace(vio._parts, calibrator=calibrator)
    push(vio, feed, frames=20)
    assert not any(are_corrected[:keyframes]) and all(are_corrected[keyframes:])
    assert 0 < keyframes < len(are_corrected)


def test_frames_are_compared_with_what_is_known_of_the_calibration(vio: VisualInertialOdometry) -> None:
    phase, sigmas = vio._state.phase, vio._parts.calibrator.sigmas
    assert isinstance(phase, Tracking) and phase.monitor._reference is not None
    assert phase.monitor._reference.calibration == sigmas and min(sigmas.rotation_rad, sigmas.focal) > 0.0


@pytest.mark.parametrize(("rest_s", "expected"), [(1.0, 0), (-5.0, 1)])
def test_starts_in_motion_take_the_noise_that_the_samples_show(
    make_flight: Callable[..., "SyntheticFlight"], monkeypatch: pytest.MonkeyPatch, rest_s: float, expected: int
) -> None:
    taken: list[ImuNoiseEstimator] = []

    def counted(noise: ImuNoiseEstimator) -> None:
        taken.append(noise)

    monkeypatch.setattr(ImuNoiseEstimator, "begin_in_motion", counted)
    flight = make_flight(0, rest_s=rest_s, duration_s=3.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    push(vio, iter(measurements(flight)), len(flight.frame_times_ns))
    assert isinstance(vio._state.phase, Tracking) and min(len(taken), 1) == expected


@pytest.mark.parametrize("corrects_displacement", [False, True])
def test_a_correction_does_not_make_the_position_more_certain(
    short_flight: "SyntheticFlight", corrects_displacement: bool
) -> None:
    """The focal length is known to 5 % before it, and exactly after it; what it has made of the way remains."""
    vio, feed = VisualInertialOdometry(short_flight.rig, front_end=short_flight.front_end()), measurements(short_flight)
    push(vio, feed, frames=50)
    assert isinstance(vio._state.phase, Tracking)
    given = vio._state.phase.origin

    class Corrected:
        """A calibrator that corrects the focal length with the next keyframe; all else is that of another one."""

        def __init__(self, calibrator: Any) -> None:
            self._calibrator, self.sigmas = calibrator, CalibrationSigmas(focal=0.05)

        def __getattr__(self, name: str) -> Any:
            return getattr(self._calibrator, name)

        def add_keyframe(self, smoother: KeyframeSmoother, *_: Any, **__: Any) -> Correction:
            self.sigmas = CalibrationSigmas()
            return Correction(smoother, True, corrects_displacement, ())

    calibrator: Any = Corrected(vio._parts.calibrator)
    vio._parts = replace(vio._parts, calibrator=calibrator)
    push(vio, feed, frames=20)
    assert isinstance(vio._state.phase, Tracking)
    origin = vio._state.phase.origin
    if corrects_displacement:
        assert origin is given
    else:
        way_m = np.linalg.norm(origin.position_m - given.position_m)
        largest_m = np.sqrt(np.linalg.eigvalsh(origin.covariance)[-1])
        assert way_m > 0.1 and 0.01 * way_m < largest_m < 0.06 * way_m


def test_frames_of_another_place_are_discarded_when_features_connect_again(vio: VisualInertialOdometry) -> None:
    """Long after a disconnection without a loss, the frames collected since must not begin an initialization."""
    state, parts = vio._state, vio._parts
    assert isinstance(state.phase, Tracking) and not state.phase.monitor.is_disconnected(state.estimate.t_ns)
    collected = replace(state.phase, restart=parts.initializer(parts.origin))
    packet = next_packet(vio)
    after = vio._track(replace(state, phase=collected), collected, packet, CameraFrame(packet.t_ns, (NO_IMAGE,)))
    assert isinstance(after.phase, Tracking) and after.phase.restart is None


class ScriptedFrontEnd:
    """Tracks features whose identities are given for each frame."""

    def __init__(self, ids: list[range]) -> None:
        self._ids = iter(ids)

    def track(self, *_: Any, **__: Any) -> Observations:
        ids = np.array(next(self._ids), np.int64)
        return Observations(ids, np.zeros((len(ids), 2)), np.zeros((len(ids), 2)), np.ones(len(ids), np.int64))

    def replenish(self, *_: Any, **__: Any) -> Observations:
        return NO_FEATURES

    def discard(self, ids: Any) -> None:
        pass


@pytest.mark.parametrize("missing", [0, 1, 3])
def test_images_of_another_place_are_noticed_after_missing_ones(missing: int) -> None:
    """A frame without an image tells nothing of how many features were tracked before."""
    rig = euroc_rig()
    model = rig.cameras[0].model
    front_end = ScriptedFrontEnd([range(50), range(50), *[range(0)] * missing, range(100, 150)])
    pipeline = MeasurementPipeline(rig, VioConfig(), front_end)
    t_ns = np.arange(0, 10**9, 5_000_000, dtype=np.int64)
    pipeline.add_imu(ImuSamples(t_ns, np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, 9.81], (len(t_ns), 1))))
    calibration = VisualInertialOdometry(rig)._parts.calibration
    bias = VisualInertialOdometry(rig)._parts.origin.gyro_bias
    images, connected = [True, True, *[False] * missing, True], []
    for k, has_image in enumerate(images):
        image = np.full((model.height, model.width), k, np.uint8) if has_image else NO_IMAGE
        packet = pipeline.process(CameraFrame(k * FRAME_NS, (image,)), calibration, bias)
        assert packet.has_image is has_image
        connected += [pipeline.is_connected(packet)] if has_image else []
    assert connected == [True, True, False]


@pytest.mark.parametrize("searches", [True, False])
def test_before_the_first_state_the_initializer_decides_on_a_search_for_the_offset(searches: bool) -> None:
    initializer: Any = SimpleNamespace(is_contradicted=True, searches_offset=searches)
    assert Initializing(initializer).searches_offset is searches
