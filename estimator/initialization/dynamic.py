"""Dynamic initialization: velocity, gravity and landmarks from a second of tracks and IMU measurements, in closed form.

With the rotation known from the gyroscope, each observation of a landmark is linear in the landmark's position, the
initial velocity and gravity (Dong-Si and Mourikis, "Estimator initialization in vision-aided inertial navigation with
unknown camera-IMU calibration", IROS 2012). The landmarks are eliminated one by one and the magnitude of gravity is a
constraint, which leaves a problem of three unknowns. The gyroscope bias minimizes the residual by Gauss-Newton.

A landmark that several cameras observe at the same time has a depth from the first frame on. The equations are the
same, with more observations; a shorter window and any motion then suffice, where a single camera needs parallax and
acceleration.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq, least_squares

from dronevio.estimator.imu.buffer import joined
from dronevio.estimator.initialization.static import NotObservable, level_rotation
from dronevio.estimator.types import FramePacket, Integers
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import integrated_rotations, pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DynamicInitializationConfig:
    """Settings of the dynamic initialization."""

    window_s: float = 1.5
    """Length of the window with a single camera [s]."""
    attempt_interval_s: float = 0.25
    """Time between attempts [s]."""
    min_parallax_px: float = 25.0
    """Smallest median displacement of the features over the window, compensated for rotation [px]."""
    stereo_window_s: float = 0.5
    """Length of the window where several cameras observe the same landmarks, which makes the scale observable [s]."""
    max_frames: int = 16
    """Largest number of frames that are used; of a longer window, every second or third frame is used."""
    min_observations: int = 6
    """Smallest number of used frames in which a landmark must be observed."""
    min_landmarks: int = 20
    """Smallest number of such landmarks."""
    max_residual_px: float = 1.5
    """Largest root mean square reprojection residual [px]."""
    max_velocity_sigma_m_s: float = 0.1
    """Largest standard deviation of the velocity by the residuals [m/s]."""
    min_in_front: float = 0.9
    """Smallest share of the landmarks that must lie in front of the camera."""
    max_gyro_bias_rad_s: float = 0.2
    """Largest plausible gyroscope bias [rad/s]."""
    accel_bias_m_s2: float = 0.1
    """Magnitude of the accelerometer bias that the excitation is compared with [m/s²]."""
    min_excitation: float = 3.0
    """Smallest ratio between the deviation of the path from constant velocity and that which the accelerometer bias
    causes. At constant velocity the scale of a single camera is not observable."""


@dataclass(frozen=True, eq=False)
class _Tracks:
    """The F landmarks of a window that are observed often enough, in V views: each is one camera in one frame."""

    xy: Array  # (V, F, 2) normalized coordinates, 0 where not observed
    observed: npt.NDArray[np.bool_]  # (V, F)
    frame: Integers  # (V,) index of the frame in the window
    camera: Integers  # (V,) index of the camera in the rig


@dataclass(frozen=True, eq=False)
class _Motion:
    """The IMU integrated from the first frame of a window to each view, in the first frame's IMU frame."""

    t_s: Array  # (V,)
    R: Array  # (V, 3, 3)
    dp: Array  # (V, 3) without gravity and initial velocity [m]


@dataclass(frozen=True, eq=False)
class _Solution:
    """The solution of the linear problem, in the first frame's IMU frame."""

    velocity: Array  # (3,) initial velocity [m/s]
    gravity: Array  # (3,) [m/s²]
    velocity_covariance: Array  # (3, 3) for unit noise of the normalized coordinates
    residuals: Array  # (F, 2V) in normalized coordinates, 0 where not observed
    in_front: float  # share of the landmarks in front of the camera


def is_stereo(window: Sequence[FramePacket], config: DynamicInitializationConfig) -> bool:
    """Return whether enough landmarks are observed by several cameras at once, so that the scale is observable."""
    return any(len(packet.observations.matches) >= config.min_landmarks for packet in window)


