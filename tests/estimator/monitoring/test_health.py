"""The health monitor: what constrains an estimate, and when it is lost."""

from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.landmarks import TriangulatedLandmarks
from dronevio.estimator.backend.reprojection import MEDIAN_CHI2_2DOF
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.monitoring.health import health_report
from dronevio.estimator.monitoring.monitor import IMAGE_VARIANCES, HealthMonitor
from dronevio.estimator.types import NO_FEATURES, Calibration, CalibrationSigmas, Observations
from dronevio.models.arrays import Array
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import Health, HealthReport, NavState

RIG = rig_named("euroc-stereo")
SIGMA_PX = 0.8
STEP_NS = 50_000_000
ZEROS = np.zeros(40, np.int64)
CONFIG = HealthConfig()
DENSITIES = RIG.imu.gyro_noise_density, RIG.imu.accel_noise_density
START = NavState(
    10**18,
    pose_matrix(exp_so3(np.array([0.1, -0.3, 0.8])), np.array([1.0, -2.0, 0.5])),
    np.array([0.4, 0.1, 0.0]),
    np.full(3, 0.01),
    np.full(3, 0.02),
    np.diag(np.repeat([1e-6, 1e-4, 1e-4, 1e-8, 1e-6], 3)),
)


def landmarks(n: int, rng: np.random.Generator) -> TriangulatedLandmarks:
    """Return n landmarks in front of the first camera at the start."""
    depth = rng.uniform(2.0, 8.0, (n, 1))
    in_cam = np.hstack([rng.uniform(-0.5, 0.5, (n, 2)) * depth, depth])
    T_world_cam = START.T_world_imu @ RIG.cameras[0].T_imu_cam
    points = in_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return TriangulatedLandmarks(7 + 2 * np.arange(n), points, np.linspace(0.01, 0.05, n))


def observe(
    triangulated: TriangulatedLandmarks, state: NavState, cameras: npt.NDArray[np.int64], errors_px: Array
) -> Observations:
    """Return the observations of N landmarks from a state, each by one of the rig's cameras (N,).

    The errors of the observations are (N, 2), or (2,) for all of them [px].
    """
    Ts_cam_world = inverse_pose(state.T_world_imu @ np.stack([c.T_imu_cam for c in RIG.cameras]))[cameras]
    p = np.einsum("nij,nj->ni", Ts_cam_world[:, :3, :3], triangulated.points) + Ts_cam_world[:, :3, 3]
    focal = np.array([c.model.fx for c in RIG.cameras])[cameras]
    xy = p[:, :2] / p[:, 2:] + errors_px / focal[:, None]
    return Observations(triangulated.ids, xy, xy, np.ones(len(xy), np.int64), cameras)


def monitor_of(triangulated: TriangulatedLandmarks, config: HealthConfig = CONFIG, **settings: Any) -> HealthMonitor:
    """Return a health monitor whose keyframe is the start."""
    monitor = HealthMonitor(RIG.imu, config, SIGMA_PX, **settings)
    monitor.set_reference(START, triangulated, None, DENSITIES)
    return monitor


def assess(
    monitor: HealthMonitor, observations: Observations, predicted: NavState, stationary: bool = False
) -> HealthReport:
    return health_report(monitor.assess(observations, predicted, stationary, Calibration(RIG)), CONFIG)


def state_after(frames: int, **changes: Any) -> NavState:
    """Return the start, at the time of a later frame, with some fields changed."""
    return replace(START, t_ns=START.t_ns + frames * STEP_NS, **changes)


def landmarks_and_observations(n: int, error_px: float = 0.0) -> tuple[TriangulatedLandmarks, Observations]:
    """Return n landmarks and their observations from the start, with a horizontal error [px]."""
    triangulated = landmarks(n, np.random.default_rng(1))
    return triangulated, observe(triangulated, START, np.zeros(n, np.int64), np.array([error_px, 0.0]))


