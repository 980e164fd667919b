"""Health: what holds the estimate, how well it fits, and what it is therefore worth.

Corners that are followed well prove nothing: before a distant wall, or while hovering after a turn, many tracks may
leave the motion to the IMU alone. What counts is landmarks of known position that are seen again, and whether they are
where the prediction puts them: the innovation of a filter, with its chi-squared test (Bar-Shalom, Li, Kirubarajan,
"Estimation with applications to tracking and navigation", 2001, section 5.4).

The states, in the order in which they are ruled out:

lost           a number is no number; the speed or a bias is beyond what can be; or most landmarks have been elsewhere
               for too long; or nothing but the IMU has held the estimate until its position, by its own covariance,
               is worth nothing. It stays so until the estimator starts anew, with a monitor of its own.
inertial-only  too few landmarks, and no rest, hold the estimate.
tracking       landmarks hold it, or the drone stands still or has only just begun to move.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.landmarks import TriangulatedLandmarks
from dronevio.estimator.backend.reprojection import MEDIAN_CHI2_2DOF
from dronevio.estimator.backend.triangulation import MIN_DEPTH_M
from dronevio.estimator.types import Observations
from dronevio.models.rig import Rig
from dronevio.models.state import Health, HealthReport, NavState

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]


@dataclass(frozen=True)
class HealthConfig:
    """Where one state of health ends and the next begins."""

    min_landmarks: int = 8
    """Landmarks that must hold an estimate: with fewer, one that is wrong turns it, and outvotes the rest."""
    settling_s: float = 0.5
    """For so long, features that are followed will do instead of landmarks [s]: three keyframes and some parallax, as
    after a rest, make landmarks of them."""
    max_innovation_px: float = 12.0
    """Median innovation beyond which landmarks contradict the estimate [px]: what 5 ms of time offset make at 300 °/s
    with EuRoC's lens, or several times what a degree of wrong mounting makes between frames ..."""
    contradicted_s: float = 1.0
    """... for so long: a jolt, or something large that passes by, is over before [s]."""
    max_blind_sigma_m: float = 1.0
    """What may be added to the position's standard deviation while only the IMU holds it [m]: about a body's length;
    EuRoC's IMU takes some 10 s for it."""
    max_speed_m_s: float = 60.0
    """Faster than a racing drone flies [m/s]."""
    gyro_bias_sigma_rad_s: float = 0.05
    """A gyroscope's bias is believed to be so large at least, whatever its model says [rad/s]: EuRoC's is 0.08, with a
    sensor whose data sheet has 0.01."""
    accel_bias_sigma_m_s2: float = 0.2
    """The same of the accelerometer's bias [m/s²]; EuRoC's reaches 0.5."""
    max_bias_sigmas: float = 10.0
    """Biases beyond so many of these standard deviations cannot be."""


