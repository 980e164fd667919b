"""The health monitor: what holds an estimate, and from when on it is worth nothing."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.landmarks import TriangulatedLandmarks
from dronevio.estimator.health import HealthConfig, HealthMonitor
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import Health, HealthReport, NavState

Array = npt.NDArray[np.float64]

RIG = rig_named("euroc-stereo")
SIGMA_PX = 0.8
STEP_NS = 50_000_000
CONFIG = HealthConfig()
START = NavState(
    10**18,
    pose_matrix(exp_so3(np.array([0.1, -0.3, 0.8])), np.array([1.0, -2.0, 0.5])),
    np.array([0.4, 0.1, 0.0]),
    np.full(3, 0.01),
    np.full(3, 0.02),
    np.diag(np.repeat([1e-6, 1e-4, 1e-4, 1e-8, 1e-6], 3)),
)


def landmarks(n: int, rng: np.random.Generator) -> TriangulatedLandmarks:
    """Return landmarks before the first camera of the start."""
    depth = rng.uniform(2.0, 8.0, (n, 1))
    in_cam = np.hstack([rng.uniform(-0.5, 0.5, (n, 2)) * depth, depth])
    T_world_cam = START.T_world_imu @ RIG.cameras[0].T_imu_cam
    points = in_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return TriangulatedLandmarks(7 + 2 * np.arange(n), points, np.linspace(0.01, 0.05, n))


def sightings(
    known: TriangulatedLandmarks, state: NavState, cameras: npt.NDArray[np.int64], noise_px: Array
) -> Observations:
    """Return what the rig's cameras see of landmarks from a state, so many pixels off."""
    Ts_cam_world = inverse_pose(state.T_world_imu @ np.stack([c.T_imu_cam for c in RIG.cameras]))[cameras]
    p = np.einsum("nij,nj->ni", Ts_cam_world[:, :3, :3], known.points) + Ts_cam_world[:, :3, 3]
    focal = np.array([c.model.fx for c in RIG.cameras])[cameras]
    xy = p[:, :2] / p[:, 2:] + noise_px / focal[:, None]
    return Observations(known.ids, xy, xy, np.ones(len(xy), np.int64), cameras)


def monitor(known: TriangulatedLandmarks, config: HealthConfig = CONFIG) -> HealthMonitor:
    made = HealthMonitor(RIG.imu, config, SIGMA_PX)
    made.set_reference(START, known)
    return made


def assess(watcher: HealthMonitor, seen: Observations, predicted: NavState, stationary: bool) -> HealthReport:
    return watcher.assess(seen, predicted, stationary, Calibration(RIG))


def after(k: int, state: NavState = START, **changes: object) -> NavState:
    """Return a state at the k-th frame."""
    return replace(state, t_ns=START.t_ns + k * STEP_NS, **changes)  # type: ignore[arg-type]


def seen(n: int, off_px: float = 0.0) -> tuple[TriangulatedLandmarks, Observations]:
    rng = np.random.default_rng(1)
    known = landmarks(n, rng)
    return known, sightings(known, START, np.zeros(n, np.int64), np.array([off_px, 0.0]))


def test_landmarks_hold_it_and_the_figures_are_theirs() -> None:
    known, observations = seen(40, off_px=0.5)
    report = assess(monitor(known), observations, START, stationary=False)
    assert report.health == Health.TRACKING and report.reason == "constrained by 40 landmarks"
    assert (report.tracks, report.landmarks) == (40, 40)
    assert report.innovation_px == pytest.approx(0.5, abs=1e-9)
    assert report.median_parallax_rad == pytest.approx(0.03, rel=0.05)
    assert report.bias_sigmas == pytest.approx(0.2)  # 0.01 of 0.05 rad/s
    assert report.position_sigma_m == pytest.approx(0.01)
    assert report.velocity_sigma_m_s == pytest.approx(0.01)
    assert report.inertial_only_s == 0.0


def test_innovation_of_consistent_noise_is_one() -> None:
    """The pose is drawn from the prediction's covariance, the pixels from theirs, seen by both cameras."""
    rng = np.random.default_rng(3)
    known = landmarks(120, rng)
    watcher = monitor(known)
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
    P[:3, :3] = 1e-8 * t**2 * np.eye(3)  # the gyroscope's bias
    P[3:, 3:] = 1e-4 * t**2 * np.eye(3)  # the velocity
    nis = []
    for _ in range(60):
        d = rng.multivariate_normal(np.zeros(6), P)
        R, p = predicted.T_world_imu[:3, :3] @ exp_so3(d[:3]), predicted.T_world_imu[:3, 3] + d[3:]
        true = replace(predicted, T_world_imu=pose_matrix(R, p))
        observations = sightings(known, true, cameras, SIGMA_PX * rng.normal(size=(120, 2)))
        report = assess(watcher, observations, predicted, stationary=False)
        assert report.innovation_nis is not None
        nis.append(report.innovation_nis)
    assert np.mean(nis) == pytest.approx(1.0, abs=0.08)
    assert max(nis) < 3.0