def test_report_describes_landmarks_and_uncertainty() -> None:
    triangulated, observations = landmarks_and_observations(40, error_px=0.5)
    report = assess(monitor_of(triangulated), observations, START)
    assert report.health == Health.TRACKING and report.reason == "constrained by 40 landmarks"
    assert (report.tracks, report.landmarks) == (40, 40)
    assert report.innovation_px == pytest.approx(0.5, abs=1e-9)
    assert report.median_parallax_rad == pytest.approx(0.03, rel=0.05)
    assert report.bias_sigmas == pytest.approx(0.2)  # 0.01 of 0.05 rad/s
    assert report.position_sigma_m == pytest.approx(0.01)
    assert report.velocity_sigma_m_s == pytest.approx(0.01)
    assert report.inertial_only_s == 0.0


def test_innovation_of_consistent_noise_is_one() -> None:
    """The pose is drawn from the prediction's covariance, the pixels of both cameras from theirs."""
    rng = np.random.default_rng(3)
    triangulated = landmarks(120, rng)
    monitor = monitor_of(triangulated)
    cameras = rng.integers(0, 2, 120)
    t = 0.2
    predicted = replace(
        START,
        t_ns=START.t_ns + round(t * 1e9),
        T_world_imu=pose_matrix(
            START.T_world_imu[:3, :3],
            START.T_world_imu[:3, 3] + START.velocity_m_s * t + 0.5 * np.array([0.3, 0.0, 0.1]) * t * t,
        ),
        velocity_m_s=START.velocity_m_s + np.array([0.3, 0.0, 0.1]) * t,
    )
    P = np.zeros((6, 6))
    P[:3, :3] = 1e-8 * t**2 * np.eye(3)  # from the gyroscope bias
    P[3:, 3:] = 1e-4 * t**2 * np.eye(3)  # from the velocity
    nis = []
    for _ in range(60):
        d = rng.multivariate_normal(np.zeros(6), P)
        R, p = predicted.T_world_imu[:3, :3] @ exp_so3(d[:3]), predicted.T_world_imu[:3, 3] + d[3:]
        true = replace(predicted, T_world_imu=pose_matrix(R, p))
        observations = observe(triangulated, true, cameras, SIGMA_PX * rng.normal(size=(120, 2)))
        report = assess(monitor, observations, predicted)
        assert report.innovation_nis is not None
        nis.append(report.innovation_nis)
    assert np.mean(nis) == pytest.approx(1.0, abs=0.08)
    assert max(nis) < 3.0


def test_innovation_contains_the_uncertainty_of_the_calibration() -> None:
    """The true camera is turned in the vehicle, which turns and moves; landmarks are where the camera has seen them."""
    rng, sigma_rad = np.random.default_rng(4), 0.02
    triangulated = landmarks(120, rng)
    change = pose_matrix(exp_so3(np.array([0.02, -0.1, 0.3])), np.array([0.2, -0.3, 0.1]))
    predicted = state_after(4, T_world_imu=START.T_world_imu @ change)
    nis: dict[float, list[float]] = {0.0: [], sigma_rad: []}
    for _ in range(200):
        # What the turned camera does is what the given one would do after the motion as it is seen from there
        turn = RIG.cameras[0].T_imu_cam @ pose_matrix(exp_so3(sigma_rad * rng.normal(size=3)), np.zeros(3))
        turn = turn @ inverse_pose(RIG.cameras[0].T_imu_cam)
        true = replace(predicted, T_world_imu=START.T_world_imu @ inverse_pose(turn) @ change @ turn)
        observations = observe(triangulated, true, np.zeros(120, np.int64), SIGMA_PX * rng.normal(size=(120, 2)))
        for known_rad, values in nis.items():
            monitor = monitor_of(triangulated)
            monitor.set_reference(
                START, triangulated, None, DENSITIES, calibration=CalibrationSigmas(rotation_rad=known_rad)
            )
            values.append(assess(monitor, observations, predicted).innovation_nis or 0.0)
    assert np.mean(nis[0.0]) > 10.0
    # The error is common to all landmarks: their median is a square of two degrees of freedom, whose mean is 2
    assert np.mean(nis[sigma_rad]) == pytest.approx(2.0 / MEDIAN_CHI2_2DOF, rel=0.2)