class HealthMonitor:
    """Judges an estimate frame by frame, from its start to its loss."""

    def __init__(self, rig: Rig, config: HealthConfig, pixel_sigma: float) -> None:
        """Begin at a start.

        Args:
            rig: The calibration.
            config: Where the states end.
            pixel_sigma: Standard deviation of an image measurement [px].
        """
        self._config, self._imu = config, rig.imu
        self.recalibrate(rig)
        self._focal_px = np.array([camera.model.fx for camera in rig.cameras])
        self._pixel_sigma = pixel_sigma
        self._bias_sigmas = np.repeat(
            [
                max(config.gyro_bias_sigma_rad_s, rig.imu.gyro_turn_on_bias_rad_s),
                max(config.accel_bias_sigma_m_s2, rig.imu.accel_turn_on_bias_m_s2),
            ],
            3,
        )
        self._keyframe: NavState | None = None
        self._landmarks = TriangulatedLandmarks(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
        self._held_ns: int | None = None  # when something besides the IMU held the estimate last
        self._held_sigma_m = 0.0  # how well the position was known then
        self._agreed_ns: int | None = None  # when landmarks did not contradict it last
        self._lost: str | None = None  # why

    def recalibrate(self, rig: Rig) -> None:
        """Take over a better calibration of the cameras' mounting."""
        self._Ts_imu_cam = np.stack([camera.T_imu_cam for camera in rig.cameras])

    def hold(self, keyframe: NavState, landmarks: TriangulatedLandmarks) -> None:
        """Take what the next frames are measured against.

        Args:
            keyframe: The newest keyframe's state.
            landmarks: The landmarks that constrain the window.
        """
        self._keyframe, self._landmarks = keyframe, landmarks

    def judge(self, seen: Observations, predicted: NavState, still: bool) -> HealthReport:
        """Return what the estimate is worth at a frame.

        Args:
            seen: The features followed into the frame.
            predicted: The state that the IMU predicts for it, from the newest keyframe.
            still: Whether the drone stands still, so that it is held by that.
        """
        if not _is_finite(predicted):
            self._lost = self._lost or "the state is no number"
            return HealthReport(Health.LOST, self._lost, tracks=len(seen))
        rows, places = _common(self._landmarks.ids, seen.ids)
        innovation_px, nis = self._innovation(rows, seen, places, predicted)
        position_sigma_m, velocity_sigma_m_s = _sigmas(predicted)
        bias = np.concatenate([predicted.gyro_bias_rad_s, predicted.accel_bias_m_s2])
        bias_sigmas = float((np.abs(bias) / self._bias_sigmas).max())
        enough = len(rows) >= self._config.min_landmarks
        inertial_only_s = self._blind(predicted.t_ns, enough or still, position_sigma_m)
        allowed_px = self._config.max_innovation_px + self._turned_px(predicted)
        contradicted_s = self._contradicted(predicted.t_ns, enough and innovation_px > allowed_px)
        if self._lost is None:
            self._lost = self._why_lost(predicted, bias_sigmas, position_sigma_m, contradicted_s)
        if self._lost is not None:
            state, reason = Health.LOST, self._lost
        elif enough:
            state, reason = Health.TRACKING, f"{len(rows)} landmarks hold it"
        elif still:
            state, reason = Health.TRACKING, "the drone stands still"
        elif len(seen) >= self._config.min_landmarks and inertial_only_s <= self._config.settling_s:
            state, reason = Health.TRACKING, "features are followed, and will soon be landmarks"
        else:
            found = f"{len(rows)} landmarks hold it; {self._config.min_landmarks} are needed"
            state, reason = Health.INERTIAL_ONLY, found
        return HealthReport(
            state,
            reason,
            tracks=len(seen),
            landmarks=len(rows),
            median_parallax_rad=_median(self._landmarks.parallax_rad[rows]) if len(rows) else None,
            innovation_px=innovation_px if len(rows) else None,
            innovation_nis=nis if len(rows) else None,
            bias_sigmas=bias_sigmas,
            position_sigma_m=position_sigma_m,
            velocity_sigma_m_s=velocity_sigma_m_s,
            inertial_only_s=inertial_only_s,
        )

    def _innovation(self, rows: Rows, seen: Observations, places: Rows, predicted: NavState) -> tuple[float, float]:
        """Return the landmarks' median innovation [px], and its normalized square; 0 without landmarks.

        The landmarks' own positions are taken as certain.
        """
        if not len(rows):
            return 0.0, 0.0
        camera, R, p = seen.camera[places], predicted.T_world_imu[:3, :3], predicted.T_world_imu[:3, 3]
        Ts_imu_cam, focal_px = self._Ts_imu_cam[camera], self._focal_px[camera][:, None]
        in_imu = (self._landmarks.points[rows] - p) @ R
        axes = np.swapaxes(Ts_imu_cam[:, :3, :3], 1, 2)  # of the cameras, in the IMU frame, in rows
        in_cam = (axes @ (in_imu - Ts_imu_cam[:, :3, 3])[:, :, None])[:, :, 0]
        z = np.maximum(in_cam[:, 2:], MIN_DEPTH_M)
        xy = in_cam[:, :2] / z
        residual = focal_px * (seen.xy[places] - xy)
        slopes = (focal_px / z)[:, :, None] * (
            axes[:, :2] - xy[:, :, None] * axes[:, 2:]
        )  # pixels by metres, IMU frame
        moved, turned_rad2 = self._pose_covariance(predicted)
        J_u, J_v = slopes[:, 0] @ R.T, slopes[:, 1] @ R.T
        noise = self._pixel_sigma**2 + turned_rad2 * focal_px[:, 0] ** 2
        a, b, d = ((J @ moved * K).sum(axis=1) for J, K in ((J_u, J_u), (J_u, J_v), (J_v, J_v)))
        a, d = a + noise, d + noise  # S = (a b; b d), the innovation's covariance
        u, v = residual.T
        squares = (d * u * u - 2.0 * b * u * v + a * v * v) / (a * d - b * b)
        return _median(np.hypot(u, v)), _median(squares) / MEDIAN_CHI2_2DOF

    def _pose_covariance(self, predicted: NavState) -> tuple[Array, float]:
        """Return how uncertain the prediction has become since the newest keyframe.

        Leading terms of `propagate_covariance`, which over some tenths of a second are nearly all of it.

        Returns:
            The covariance (3, 3) of the position [m²], and the variance of the orientation about any axis [rad²].
        """
        start, imu = self._keyframe, self._imu
        if start is None or start.covariance is None:
            return np.zeros((3, 3)), 0.0
        t, P = (predicted.t_ns - start.t_ns) * 1e-9, start.covariance
        gyro_bias, accel_bias = float(np.trace(P[9:12, 9:12])) / 3.0, float(np.trace(P[12:, 12:])) / 3.0
        pushed = 0.25 * t**4 * accel_bias + imu.accel_noise_density**2 * t**3 / 3.0
        return t * t * P[6:9, 6:9] + pushed * np.eye(3), t * t * gyro_bias + t * imu.gyro_noise_density**2

    def _turned_px(self, predicted: NavState) -> float:
        """Return how far the doubt in the turn since the newest keyframe moves what is seen [px]."""
        start = self._keyframe
        if start is None or start.covariance is None or predicted.covariance is None:
            return 0.0
        variance = float(np.linalg.norm(predicted.covariance[:3, :3], 2) - np.linalg.norm(start.covariance[:3, :3], 2))
        return float(self._focal_px[0]) * math.sqrt(max(variance, 0.0))

    def _blind(self, t_ns: int, held: bool, position_sigma_m: float) -> float:
        """Return for how long nothing but the IMU has held the estimate [s]."""
        if held or self._held_ns is None:
            self._held_ns, self._held_sigma_m = t_ns, position_sigma_m
        return (t_ns - self._held_ns) * 1e-9

    def _contradicted(self, t_ns: int, contradicted: bool) -> float:
        """Return for how long landmarks have contradicted the estimate [s]."""
        if not contradicted or self._agreed_ns is None:
            self._agreed_ns = t_ns
        return (t_ns - self._agreed_ns) * 1e-9

    def _why_lost(
        self, predicted: NavState, bias_sigmas: float, position_sigma_m: float, contradicted_s: float
    ) -> str | None:
        """Say why the estimate means nothing; None where it does."""
        c, speed_m_s = self._config, float(np.linalg.norm(predicted.velocity_m_s))
        if speed_m_s > c.max_speed_m_s:
            return f"a speed of {speed_m_s:.0f} m/s"
        if bias_sigmas > c.max_bias_sigmas:
            return f"a bias of {bias_sigmas:.0f} standard deviations"
        if contradicted_s > c.contradicted_s:
            return f"landmarks have been elsewhere for {contradicted_s:.1f} s"
        grown_m = float(np.sqrt(max(position_sigma_m**2 - self._held_sigma_m**2, 0.0)))
        if grown_m > c.max_blind_sigma_m:
            return f"the IMU alone has let the position go, to {grown_m:.1f} m"
        return None


def _median(values: Array) -> float:
    """Return the median of values (N,), N > 0, the upper one of an even number: a fifth of `numpy.median`'s cost."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _common(ids: npt.NDArray[np.int64], others: npt.NDArray[np.int64]) -> tuple[Rows, Rows]:
    """Return where the identities that two increasing arrays have in common stand in each."""
    places = np.minimum(np.searchsorted(others, ids), len(others) - 1) if len(others) else np.zeros(0, np.int64)
    rows = np.flatnonzero(others[places] == ids) if len(others) else places
    return rows, places[rows]


def _is_finite(state: NavState) -> bool:
    """Say whether all numbers of a state are numbers."""
    known = () if state.covariance is None else (state.covariance,)
    parts = (state.T_world_imu, state.velocity_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2, *known)
    return all(bool(np.isfinite(part).all()) for part in parts)


def _sigmas(state: NavState) -> tuple[float, float]:
    """Return the standard deviations of position [m] and velocity [m/s] along their worst axes; infinite if unknown."""
    P = state.covariance
    if P is None:
        return float("inf"), float("inf")
    position, velocity = np.linalg.eigvalsh(np.stack([P[3:6, 3:6], P[6:9, 6:9]]))[:, -1]
    return float(np.sqrt(max(position, 0.0))), float(np.sqrt(max(velocity, 0.0)))