def initialize_dynamic(
    window: Sequence[FramePacket],
    Ts_imu_cam: Array,
    focal_px: float,
    config: DynamicInitializationConfig,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> NavState | NotObservable:
    """Return the state at the first frame of a window, or the reason why it is not observable.

    The accelerometer bias is taken as zero.

    Args:
        window: Consecutive frame packets.
        Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras in the IMU frame.
        focal_px: Focal length [px].
        config: Settings.
        gravity_m_s2: Magnitude of gravity [m/s²].
    """
    stereo = is_stereo(window, config)
    tracks = _collect(window, config)
    if tracks.xy.shape[1] < config.min_landmarks:
        return NotObservable(
            f"{tracks.xy.shape[1]} landmarks with long enough tracks; {config.min_landmarks} are needed"
        )
    parallax_px = _parallax(tracks, _integrate(window, np.zeros(3), tracks.frame), Ts_imu_cam) * focal_px
    if not stereo and parallax_px < config.min_parallax_px:
        return NotObservable(f"a parallax of {parallax_px:.1f} px; {config.min_parallax_px:g} px are needed")

    def residuals_px(gyro_bias: Array) -> Array:
        solution = _solve(tracks, _integrate(window, gyro_bias, tracks.frame), Ts_imu_cam, gravity_m_s2)
        return np.asarray(solution.residuals.ravel() * focal_px)

    found = least_squares(residuals_px, np.zeros(3), loss="soft_l1", x_scale=0.01, diff_step=1e-3, max_nfev=8)
    motion = _integrate(window, found.x, tracks.frame)
    solution = _solve(tracks, motion, Ts_imu_cam, gravity_m_s2)
    t_s = motion.t_s[:, None]
    curvature_m = _deviation_from_line(motion.dp + 0.5 * solution.gravity * t_s**2, t_s)
    curvature_of_bias_m = _deviation_from_line(0.5 * config.accel_bias_m_s2 * t_s**2, t_s)
    rms_px = float(np.sqrt(np.sum(found.fun**2) / (2 * tracks.observed.sum())))
    sigma = np.sqrt(np.trace(solution.velocity_covariance)) * max(rms_px, 0.3) / focal_px
    checks = (
        (rms_px < config.max_residual_px, f"reprojection residuals of {rms_px:.1f} px"),
        (solution.in_front > config.min_in_front, f"{1.0 - solution.in_front:.0%} of the landmarks behind the camera"),
        (sigma < config.max_velocity_sigma_m_s, f"a velocity with a standard deviation of {sigma:.2f} m/s"),
        (float(np.linalg.norm(found.x)) < config.max_gyro_bias_rad_s, "an implausible gyroscope bias"),
        (stereo or curvature_m > config.min_excitation * curvature_of_bias_m, "too little acceleration for the scale"),
    )
    for passed, reason in checks:
        if not passed:
            return NotObservable(reason)
    R_world_imu = level_rotation(-solution.gravity)
    pose = pose_matrix(R_world_imu, np.zeros(3))
    return NavState(window[0].t_ns, pose, R_world_imu @ solution.velocity, found.x, np.zeros(3))


def _collect(window: Sequence[FramePacket], config: DynamicInitializationConfig) -> _Tracks:
    """Arrange the observations of all landmarks that enough of the frames observe."""
    stride = -(-len(window) // config.max_frames)
    used = [k for k, packet in enumerate(window) if k % stride == 0 or len(packet.observations.matches)]
    observations = [window[k].observations for k in used]
    ids, counts = np.unique(np.concatenate([frame.ids for frame in observations]), return_counts=True)
    ids = ids[counts >= min(config.min_observations, len(used) // 2)]
    views: list[tuple[int, int, Array, npt.NDArray[np.bool_]]] = []
    for k, frame in zip(used, observations, strict=True):
        by_camera = [(frame.ids, frame.camera, frame.xy), (frame.matches.ids, frame.matches.camera, frame.matches.xy)]
        for some_ids, cameras, some_xy in by_camera:
            for camera in np.unique(cameras).tolist():
                mine = np.flatnonzero(cameras == camera)
                _, column, row = np.intersect1d(ids, some_ids[mine], return_indices=True)
                xy, visible = np.zeros((len(ids), 2)), np.zeros(len(ids), dtype=np.bool_)
                xy[column], visible[column] = some_xy[mine[row]], True
                views.append((k, camera, xy, visible))
    frame_of, camera_of = (np.array([view[i] for view in views], dtype=np.int64) for i in (0, 1))
    xy_of = np.array([view[2] for view in views]).reshape(len(views), len(ids), 2)
    observed = np.array([view[3] for view in views], dtype=np.bool_).reshape(len(views), len(ids))
    return _Tracks(xy_of, observed, frame_of, camera_of)


def _integrate(window: Sequence[FramePacket], gyro_bias: Array, frames: Integers) -> _Motion:
    """Integrate the IMU from the window's first frame, without gravity and initial velocity."""
    increments = joined([packet.increments for packet in window[1:]])
    dt_s = increments.dt_s
    R = integrated_rotations((increments.gyro_rad_s - gyro_bias) * dt_s[:, None])
    dv = np.einsum("nij,nj->ni", R[:-1], increments.accel_m_s2) * dt_s[:, None]
    v = np.vstack([np.zeros(3), np.cumsum(dv, axis=0)])
    p = np.vstack([np.zeros(3), np.cumsum((v[:-1] + 0.5 * dv) * dt_s[:, None], axis=0)])
    t = np.concatenate([[0.0], np.cumsum(dt_s)])
    rows = np.concatenate([[0], np.cumsum([len(packet.increments.dt_s) for packet in window[1:]])])[frames]
    return _Motion(t[rows], R[rows], p[rows])


def _deviation_from_line(positions: Array, t_s: Array) -> float:
    """Return the RMS deviation [m] of positions (V, n) at times (V, 1) from the closest constant velocity."""
    velocity = (t_s * positions).sum(axis=0) / np.sum(t_s**2)
    return float(np.sqrt(np.sum((positions - velocity * t_s) ** 2) / len(positions)))


def _parallax(tracks: _Tracks, motion: _Motion, Ts_imu_cam: Array) -> float:
    """Return the median displacement between the first and last views of the landmarks, compensated for rotation."""
    R_imu_cam = Ts_imu_cam[tracks.camera, :3, :3]
    rays = np.concatenate([tracks.xy, np.ones((*tracks.observed.shape, 1))], axis=-1)
    rays = np.einsum("kij,kfj->kfi", Ts_imu_cam[0, :3, :3].T @ motion.R @ R_imu_cam, rays)
    xy = rays[..., :2] / np.maximum(rays[..., 2:], 0.1)
    first, last = tracks.observed.argmax(axis=0), len(xy) - 1 - tracks.observed[::-1].argmax(axis=0)
    columns = np.arange(xy.shape[1])
    return float(np.median(np.linalg.norm(xy[last, columns] - xy[first, columns], axis=1)))


def _solve(tracks: _Tracks, motion: _Motion, Ts_imu_cam: Array, gravity_m_s2: float) -> _Solution:
    """Solve for the initial velocity and gravity, with the landmarks eliminated.

    A landmark at p that is observed at (x, y) from the frame at R, dp satisfies
    M (Rᵀ(p − v t − ½ g t² − dp) − p_imu_cam) = 0 with M = [1 0 −x; 0 1 −y] R_imu_camᵀ. The rows are distances; divided
    by the landmark's depth they are distances in normalized image coordinates.
    """
    V, F = tracks.observed.shape
    R_imu_cam, p_imu_cam = Ts_imu_cam[tracks.camera, :3, :3], Ts_imu_cam[tracks.camera, :3, 3]
    M = np.zeros((V, F, 2, 3))
    M[..., 0, 0] = M[..., 1, 1] = 1.0
    M[..., 2] = -tracks.xy
    M = (M * tracks.observed[..., None, None]) @ np.swapaxes(R_imu_cam, 1, 2)[:, None]
    A = M @ np.swapaxes(motion.R, -1, -2)[:, None]
    b = np.einsum("kfij,kj->kfi", A, motion.dp) + np.einsum("kfij,kj->kfi", M, p_imu_cam)
    t = motion.t_s[:, None, None, None]
    X = np.concatenate([-A * t, -0.5 * A * t**2], axis=-1)
    # One block of 2V rows per landmark
    A, X, b = (np.moveaxis(Y, 1, 0).reshape(F, 2 * V, *Y.shape[3:]) for Y in (A, X, b))
    pseudo_inverse = np.linalg.solve(np.swapaxes(A, 1, 2) @ A + 1e-9 * np.eye(3), np.swapaxes(A, 1, 2))
    PX, Pb = X - A @ (pseudo_inverse @ X), b - (A @ (pseudo_inverse @ b[..., None]))[..., 0]
    H, h = np.einsum("fri,frj->ij", PX, PX), np.einsum("fri,fr->i", PX, Pb)
    H_vv, H_vg = H[:3, :3], H[:3, 3:]
    D = H[3:, 3:] - H_vg.T @ np.linalg.solve(H_vv, H_vg)
    g = _on_sphere(D, h[3:] - H_vg.T @ np.linalg.solve(H_vv, h[:3]), gravity_m_s2)
    v = np.linalg.solve(H_vv, h[:3] - H_vg @ g)
    x = np.concatenate([v, g])
    landmarks = np.einsum("fir,fr->fi", pseudo_inverse, b - X @ x)
    positions = v * motion.t_s[:, None] + 0.5 * g * motion.t_s[:, None] ** 2 + motion.dp
    optical_axes = (motion.R @ R_imu_cam)[..., 2]
    depths = np.einsum("kj,kfj->kf", optical_axes, landmarks - positions[:, None])
    depth = (depths * tracks.observed).sum(axis=0) / tracks.observed.sum(axis=0)
    scale = np.maximum(depth, 0.1)[:, None]
    PX_image = PX / scale[..., None]
    covariance = np.linalg.inv(np.einsum("fri,frj->ij", PX_image, PX_image))[:3, :3]
    return _Solution(v, g, covariance, (PX @ x - Pb) / scale, float((depth > 0.1).mean()))


def _on_sphere(D: Array, d: Array, radius: float) -> Array:
    """Return the vector x (3,) of a given norm that minimizes xᵀDx − 2dᵀx.

    It is (D + λI)⁻¹ d. Its norm decreases with λ, from infinity at minus the smallest eigenvalue of D to zero.
    """
    eigenvalues, U = np.linalg.eigh(D)
    c = U.T @ d

    def excess(shift: float) -> float:
        return float(np.sum((c / (eigenvalues - eigenvalues[0] + shift)) ** 2) - radius**2)

    low, high = 1e-9 * float(eigenvalues[-1]), 2.0 * float(np.linalg.norm(d)) / radius + 1e-12
    shift = brentq(excess, low, high) if excess(low) > 0.0 > excess(high) else low
    return np.asarray(U @ (c / (eigenvalues - eigenvalues[0] + shift)))