def test_tracks_without_parallax_do_not_constrain() -> None:
    triangulated, observations = landmarks_and_observations(CONFIG.min_landmarks - 1)
    others = Observations(
        1000 + np.arange(100), np.zeros((100, 2)), np.zeros((100, 2)), np.ones(100, np.int64)
    )  # tracked, but without parallax
    both = Observations(
        np.concatenate([observations.ids, others.ids]),
        np.concatenate([observations.pixels, others.pixels]),
        np.concatenate([observations.xy, others.xy]),
        np.concatenate([observations.ages, others.ages]),
    )
    monitor = monitor_of(triangulated)
    reports = [assess(monitor, both, state_after(k)) for k in range(20)]
    settling = round(CONFIG.settling_s / 0.05) + 1
    assert {r.health for r in reports[:settling]} == {Health.TRACKING}  # they may become landmarks
    assert {r.health for r in reports[settling:]} == {Health.INERTIAL_ONLY}
    assert (
        reports[-1].tracks == 107 and reports[-1].landmarks == 7 and reports[-1].inertial_only_s == pytest.approx(0.95)
    )
    assert assess(monitor, both, state_after(20), stationary=True).health == Health.TRACKING
    assert assess(monitor, observations, state_after(21)).health == Health.INERTIAL_ONLY
    report = assess(monitor_of(landmarks(0, np.random.default_rng(0))), others, START)
    assert report.innovation_px is None and report.median_parallax_rad is None and report.innovation_nis is None


def assess_without_features(monitor: HealthMonitor, frames: int, speed_sigma_m_s: float) -> list[HealthReport]:
    """Return the reports of frames without features, while the position's uncertainty grows."""
    reports = []
    for k in range(1, frames + 1):
        P = np.diag(np.repeat([1e-6, 1e-4 + (speed_sigma_m_s * k * 0.05) ** 2, 1e-2, 1e-8, 1e-6], 3))
        reports.append(assess(monitor, NO_FEATURES, state_after(k, covariance=P)))
    return reports


def test_inertial_only_until_the_position_is_too_uncertain() -> None:
    triangulated, observations = landmarks_and_observations(40)
    monitor = monitor_of(triangulated)
    assess(monitor, observations, START)
    reports = assess_without_features(monitor, 120, speed_sigma_m_s=0.2)
    lost = [r.health for r in reports].index(Health.LOST)
    assert lost == pytest.approx(100, abs=1)  # a metre, at 0.2 m/s
    assert {r.health for r in reports[:lost]} == {Health.INERTIAL_ONLY}
    assert [r.inertial_only_s for r in reports] == pytest.approx(0.05 * np.arange(1, 121))
    assert "1.0 m" in reports[lost].reason
    assert assess(monitor, observations, state_after(121)).health == Health.LOST  # until the next initialization


def test_earlier_drift_does_not_count_for_a_loss() -> None:
    triangulated, observations = landmarks_and_observations(40)
    monitor = monitor_of(triangulated)
    P = np.diag(np.repeat([1e-6, 25.0, 1e-4, 1e-8, 1e-6], 3))  # after a long flight: 5 m of drift
    assert assess(monitor, observations, state_after(0, covariance=P)).health == Health.TRACKING
    assert assess(monitor, NO_FEATURES, state_after(1, covariance=1.02 * P)).health == Health.INERTIAL_ONLY
    assert assess(monitor, NO_FEATURES, state_after(2, covariance=1.05 * P)).health == Health.LOST