def test_tracks_that_are_no_landmarks_hold_nothing() -> None:
    known, observations = seen(CONFIG.min_landmarks - 1)
    others = Observations(
        1000 + np.arange(100), np.zeros((100, 2)), np.zeros((100, 2)), np.ones(100, np.int64)
    )  # followed, but never seen with parallax
    both = Observations(
        *(
            np.concatenate([getattr(observations, name), getattr(others, name)])
            for name in ("ids", "pixels", "xy", "ages")
        )
    )
    watcher = monitor(known)
    reports = [assess(watcher, both, after(k), stationary=False) for k in range(20)]
    settling = round(CONFIG.settling_s / 0.05) + 1
    assert {r.health for r in reports[:settling]} == {Health.TRACKING}  # they may become landmarks
    assert {r.health for r in reports[settling:]} == {Health.INERTIAL_ONLY}
    assert (
        reports[-1].tracks == 107 and reports[-1].landmarks == 7 and reports[-1].inertial_only_s == pytest.approx(0.95)
    )
    assert assess(watcher, both, after(20), stationary=True).health == Health.TRACKING
    assert assess(watcher, observations, after(21), stationary=False).health == Health.INERTIAL_ONLY
    nothing = assess(monitor(landmarks(0, np.random.default_rng(0))), others, START, stationary=False)
    assert nothing.innovation_px is None and nothing.median_parallax_rad is None and nothing.innovation_nis is None


def blind(monitored: HealthMonitor, frames: int, speed_sigma_m_s: float) -> list[HealthReport]:
    """Let a monitor see nothing for some frames, while the position's uncertainty grows."""
    none = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
    reports = []
    for k in range(1, frames + 1):
        P = np.diag(np.repeat([1e-6, 1e-4 + (speed_sigma_m_s * k * 0.05) ** 2, 1e-2, 1e-8, 1e-6], 3))
        reports.append(assess(monitored, none, after(k, covariance=P), stationary=False))
    return reports


def test_blind_is_inertial_only_until_the_position_is_gone() -> None:
    known, observations = seen(40)
    watcher = monitor(known)
    assess(watcher, observations, START, stationary=False)
    reports = blind(watcher, 120, speed_sigma_m_s=0.2)
    lost = [r.health for r in reports].index(Health.LOST)
    assert lost == pytest.approx(100, abs=1)  # a metre, at 0.2 m/s
    assert {r.health for r in reports[:lost]} == {Health.INERTIAL_ONLY}
    assert [r.inertial_only_s for r in reports] == pytest.approx(0.05 * np.arange(1, 121))
    assert "1.0 m" in reports[lost].reason
    assert assess(watcher, observations, after(121), stationary=False).health == Health.LOST  # until it starts anew


def test_what_was_unsure_before_is_not_held_against_the_dark() -> None:
    known, observations = seen(40)
    watcher = monitor(known)
    far = np.diag(np.repeat([1e-6, 25.0, 1e-4, 1e-8, 1e-6], 3))  # after a long flight: 5 m of drift
    assert assess(watcher, observations, after(0, covariance=far), stationary=False).health == Health.TRACKING
    dark = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
    assert assess(watcher, dark, after(1, covariance=1.02 * far), stationary=False).health == Health.INERTIAL_ONLY
    assert assess(watcher, dark, after(2, covariance=1.05 * far), stationary=False).health == Health.LOST


def test_contradiction_must_last() -> None:
    known, observations = seen(40, off_px=2.0 * CONFIG.max_innovation_px)
    _, agreeing = seen(40)
    frames = round(CONFIG.max_contradiction_s / 0.05)
    watcher = monitor(known)
    assess(watcher, agreeing, START, stationary=False)
    for k in range(1, frames):
        assert assess(watcher, observations, after(k), stationary=False).health == Health.TRACKING
    assess(watcher, agreeing, after(frames), stationary=False)
    states = [assess(watcher, observations, after(frames + k), stationary=False).health for k in range(1, frames + 3)]
    assert states.index(Health.LOST) == frames


def test_a_fifth_of_outliers_is_no_contradiction() -> None:
    known, observations = seen(40)
    rows = np.arange(40) % 5 == 0
    xy = observations.xy + rows[:, None] * 0.5
    watcher = monitor(known)
    for k in range(60):
        report = assess(watcher, replace(observations, xy=xy), after(k), stationary=False)
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
def test_what_cannot_be_is_lost_at_once(changes: dict[str, object], reason: str) -> None:
    known, observations = seen(40)
    empty = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
    for what in (empty,) if reason == "inf m" else (empty, observations):
        watcher = monitor(known)
        assess(watcher, observations, START, stationary=False)
        report = assess(watcher, what, after(1, **changes), stationary=False)
        assert report.health == Health.LOST and reason in report.reason
