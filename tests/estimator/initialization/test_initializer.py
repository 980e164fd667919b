"""The initializer: when a window of frame packets yields a smoother, on synthetic flights."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.keyframes import KeyframeConfig, KeyframePolicy
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.imu.noise import ImuNoiseEstimator, NoiseEstimationConfig
from dronevio.estimator.imu.preintegration import PreintegrationConfig
from dronevio.estimator.initialization import initializer as module
from dronevio.estimator.initialization.dynamic import dynamic_start
from dronevio.estimator.initialization.gauge import Gauge, LastPublished, WorldOrigin
from dronevio.estimator.initialization.initializer import Initializer, InitializerConfig
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.initialization.views import collect_tracks
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.types import NO_FEATURES, Calibration, FramePacket, Matches, Observations
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import inverse_pose
from tests.estimator.initialization.test_dynamic import DISTANT

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]
FRAME_S = 0.05
LIVELY = {
    "angles_rad": np.array([[0.45, 0.075], [0.1, 0.06], [0.1, 0.06]]),
    "angle_rates": np.array([[0.5, 5.0], [3.1, 7.0], [2.9, 6.3]]),
}
"""Rotations of a small vehicle or of a hand-held camera."""
CONFIG = InitializerConfig()


@pytest.fixture(scope="module")
def stationary_flight(make_flight: Callable[..., "SyntheticFlight"]) -> "SyntheticFlight":
    """A flight whose drone does not move for its whole duration."""
    return make_flight(3, rest_s=5.0, duration_s=2.0)


def packets_of(flight: "SyntheticFlight", count: int) -> list[FramePacket]:
    """Return the first packets of a flight; each of them has features, all but the first have IMU increments."""
    front_end, buffer, packets = flight.front_end(), ImuBuffer(), []
    buffer.add(flight.imu)
    for index in range(count):
        t_ns = int(flight.frame_times_ns[index])
        increments = buffer.take_until(t_ns)
        front_end.track(flight.frame(index), np.eye(3))
        packets.append(FramePacket(t_ns, increments, front_end.replenish()))
    return packets


def initializer_at(gauge: Gauge, config: InitializerConfig = CONFIG) -> Initializer:
    """Return an initializer without frames."""
    return Initializer(config, SmootherConfig(), LandmarkConfig(), KeyframePolicy(KeyframeConfig()), gauge)


def noise_of(flight: "SyntheticFlight") -> ImuNoiseEstimator:
    """Return an estimator of the noise of a flight's IMU, which begins with the data sheet."""
    return ImuNoiseEstimator(flight.rig.imu, PreintegrationConfig(), NoiseEstimationConfig())


def add(
    initializer: Initializer, flight: "SyntheticFlight", packet: FramePacket, stationary_s: float, gauge: Gauge
) -> KeyframeSmoother | NotObservable:
    """Add a packet with the calibration and the noise of a flight's rig."""
    return initializer.add(packet, stationary_s, Calibration(flight.rig), gauge, noise_of(flight))


def matched(packet: FramePacket, flight: "SyntheticFlight", rig: Rig) -> FramePacket:
    """Return a packet of a flight with the exact matches in the second camera of a rig."""
    observations = packet.observations
    T_cam_world = inverse_pose(flight.state_at(packet.t_ns).T_world_imu @ rig.cameras[1].T_imu_cam)
    points = flight.landmarks[observations.ids] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    matches = Matches(observations.ids, np.ones(len(observations), np.int64), points[:, :2] / points[:, 2:])
    return replace(packet, observations=replace(observations, matches=matches))