def test_only_a_lasting_contradiction_is_a_loss() -> None:
    triangulated, contradicting = landmarks_and_observations(40, error_px=2.0 * CONFIG.max_innovation_px)
    _, agreeing = landmarks_and_observations(40)
    frames = round(CONFIG.max_contradiction_s / 0.05)
    monitor = monitor_of(triangulated, replace(CONFIG, max_nis=inf, max_consistent_nis=inf, max_frame_nis=inf))
    assess(monitor, agreeing, START)
    for k in range(1, frames):
        assert assess(monitor, contradicting, state_after(k)).health == Health.TRACKING
    assess(monitor, agreeing, state_after(frames))
    health = [assess(monitor, contradicting, state_after(frames + k)).health for k in range(1, frames + 3)]
    assert health.index(Health.LOST) == frames


@pytest.mark.parametrize(("share", "is_lost"), [(0.9, True), (1.1, False)])
def test_an_uncertain_rotation_explains_its_innovation(share: float, is_lost: bool) -> None:
    """Twice the largest innovation, where the rotation since the keyframe is uncertain by a share of the excess."""
    triangulated, observations = landmarks_and_observations(40, error_px=2.0 * CONFIG.max_innovation_px)
    sigma_rad = share * CONFIG.max_innovation_px / RIG.cameras[0].model.fx
    assert START.covariance is not None
    P = START.covariance.copy()
    P[:3, :3] += sigma_rad**2 * np.eye(3)
    monitor = monitor_of(triangulated, replace(CONFIG, max_nis=inf, max_consistent_nis=inf, max_frame_nis=inf))
    frames = range(round(CONFIG.max_contradiction_s / 0.05) + 3)
    health = [assess(monitor, observations, state_after(k, covariance=P)).health for k in frames]
    assert (Health.LOST in health) == is_lost


def error_of_nis(nis: float) -> float:
    """Return the error of all observations [px] that has a NIS at the start, where only their noise counts."""
    return SIGMA_PX * float(np.sqrt(MEDIAN_CHI2_2DOF * nis))


def health_of(errors_px: list[float], monitor: HealthMonitor, triangulated: TriangulatedLandmarks) -> list[Health]:
    """Return the health of keyframes at the start whose observations have these errors [px]."""
    observed = {error: observe(triangulated, START, ZEROS, np.array([error, 0.0])) for error in set(errors_px)}
    health = []
    for k, error in enumerate(errors_px):
        monitor.set_reference(state_after(k), triangulated, None, DENSITIES)
        health.append(assess(monitor, observed[error], state_after(k)).health)
    return health


def test_inconsistent_innovations_are_a_loss() -> None:
    """The innovation is small in pixels, and many times its standard deviation: lost when the window is full."""
    triangulated, frames = landmarks(40, np.random.default_rng(1)), round(CONFIG.consistency_window_s / 0.05)
    bad, good = error_of_nis(1.05 * CONFIG.max_nis), error_of_nis(1.0)
    health = health_of([bad] * (frames + 1), monitor_of(triangulated), triangulated)
    assert health == [Health.INERTIAL_ONLY] * frames + [Health.LOST]  # a frame with this NIS is not trusted, either
    some = [bad if k % 4 == 0 else good for k in range(3 * frames)]  # less than half of the frames
    assert set(health_of(some, monitor_of(triangulated), triangulated)) == {Health.INERTIAL_ONLY}
    monitor, observations = monitor_of(triangulated), observe(triangulated, START, ZEROS, np.array([bad, 0.0]))
    for k in range(3 * frames):  # frames without landmarks empty the window
        monitor.set_reference(state_after(k), triangulated, None, DENSITIES)
        report = assess(monitor, NO_FEATURES if k % frames == 0 else observations, state_after(k), stationary=True)
        assert report.health != Health.LOST


def test_recently_inconsistent_estimate_is_not_tracking() -> None:
    triangulated, frames = landmarks(40, np.random.default_rng(1)), round(CONFIG.consistency_window_s / 0.05)
    good, distrust = error_of_nis(1.0), round(CONFIG.recovery_s / 0.05)
    monitor = monitor_of(triangulated)
    errors = [good, error_of_nis(1.05 * CONFIG.max_frame_nis)] + [good] * (distrust + 20)
    health = health_of(errors, monitor, triangulated)
    assert health == [Health.TRACKING] + [Health.INERTIAL_ONLY] * distrust + [Health.TRACKING] * 21
    assert monitor.is_consistent
    inconsistent = [error_of_nis(1.05 * CONFIG.max_consistent_nis)] * (frames + 1)
    monitor = monitor_of(triangulated)
    health = health_of(inconsistent + [good] * 20, monitor, triangulated)
    assert health[:2] == [Health.TRACKING] * 2 and set(health[2:]) == {Health.INERTIAL_ONLY}
    assert not monitor.is_consistent
    monitor = monitor_of(triangulated, is_consistent=False)
    assert health_of([good] * (distrust + 21), monitor, triangulated) == (
        [Health.INERTIAL_ONLY] * distrust + [Health.TRACKING] * 21
    )


@pytest.mark.parametrize("is_left_out", [True, False])
def test_images_that_are_left_out_agree_with_the_prediction(is_left_out: bool) -> None:
    """One frame in four has large innovations, as keyframes in fast motion; the report is that of the last of them."""
    triangulated = landmarks(40, np.random.default_rng(1))
    monitor, bad = monitor_of(triangulated), error_of_nis(1.05 * CONFIG.max_consistent_nis)
    for k in range(60):
        state, observations = state_after(k), observe(triangulated, START, ZEROS, np.array([bad, 0.0]))
        monitor.set_reference(state, triangulated, None, DENSITIES)
        if k % 4 == 0:
            last = monitor.assess(observations, state, False, Calibration(RIG))
        elif is_left_out:
            report = monitor.assess(observations, state, False, Calibration(RIG), has_image=False, is_left_out=True)
            assert (report.landmarks, report.innovation_nis) == (last.landmarks, last.innovation_nis)
    assert monitor.is_consistent is is_left_out


def test_contradictions_at_every_turn_are_one_distrust() -> None:
    """A wrong lens or focal length contradicts the estimate in turns, which may be eight seconds apart."""
    triangulated, straight = landmarks(40, np.random.default_rng(1)), [error_of_nis(1.0)] * round(8.0 / 0.05)
    turn = [error_of_nis(1.05 * CONFIG.max_frame_nis)]
    health = health_of([*turn, *straight, *turn, *straight, *turn], monitor_of(triangulated), triangulated)
    assert set(health) == {Health.INERTIAL_ONLY}


def test_improbable_change_by_a_correction_is_distrusted() -> None:
    """Of the calibration: the position must not change by more than five of its standard deviations of 10 mm."""
    triangulated, observations = landmarks_and_observations(40)
    for change_m, expected in ((0.049, Health.TRACKING), (0.051, Health.INERTIAL_ONLY)):
        monitor, T = monitor_of(triangulated), START.T_world_imu.copy()
        T[:3, 3] += change_m * np.array([0.6, 0.0, -0.8])
        monitor.correct(START, replace(START, T_world_imu=T))
        assert monitor.is_consistent is (expected is Health.TRACKING)
        assert assess(monitor, observations, state_after(1)).health is expected


def test_improbable_bias_by_a_start_in_motion_is_distrusted() -> None:
    """By more than 2.5 standard deviations of 0.05 rad/s and 0.2 m/s²."""
    for name, sigma in (("gyro_bias_rad_s", 0.05), ("accel_bias_m_s2", 0.2)):
        for sigmas, expected in ((2.49, True), (-2.51, False)):
            monitor = monitor_of(landmarks(40, np.random.default_rng(1)))
            bias: Any = {name: np.array([0.0, sigmas * sigma, 0.0])}
            monitor.begin_in_motion(replace(START, **bias))
            assert monitor.is_consistent is expected