def test_first_packet_after_a_loss_at_rest_is_not_enough(stationary_flight: "SyntheticFlight") -> None:
    """The zero-velocity detector continues after a loss, so that it reports a stationary time at the first packet."""
    packets = packets_of(stationary_flight, 8)
    gauge = LastPublished.of(stationary_flight.state_at(packets[0].t_ns))
    initializer = initializer_at(gauge)
    for index, packet in enumerate(packets[5:]):
        result = add(initializer, stationary_flight, packet, 2.0 + FRAME_S * index, gauge)
        assert isinstance(result, NotObservable)
        expected = "stationary for" if index else "one frame since the start of the initialization"
        assert result.reason.startswith(expected)
        if index == 0:  # one packet has no increments of the window, so that the bias stays that of the gauge
            np.testing.assert_array_equal(initializer.gyro_bias.mean, gauge.gyro_bias.mean)
            assert initializer.gyro_bias.sigma == gauge.gyro_bias.sigma


@pytest.mark.parametrize("stationary_before_s", [0.0, 2.0], ids=["first start", "after a loss"])
def test_static_window_yields_a_smoother(stationary_flight: "SyntheticFlight", stationary_before_s: float) -> None:
    """The window must be full, however long the drone has been stationary before its first packet."""
    gauge = WorldOrigin(gyro_bias_sigma_rad_s=0.05, accel_bias_sigma_m_s2=0.1)
    initializer, last = initializer_at(gauge), round(CONFIG.static_window_s / FRAME_S)
    packets = packets_of(stationary_flight, last + 1)
    results = [
        add(initializer, stationary_flight, packet, stationary_before_s + FRAME_S * index, gauge)
        for index, packet in enumerate(packets)
    ]
    assert all(isinstance(result, NotObservable) for result in results[:last])
    smoother = results[last]
    assert isinstance(smoother, KeyframeSmoother)
    assert smoother.state.t_ns == packets[last].t_ns
    truth = stationary_flight.state_at(packets[last].t_ns)
    np.testing.assert_allclose(smoother.state.velocity_m_s, np.zeros(3), atol=0.01)
    np.testing.assert_allclose(smoother.state.T_world_imu[:3, 3], np.zeros(3), atol=0.01)
    np.testing.assert_allclose(smoother.state.gyro_bias_rad_s, truth.gyro_bias_rad_s, atol=2e-3)


@pytest.mark.parametrize(("scale", "plausible"), [(1.0, True), (1.0 / GRAVITY_M_S2, False), (2.6, False), (2.4, True)])
def test_accelerometer_in_other_units_is_refused(
    stationary_flight: "SyntheticFlight", scale: float, plausible: bool
) -> None:
    gauge = WorldOrigin(gyro_bias_sigma_rad_s=0.05, accel_bias_sigma_m_s2=0.1)
    initializer, result = initializer_at(gauge), None
    for index, packet in enumerate(packets_of(stationary_flight, round(CONFIG.static_window_s / FRAME_S) + 1)):
        increments = replace(packet.increments, accel_m_s2=scale * packet.increments.accel_m_s2)
        result = add(initializer, stationary_flight, replace(packet, increments=increments), FRAME_S * index, gauge)
    if plausible:
        assert not isinstance(result, NotObservable) or not result.cause
    else:
        assert isinstance(result, NotObservable) and result.cause == Cause.FORCE_IS_NOT_GRAVITY
        assert "m/s², where about 9.81 is expected" in result.reason


@pytest.mark.parametrize("every", [3, 4, 5])
def test_two_cameras_at_rest_have_landmarks_from_the_start(stationary_flight: "SyntheticFlight", every: int) -> None:
    """The keyframes are the frames with matches, wherever these are in the window; without any, position is unknown."""
    rig, gauge = rig_named("euroc-stereo"), WorldOrigin(gyro_bias_sigma_rad_s=0.05, accel_bias_sigma_m_s2=0.1)
    packets = packets_of(stationary_flight, round(CONFIG.static_window_s / FRAME_S) + 1)

    def landmarks_and_sigma_m(given: list[FramePacket]) -> tuple[int, float]:
        initializer, result = initializer_at(gauge), None
        for index, packet in enumerate(given):
            calibration, noise = Calibration(rig), noise_of(stationary_flight)
            result = initializer.add(packet, FRAME_S * index, calibration, gauge, noise)
        assert isinstance(result, KeyframeSmoother) and result.state.covariance is not None
        sigma_m = float(np.sqrt(np.diag(result.state.covariance)[3:6].max()))
        return len(result.triangulated_landmarks.ids), sigma_m

    seen = [matched(p, stationary_flight, rig) if i % every == 1 else p for i, p in enumerate(packets)]
    landmarks, sigma_m = landmarks_and_sigma_m(seen)
    assert landmarks > 30 and sigma_m < 1e-3
    assert landmarks_and_sigma_m(packets)[1] > 2e-3