def test_small_innovations_are_consistent_whatever_their_nis() -> None:
    """With little noise of the images, a third of a pixel has a large NIS, which counts from `min_innovation_px` on."""
    triangulated, frames = landmarks(40, np.random.default_rng(1)), round(CONFIG.consistency_window_s / 0.05)
    for error_px, expected in ((0.95, Health.TRACKING), (1.05, Health.INERTIAL_ONLY)):
        monitor = HealthMonitor(RIG.imu, CONFIG, 0.145)
        offset = np.array([error_px * CONFIG.min_innovation_px, 0.0])
        observations = observe(triangulated, START, ZEROS, offset)
        for k in range(frames + 2):
            monitor.set_reference(state_after(k), triangulated, CONFIG.image_variance_bounds[0], DENSITIES)
            report = assess(monitor, observations, state_after(k))
        assert report.innovation_nis is not None and report.innovation_nis > CONFIG.max_consistent_nis
        assert report.health == expected


def test_nis_is_relative_to_the_estimated_noise() -> None:
    triangulated = landmarks(40, np.random.default_rng(1))
    observations = observe(triangulated, START, ZEROS, np.array([error_of_nis(8.0), 0.0]))
    lower, upper = CONFIG.image_variance_bounds
    for variances, expected in (
        ([], 8.0),
        ([None], 8.0),
        ([2.0], 4.0),
        ([0.5, 4.0, 2.0], 4.0),
        ([8.0] * IMAGE_VARIANCES + [2.0] * (IMAGE_VARIANCES // 2 + 1), 4.0),
        ([1e-6], 8.0 / lower),
        ([1e6], 8.0 / upper),
    ):
        monitor = monitor_of(triangulated)
        for variance in variances:
            monitor.set_reference(START, triangulated, variance, DENSITIES)
        assert assess(monitor, observations, START).innovation_nis == pytest.approx(expected)


def test_nis_is_relative_to_the_noise_of_changed_patches() -> None:
    """A ZNCC of 0.95 doubles the standard deviation of a track, and the scale 1.5 multiplies it; 0.5 does not."""
    triangulated = landmarks(40, np.random.default_rng(1))
    monitor = monitor_of(triangulated)
    observations = observe(triangulated, START, ZEROS, np.array([error_of_nis(18.0), 0.0]))
    for zncc, scale, expected in ((1.0, 1.0, 18.0), (0.95, 1.0, 4.5), (0.95, 1.5, 2.0), (1.0, 0.5, 18.0)):
        changed = replace(observations, zncc=np.full(40, zncc), scale=np.full(40, scale))
        assert assess(monitor, changed, START).innovation_nis == pytest.approx(expected)


def test_noise_of_the_imu_in_the_nis_is_bounded() -> None:
    triangulated = landmarks(40, np.random.default_rng(1))
    observations = observe(triangulated, START, ZEROS, np.array([error_of_nis(8.0), 0.0]))

    def nis_of(ratio: float, shown: float = 0.0) -> float:
        monitor = monitor_of(triangulated)
        estimated, by_samples = ((x * DENSITIES[0], x * DENSITIES[1]) for x in (ratio, shown))
        monitor.set_reference(START, triangulated, None, estimated, by_samples)
        return assess(monitor, observations, state_after(10)).innovation_nis or 0.0

    largest = CONFIG.max_noise_ratio
    assert nis_of(0.1) == nis_of(1.0) > nis_of(2.0) > nis_of(largest) == nis_of(20.0)
    assert nis_of(largest) == nis_of(20.0, shown=2.0) > nis_of(20.0, shown=8.0) == nis_of(1.0, shown=8.0)
    assert nis_of(8.0, shown=8.0) > nis_of(8.0, shown=20.0) == nis_of(20.0, shown=20.0)


def test_a_fifth_of_outliers_is_no_contradiction() -> None:
    triangulated, observations = landmarks_and_observations(40)
    outliers = np.arange(40) % 5 == 0
    xy = observations.xy + outliers[:, None] * 0.5
    monitor = monitor_of(triangulated)
    for k in range(60):
        report = assess(monitor, replace(observations, xy=xy), state_after(k))
        assert report.health == Health.TRACKING and report.innovation_nis == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"velocity_m_s": np.array([0.0, 90.0, 0.0])}, "a speed of 90 m/s"),
        ({"velocity_m_s": np.array([0.0, np.nan, 0.0])}, "the state is not finite"),
        ({"T_world_imu": np.full((4, 4), np.nan)}, "the state is not finite"),
        ({"gyro_bias_rad_s": np.array([0.0, 0.0, -0.6])}, "a bias of 12 standard deviations"),
        ({"accel_bias_m_s2": np.array([np.inf, 0.0, 0.0])}, "the state is not finite"),
        ({"covariance": None}, "inf m"),
        ({"covariance": np.full((15, 15), np.nan)}, "the state is not finite"),
    ],
)
def test_implausible_states_are_lost_at_once(changes: dict[str, Any], reason: str) -> None:
    triangulated, observations = landmarks_and_observations(40)
    for tracked in (NO_FEATURES,) if reason == "inf m" else (NO_FEATURES, observations):
        monitor = monitor_of(triangulated)
        assess(monitor, observations, START)
        report = assess(monitor, tracked, state_after(1, **changes))
        assert report.health == Health.LOST and reason in report.reason