def test_noise_at_rest_is_used_from_the_start(make_flight: Callable[..., "SyntheticFlight"]) -> None:
    """An initialization at rest raises the noise to that of its window."""
    flight = make_flight(3, rest_s=5.0, duration_s=2.0, imu_noise=10.0)
    gauge, noise = WorldOrigin(gyro_bias_sigma_rad_s=0.05, accel_bias_sigma_m_s2=0.1), noise_of(flight)
    initializer, last = initializer_at(gauge), round(CONFIG.static_window_s / FRAME_S)
    sheet = np.array([flight.rig.imu.gyro_noise_density, flight.rig.imu.accel_noise_density])
    for index, packet in enumerate(packets_of(flight, last + 1)):
        assert noise.densities / sheet == pytest.approx([2.0, 5.0])
        initializer.add(packet, FRAME_S * index, Calibration(flight.rig), gauge, noise)
    assert noise.densities / sheet == pytest.approx([10.0, 10.0], rel=0.3)


def test_window_grows_until_the_scale_is_observable(make_flight: Callable[..., "SyntheticFlight"]) -> None:
    """Far from all landmarks, 1.5 s of a gentle flight do not show its scale, wherever they begin."""
    flight = make_flight(0, rest_s=-5.0, duration_s=3.5, pixel_noise=0.15, max_features=150, motion=DISTANT)
    flight = replace(flight, landmarks=3.0 * flight.landmarks)
    gauge = WorldOrigin(gyro_bias_sigma_rad_s=0.05, accel_bias_sigma_m_s2=0.1)
    packets = packets_of(flight, round(CONFIG.dynamic.max_window_s / FRAME_S) + 1)

    def start_s(max_window_s: float) -> float:
        dynamic = replace(CONFIG.dynamic, max_window_s=max_window_s)
        initializer = initializer_at(gauge, replace(CONFIG, dynamic=dynamic))
        results = (add(initializer, flight, packet, 0.0, gauge) for packet in packets)
        return FRAME_S * next((i for i, each in enumerate(results) if isinstance(each, KeyframeSmoother)), np.inf)

    assert CONFIG.dynamic.window_s + 0.2 < start_s(CONFIG.dynamic.max_window_s) < start_s(CONFIG.dynamic.window_s)


def test_frames_can_be_collected_before_an_attempt(make_flight: Callable[..., "SyntheticFlight"]) -> None:
    flight, gauge = make_flight(0, rest_s=-5.0, duration_s=2.0), WorldOrigin(0.05, 0.1)
    initializer, packets = initializer_at(gauge), packets_of(flight, round(CONFIG.dynamic.window_s / FRAME_S) + 1)
    for packet in packets[:-1]:
        initializer.collect(packet)
    assert isinstance(add(initializer, flight, packets[-1], 0.0, gauge), KeyframeSmoother)


def packets_at(t_s: npt.ArrayLike, t0_ns: int = 10**18) -> list[FramePacket]:
    """Return packets without features at some times [s], with the IMU of a vehicle at rest."""
    t_ns = t0_ns + np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    packets = []
    for before_ns, now_ns in zip([t_ns[0], *t_ns[:-1]], t_ns, strict=True):
        dt_s = np.full(4, (now_ns - before_ns) * 0.25e-9)
        increments = Increments(dt_s, np.zeros((4, 3)), np.tile([0.0, 0.0, GRAVITY_M_S2], (4, 1)))
        packets.append(FramePacket(int(now_ns), increments, NO_FEATURES))
    return packets


@pytest.mark.parametrize("jitter_s", [0.0, 1e-4, 3e-3])
@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 7.3, 10.0, 12.5, 15.0, 24.0, 25.0, 29.97, 30.0, 60.0, 200.0])
def test_window_spans_its_time_at_any_frame_rate(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch, rate_hz: float, jitter_s: float
) -> None:
    """The first attempt is at the first frame at which there are images for that time, and by no frame more."""
    gauge, windows, flight = WorldOrigin(0.05, 0.1), [], make_flight(0)
    t_s = np.arange(0.0, 3.5, 1.0 / rate_hz)
    t_s = t_s + min(jitter_s, 0.3 / rate_hz) * np.random.default_rng(0).uniform(-1.0, 1.0, len(t_s))

    def attempted(window: Sequence[FramePacket], *_: object, **__: object) -> NotObservable:
        windows.append(window)
        return NotObservable("nothing but the window counts")

    monkeypatch.setattr(module, "observed_rotation", attempted)
    initializer, needed_s, waited = initializer_at(gauge), CONFIG.dynamic.window_s, []
    for packet in packets_at(t_s):
        result = add(initializer, flight, packet, 0.0, gauge)
        assert isinstance(result, NotObservable)
        waited += [] if windows else [result.reason]
    spans_s = [(window[-1].t_ns - window[0].t_ns) * 1e-9 for window in windows]
    assert windows[0][-1].t_ns == 10**18 + round(t_s[np.argmax(t_s - t_s[0] >= needed_s - 1e-3)] * 1e9)
    assert needed_s - 1e-3 <= spans_s[0] <= needed_s + 2.0 / rate_hz
    assert all(needed_s - 1e-3 <= span_s <= CONFIG.dynamic.max_window_s + 2.0 / rate_hz for span_s in spans_s)
    assert all(f"{needed_s:.2f} s of images" not in reason and "in motion 1.5 s" in reason for reason in waited)