@pytest.mark.parametrize(
    ("frames_after", "is_consistent", "expected"),
    [
        (10, True, Health.LOST),
        (80, True, Health.LOST),
        (120, True, Health.INERTIAL_ONLY),  # later than `disconnected_s`
        (10, False, Health.INERTIAL_ONLY),  # it was not consistent before, either
    ],
)
def test_contradiction_after_exchanged_images_is_a_loss(
    frames_after: int, is_consistent: bool, expected: Health
) -> None:
    triangulated = landmarks(40, np.random.default_rng(1))
    good, bad = ([error_of_nis(nis)] for nis in (1.0, 1.05 * CONFIG.max_frame_nis))
    monitor = monitor_of(triangulated, is_consistent=is_consistent)
    monitor.disconnect(START.t_ns)
    health = health_of(good * frames_after + bad, monitor, triangulated)
    assert Health.LOST not in health[:-1] and health[-1] == expected


def test_exchanged_images_alone_are_no_loss() -> None:
    triangulated = landmarks(40, np.random.default_rng(1))
    monitor = monitor_of(triangulated)
    monitor.disconnect(START.t_ns)
    assert set(health_of([error_of_nis(1.0)] * 80, monitor, triangulated)) == {Health.TRACKING}


@pytest.mark.parametrize(
    ("sigma_m_s2", "change_m_s2", "is_disconnected", "expected"),
    [
        (0.01, 0.14, True, Health.LOST),  # 0.1 m/s² and three standard deviations are allowed
        (0.01, 0.12, True, Health.TRACKING),
        (0.02, 0.14, True, Health.TRACKING),
        (0.01, 0.14, False, Health.TRACKING),
    ],
)
def test_accelerometer_bias_that_changes_with_images_is_a_loss(
    sigma_m_s2: float, change_m_s2: float, is_disconnected: bool, expected: Health
) -> None:
    triangulated, observations = landmarks_and_observations(40)
    covariance = START.covariance.copy() if START.covariance is not None else np.eye(15)
    covariance[12:, 12:] = sigma_m_s2**2 * np.eye(3)
    keyframe = replace(START, covariance=covariance, accel_bias_m_s2=np.array([0.0, 0.2, 0.0]))
    monitor = monitor_of(triangulated)
    monitor.set_reference(keyframe, triangulated, None, (0.0, 0.0))
    if is_disconnected:
        monitor.disconnect(START.t_ns)
    bias = keyframe.accel_bias_m_s2 - np.array([0.0, change_m_s2, 0.0])
    assert assess(monitor, observations, state_after(1, accel_bias_m_s2=bias)).health == expected