def test_rest_between_two_frames_is_no_rest(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a high frame rate, a slow motion moves the image by less than the threshold from one frame to the next."""
    gauge, attempts, flight = WorldOrigin(0.05, 0.1), [], make_flight(0)

    def attempted(window: Sequence[FramePacket], *_: object, **__: object) -> NotObservable:
        attempts.append(window)
        return NotObservable("a reason in motion")

    monkeypatch.setattr(module, "observed_rotation", attempted)
    initializer, result = initializer_at(gauge), None
    for index, packet in enumerate(packets_at(np.arange(0.0, 2.0, 1.0 / 60.0))):
        result = add(initializer, flight, packet, (index % 3) / 60.0, gauge)
    assert attempts and isinstance(result, NotObservable) and result.reason == "a reason in motion"
    np.testing.assert_array_equal(initializer.gyro_bias.mean, gauge.gyro_bias.mean)  # not the rotation of two frames
    assert initializer.gyro_bias.sigma == gauge.gyro_bias.sigma


def seen_by_both(packet: FramePacket, flight: "SyntheticFlight", rig: Rig) -> FramePacket:
    """Return a packet in motion, where identities are not those of landmarks, with matches in the second camera."""
    T_world_imu, seen = flight.state_at(packet.t_ns).T_world_imu, packet.observations
    first, second = (
        flight.landmarks @ T[:3, :3].T + T[:3, 3]
        for T in (inverse_pose(T_world_imu @ camera.T_imu_cam) for camera in rig.cameras)
    )
    xy = np.where(first[:, 2:] > 0.1, first[:, :2] / first[:, 2:], np.inf)
    landmark = np.linalg.norm(seen.xy[:, None] - xy, axis=-1).argmin(axis=1)
    matches = Matches(seen.ids, np.ones(len(seen), np.int64), second[landmark, :2] / second[landmark, 2:])
    return replace(packet, observations=replace(seen, matches=matches))


def restamped(packets: Sequence[FramePacket], flight: "SyntheticFlight", offset_s: float) -> list[FramePacket]:
    """Return packets of a flight whose frames are stamped so that t_imu = t_cam + offset."""
    buffer, later = ImuBuffer(), []
    buffer.add(flight.imu)
    for packet in packets:
        t_ns = packet.t_ns - round(1e9 * offset_s)
        later.append(replace(packet, t_ns=t_ns, increments=buffer.take_until(t_ns)))
    return later


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("offset_s", [0.0, 0.004, -0.004, 0.015, -0.015])
def test_a_start_of_two_cameras_tells_another_time_offset(make_flight: MakeFlight, offset_s: float, every: int) -> None:
    """At 20 and 10 Hz it waits for the time of a search for the offset; a small offset does not delay it."""
    flight = make_flight(0, rest_s=-5.0, duration_s=5.0, motion=LIVELY)
    rig, gauge = rig_named("euroc-stereo"), WorldOrigin(0.05, 0.1)
    packets = [seen_by_both(packet, flight, rig) for packet in packets_of(flight, 75)[4::every]]
    initializer, noise, refused, first_s = initializer_at(gauge), noise_of(flight), [], np.inf
    for packet in restamped(packets, flight, offset_s):
        result = initializer.add(packet, 0.0, Calibration(rig), gauge, noise)
        if isinstance(result, KeyframeSmoother):
            first_s = (packet.t_ns - packets[0].t_ns) * 1e-9 + offset_s
            break
        refused += [result] if result.cause else []
    if abs(offset_s) < 0.01:
        assert first_s == pytest.approx(CONFIG.dynamic.stereo_window_s)
        return
    latest_s = CONFIG.longest_window_s + CONFIG.dynamic.attempt_interval_s + FRAME_S
    assert CONFIG.longest_window_s - FRAME_S <= first_s <= latest_s + 1e-9
    assert refused[0].cause == Cause.CLOCKS_DISAGREE and initializer.is_contradicted  # so that the search begins
    found = re.search(r"([+-]\d+) ± \d+ ms", refused[0].reason)
    assert found is not None and abs(float(found[1]) - 1e3 * offset_s) <= 2.0


def failing_attempts(
    flight: "SyntheticFlight", packets: list[FramePacket], monkeypatch: pytest.MonkeyPatch
) -> tuple[list[tuple[int, float]], list[int], list[int]]:
    """Return first frames of attempts with the time that they span [s], second frames, and those of offset searches."""
    gauge, begins, ends, searches = WorldOrigin(0.05, 0.1), list[tuple[int, float]](), list[int](), list[int]()
    initializer, noise = initializer_at(gauge), noise_of(flight)

    def observed(window: Sequence[FramePacket], *_: object) -> Any:
        begins.append((index, (window[-1].t_ns - window[0].t_ns) * 1e-9))
        return "a rotation"

    def failed(*_: object) -> NotObservable:
        ends.append(index)
        return NotObservable("nothing fits", Cause.CLOCKS_DISAGREE)

    monkeypatch.setattr(module, "observed_rotation", observed)
    monkeypatch.setattr(module, "dynamic_start", failed)
    for index, packet in enumerate(packets):
        initializer.add(packet, 0.0, Calibration(flight.rig), gauge, noise)
        searches += [index] if initializer.searches_offset else []
    return begins, ends, searches


def test_attempts_are_divided_and_become_rarer(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen that fail, each with both windows, then a quarter as many with one, over two frames but for the first.

    The time offset is searched at other frames than the second one of an attempt.
    """
    flight = make_flight(0, rest_s=-5.0, duration_s=14.0)
    begins, ends, searches = failing_attempts(flight, packets_of(flight, 270), monkeypatch)
    # The first attempt has no longer window yet; that of the last one is late
    every, first = round(CONFIG.dynamic.attempt_interval_s / FRAME_S), begins[0][0]
    early = [first + every * k + again for k in range(1, module.EARLY_ATTEMPTS) for again in (0, 2)]
    assert [k for k, _ in begins[: len(early) + 1]] == [first, *early]
    late = begins[len(early) + 1 :]
    late_every = round(module.LATE_INTERVAL_RATIO * every)
    assert late[0][0] == early[-2] + late_every and len(late) > 5
    np.testing.assert_array_equal(np.diff([k for k, _ in late]), late_every)
    assert ends == [first, *(k + 1 for k, _ in begins[1:])]
    assert searches == [k for k in range(first, 270) if k not in ends[1:]]
    spans_s = CONFIG.dynamic.max_window_s, CONFIG.dynamic.window_s
    assert [span_s for _, span_s in late] == pytest.approx([spans_s[k % 2] for k in range(1, len(late) + 1)])


def test_attempts_take_one_frame_each_if_frames_are_rare(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 10 Hz, two windows over two frames each would leave no frame for a search of the offset."""
    flight = make_flight(0, rest_s=-5.0, duration_s=5.0)
    buffer = ImuBuffer()
    buffer.add(flight.imu)
    packets = [replace(p, increments=buffer.take_until(p.t_ns)) for p in packets_of(flight, 90)[::2]]
    begins, ends, searches = failing_attempts(flight, packets, monkeypatch)
    assert [k for k, _ in begins] == ends and len(ends) > 10
    assert searches == list(range(ends[0], len(packets)))


def test_a_late_attempt_starts_at_its_second_frame(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    """The window of the first frame and the second frame are adjusted together; a frame without image is bridged."""
    flight, gauge = make_flight(0, rest_s=-5.0, duration_s=3.0), WorldOrigin(0.05, 0.1)
    monkeypatch.setattr(module, "EARLY_ATTEMPTS", 0)
    initializer, packets = initializer_at(gauge), packets_of(flight, 34)
    results = [add(initializer, flight, packet, 0.0, gauge) for packet in packets[:31]]
    assert all(isinstance(result, NotObservable) for result in results)
    missing = replace(packets[31], observations=NO_FEATURES, has_image=False)
    assert isinstance(add(initializer, flight, missing, 0.0, gauge), NotObservable)
    smoother = add(initializer, flight, packets[32], 0.0, gauge)
    assert isinstance(smoother, KeyframeSmoother) and smoother.state.t_ns == packets[32].t_ns
    truth = flight.state_at(packets[32].t_ns)
    R, R_true = smoother.state.T_world_imu[:3, :3], truth.T_world_imu[:3, :3]
    np.testing.assert_allclose(R.T @ smoother.state.velocity_m_s, R_true.T @ truth.velocity_m_s, atol=0.15)


def test_no_features_are_detected_at_the_second_frame_of_an_attempt(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are every fourth frame, or where there are few; the first attempt is at frame 30."""
    flight, gauge, due = make_flight(0, rest_s=-5.0, duration_s=3.0), WorldOrigin(0.05, 0.1), list[int]()
    monkeypatch.setattr(module, "EARLY_ATTEMPTS", 0)
    monkeypatch.setattr(module, "MIN_FEATURES", 20)
    initializer, packets = initializer_at(gauge), packets_of(flight, 32)
    for k, packet in enumerate(packets):
        due += [k] if k > 2 and initializer.needs_features(packet) else []
        if k < 31:
            add(initializer, flight, packet, 0.0, gauge)
    assert due == [3, 7, 11, 15, 19, 23, 27]
    few = packets[31].observations.without(packets[31].observations.ids[10:])
    assert initializer.needs_features(replace(packets[31], observations=few))


def test_at_rest_a_late_attempt_is_given_up(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    flight, gauge = make_flight(0, rest_s=-5.0, duration_s=3.0), WorldOrigin(0.05, 0.1)
    monkeypatch.setattr(module, "EARLY_ATTEMPTS", 0)
    initializer, packets = initializer_at(gauge), packets_of(flight, 34)
    for packet in packets[:31]:
        add(initializer, flight, packet, 0.0, gauge)
    monkeypatch.setattr(module, "dynamic_start", lambda *_: pytest.fail("the second half of the attempt"))
    result = add(initializer, flight, packets[31], 0.3, gauge)
    assert isinstance(result, NotObservable) and "stationary" in result.reason


def test_reason_without_any_image(make_flight: MakeFlight) -> None:
    gauge, flight = WorldOrigin(0.05, 0.1), make_flight(0)
    initializer = initializer_at(gauge)
    for packet in packets_at([0.0, 0.05]):
        result = add(initializer, flight, replace(packet, has_image=False), 0.0, gauge)
        assert isinstance(result, NotObservable) and result.reason == "no images so far"


@pytest.mark.parametrize("count", [2, 9, 16, 17, 20, 31, 38, 46, 91])
def test_used_frames_spread_over_the_window(count: int) -> None:
    """Whatever the number of frames is, the first and the last are used, and the intervals differ by one frame."""
    ids, xy = np.arange(30), np.zeros((30, 2))
    seen = Observations(ids, xy, xy, np.ones(30, np.int64))
    packets = [replace(packet, observations=seen) for packet in packets_at(np.arange(count) / 30.0)]
    frames = collect_tracks(packets, 16, 6).frame
    steps = np.diff(frames)
    assert len(frames) == min(count, 16) and (frames[0], frames[-1]) == (0, count - 1)
    assert steps.min() >= 1 and steps.max() - steps.min() <= 1


def test_landmarks_of_one_frame_are_not_used() -> None:
    """A window of three frames, as at a low rate: one observation determines neither a landmark nor the motion."""
    packets = []
    for packet, ids in zip(packets_at([0.0, 0.25, 0.5]), ([0, 1, 2], [1, 2], [2, 3]), strict=True):
        xy = np.zeros((len(ids), 2))
        observations = Observations(np.array(ids), xy, xy, np.ones(len(ids), np.int64))
        packets.append(replace(packet, observations=observations))
    assert collect_tracks(packets, 16, 6).ids.tolist() == [1, 2]


@pytest.mark.parametrize("imu_noise", [1.0, 30.0])
def test_noise_is_not_taken_for_an_accelerometer_bias(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch, imu_noise: float
) -> None:
    """Once residuals show more noise, the start is repeated with a bias that is hardly free."""
    flight, priors, biases = make_flight(2, rest_s=-5.0, duration_s=2.0, imu_noise=imu_noise), [], []

    def recorded(*arguments: Any) -> Any:
        start = dynamic_start(*arguments)
        if not isinstance(start, NotObservable):
            priors.append(arguments[4])
            biases.append(float(np.linalg.norm(start.state.accel_bias_m_s2)))
        return start

    monkeypatch.setattr(module, "dynamic_start", recorded)
    gauge, noise = WorldOrigin(gyro_bias_sigma_rad_s=0.05, accel_bias_sigma_m_s2=0.1), noise_of(flight)
    noise.add_imu(flight.imu)
    initializer = initializer_at(gauge)
    results = [initializer.add(packet, 0.0, Calibration(flight.rig), gauge, noise) for packet in packets_of(flight, 31)]
    assert isinstance(results[-1], KeyframeSmoother)
    assert priors[0].sigma == 0.1
    assert (len(priors) > 1) is (imu_noise > 1.0)
    for prior, bias in zip(priors[1:], biases[1:], strict=True):
        assert prior.sigma == module.NOISY_ACCEL_BIAS_SIGMA_M_S2
        assert bias < 0.5 * biases[0]
