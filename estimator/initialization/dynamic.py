"""The start in motion: velocity, gravity and landmarks from a second of tracks and IMU, in closed form.

With the rotation known from the gyroscope, every packet of a landmark is linear in the landmark's position, the first
velocity and gravity (Dong-Si and Mourikis, "Estimator initialization in vision-aided inertial navigation with unknown
camera-IMU calibration", IROS 2012). Landmarks are eliminated one by one, and gravity's magnitude is held, which leaves
a problem in three numbers. Around it, the gyroscope's bias is found by Gauss-Newton on the residual.

A landmark that several cameras see at once has a depth from the first. The equations are the same, with more sightings;
but then a shorter window does, and any motion, where one camera needs parallax and acceleration.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq, least_squares

from dronevio.estimator.initialization.static import NotObservable, level_rotation
from dronevio.estimator.types import FramePacket
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]


@dataclass(frozen=True)
class DynamicInitializationConfig:
    """When a start in motion is tried, and when it is believed."""

    window_s: float = 1.5
    """Length of the stretch that it is made of [s]."""
    every_s: float = 0.25
    """Time between tries [s]."""
    min_parallax_px: float = 25.0
    """Median displacement of the features over the window, rotation taken out [px]."""
    stereo_window_s: float = 0.5
    """The same where several cameras see the same landmarks, which gives the scale from the first frame on [s]."""
    max_frames: int = 16
    """Of a longer window, every second frame is used, or every third; or else it takes too long."""
    min_sightings: int = 6
    """Used frames that must have seen a landmark."""
    min_landmarks: int = 20
    """Such landmarks."""
    max_residual_px: float = 1.5
    """Root mean square of the reprojection residuals."""
    max_velocity_sigma_m_s: float = 0.1
    """Standard deviation of the velocity that the residuals leave [m/s]; more means: not observable yet."""
    min_in_front: float = 0.9
    """Share of the landmarks that must lie before the camera."""
    max_gyro_bias_rad_s: float = 0.2
    """Largest bias of the gyroscope that is believed [rad/s]."""
    accel_bias_m_s2: float = 0.1
    """How large the accelerometer's bias may be [m/s²] ..."""
    min_excitation: float = 3.0
    """... and how many times more than it the acceleration must bend the path: at constant velocity, every scale
    explains what is seen."""


@dataclass(frozen=True, eq=False)
class _Tracks:
    """The landmarks of a window, those F that were seen often enough, in V views: what one camera sees in one frame."""

    xy: Array  # (V, F, 2) normalized coordinates, 0 where not seen
    seen: npt.NDArray[np.bool_]  # (V, F)
    frame: Rows  # (V,) which of the window's frames
    camera: Rows  # (V,) which of the rig's cameras


@dataclass(frozen=True, eq=False)
class _Motion:
    """The IMU summed up from the first frame of a window to that of each view, in the first frame's axes."""

    t_s: Array  # (V,)
    R: Array  # (V, 3, 3)
    dp: Array  # (V, 3) without gravity and the first velocity [m]


@dataclass(frozen=True, eq=False)
class _Solution:
    """What the linear problem gives, in the axes of the first frame's IMU."""

    velocity: Array  # (3,) at the first frame [m/s]
    gravity: Array  # (3,) [m/s²]
    velocity_covariance: Array  # (3, 3) for unit noise of the normalized coordinates
    residuals: Array  # (F, 2V) of the normalized coordinates, 0 where not seen
    in_front: float  # share of the landmarks that lie before the camera


def is_stereo(window: Sequence[FramePacket], config: DynamicInitializationConfig) -> bool:
    """Say whether enough landmarks of a window were seen by several cameras at once, so that the scale is known."""
    return any(len(packet.observations.matches) >= config.min_landmarks for packet in window)


def initialize_dynamic(
    window: Sequence[FramePacket], Ts_imu_cam: Array, focal_px: float, config: DynamicInitializationConfig
) -> NavState | NotObservable:
    """Return the state at the first frame of a window, or why it cannot be told.

    The accelerometer's bias is taken as zero.

    Args:
        window: Consecutive frames.
        Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras in the IMU frame.
        focal_px: Focal length [px].
        config: When to believe it.
    """
    stereo = is_stereo(window, config)
    tracks = _collect(window, config)
    if tracks.xy.shape[1] < config.min_landmarks:
        return NotObservable(f"{tracks.xy.shape[1]} landmarks seen for long enough; {config.min_landmarks} are needed")
    parallax_px = _parallax(tracks, _sum_up(window, np.zeros(3), tracks.frame), Ts_imu_cam) * focal_px
    if not stereo and parallax_px < config.min_parallax_px:
        return NotObservable(f"a parallax of {parallax_px:.1f} px; {config.min_parallax_px:g} px are needed")

    def residuals_px(gyro_bias: Array) -> Array:
        solution = _solve(tracks, _sum_up(window, gyro_bias, tracks.frame), Ts_imu_cam)
        return np.asarray(solution.residuals.ravel() * focal_px)

    found = least_squares(residuals_px, np.zeros(3), loss="soft_l1", x_scale=0.01, diff_step=1e-3, max_nfev=8)
    motion = _sum_up(window, found.x, tracks.frame)
    solution = _solve(tracks, motion, Ts_imu_cam)
    t_s = motion.t_s[:, None]
    bend = _bend(motion.dp + 0.5 * solution.gravity * t_s**2, t_s)
    bend_of_bias = _bend(0.5 * config.accel_bias_m_s2 * t_s**2, t_s)
    rms_px = float(np.sqrt(np.sum(found.fun**2) / (2 * tracks.seen.sum())))
    sigma = np.sqrt(np.trace(solution.velocity_covariance)) * max(rms_px, 0.3) / focal_px
    checks = (
        (rms_px < config.max_residual_px, f"residuals of {rms_px:.1f} px"),
        (solution.in_front > config.min_in_front, f"{1.0 - solution.in_front:.0%} of the landmarks behind the camera"),
        (sigma < config.max_velocity_sigma_m_s, f"a velocity known to {sigma:.2f} m/s"),
        (float(np.linalg.norm(found.x)) < config.max_gyro_bias_rad_s, "an implausible bias of the gyroscope"),
        (stereo or bend > config.min_excitation * bend_of_bias, "too little acceleration to tell the scale"),
    )
    for passed, reason in checks:
        if not passed:
            return NotObservable(reason)
    R_world_imu = level_rotation(-solution.gravity)
    pose = pose_matrix(R_world_imu, np.zeros(3))
    return NavState(window[0].t_ns, pose, R_world_imu @ solution.velocity, found.x, np.zeros(3))


def _collect(window: Sequence[FramePacket], config: DynamicInitializationConfig) -> _Tracks:
    """Arrange the sightings of all landmarks that enough of the frames show."""
    stride = -(-len(window) // config.max_frames)
    used = [k for k, s in enumerate(window) if k % stride == 0 or len(s.observations.matches)]
    seen = [window[k].observations for k in used]
    ids, counts = np.unique(np.concatenate([frame.ids for frame in seen]), return_counts=True)
    ids = ids[counts >= min(config.min_sightings, len(used) // 2)]
    views: list[tuple[int, int, Array, npt.NDArray[np.bool_]]] = []
    for k, frame in zip(used, seen, strict=True):
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
    seen_of = np.array([view[3] for view in views], dtype=np.bool_).reshape(len(views), len(ids))
    return _Tracks(xy_of, seen_of, frame_of, camera_of)


def _sum_up(window: Sequence[FramePacket], gyro_bias: Array, frames: Rows) -> _Motion:
    """Dead-reckon from the window's first frame, without gravity and with no velocity at the start."""
    steps = [packet.increments for packet in window[1:]]
    dt_s = np.concatenate([step.dt_s for step in steps])
    gyro = np.concatenate([step.gyro_rad_s for step in steps])
    accel = np.concatenate([step.accel_m_s2 for step in steps])
    turns = exp_so3((gyro - gyro_bias) * dt_s[:, None])
    R = np.empty((len(dt_s) + 1, 3, 3))
    R[0] = np.eye(3)
    for i, turn in enumerate(turns):
        R[i + 1] = R[i] @ turn
    dv = np.einsum("nij,nj->ni", R[:-1], accel) * dt_s[:, None]
    v = np.vstack([np.zeros(3), np.cumsum(dv, axis=0)])
    p = np.vstack([np.zeros(3), np.cumsum((v[:-1] + 0.5 * dv) * dt_s[:, None], axis=0)])
    t = np.concatenate([[0.0], np.cumsum(dt_s)])
    rows = np.concatenate([[0], np.cumsum([len(step.dt_s) for step in steps])])[frames]
    return _Motion(t[rows], R[rows], p[rows])


def _bend(places: Array, t_s: Array) -> float:
    """Return the root mean square distance [m] of places (V, n) at times (V, 1) from the nearest constant velocity."""
    velocity = (t_s * places).sum(axis=0) / np.sum(t_s**2)
    return float(np.sqrt(np.sum((places - velocity * t_s) ** 2) / len(places)))


def _parallax(tracks: _Tracks, motion: _Motion, Ts_imu_cam: Array) -> float:
    """Return the median displacement between a landmark's first and last sightings, rotation taken out."""
    R_imu_cam = Ts_imu_cam[tracks.camera, :3, :3]
    rays = np.concatenate([tracks.xy, np.ones((*tracks.seen.shape, 1))], axis=-1)
    rays = np.einsum("kij,kfj->kfi", Ts_imu_cam[0, :3, :3].T @ motion.R @ R_imu_cam, rays)
    xy = rays[..., :2] / np.maximum(rays[..., 2:], 0.1)
    first, last = tracks.seen.argmax(axis=0), len(xy) - 1 - tracks.seen[::-1].argmax(axis=0)
    columns = np.arange(xy.shape[1])
    return float(np.median(np.linalg.norm(xy[last, columns] - xy[first, columns], axis=1)))


def _solve(tracks: _Tracks, motion: _Motion, Ts_imu_cam: Array) -> _Solution:
    """Solve for the first velocity and gravity, the landmarks eliminated.

    A landmark at p, seen at (x, y) from the frame at R, dp, obeys M (Rᵀ(p − v t − ½ g t² − dp) − p_imu_cam) = 0, where
    M = [1 0 −x; 0 1 −y] R_imu_camᵀ. A row is a distance; divided by the landmark's depth it is one in the image.
    """
    V, F = tracks.seen.shape
    R_imu_cam, p_imu_cam = Ts_imu_cam[tracks.camera, :3, :3], Ts_imu_cam[tracks.camera, :3, 3]
    M = np.zeros((V, F, 2, 3))
    M[..., 0, 0] = M[..., 1, 1] = 1.0
    M[..., 2] = -tracks.xy
    M = (M * tracks.seen[..., None, None]) @ np.swapaxes(R_imu_cam, 1, 2)[:, None]
    A = M @ np.swapaxes(motion.R, -1, -2)[:, None]
    b = np.einsum("kfij,kj->kfi", A, motion.dp) + np.einsum("kfij,kj->kfi", M, p_imu_cam)
    t = motion.t_s[:, None, None, None]
    X = np.concatenate([-A * t, -0.5 * A * t**2], axis=-1)
    # One block of 2V rows for each landmark
    A, X, b = (np.moveaxis(Y, 1, 0).reshape(F, 2 * V, *Y.shape[3:]) for Y in (A, X, b))
    pseudo_inverse = np.linalg.solve(np.swapaxes(A, 1, 2) @ A + 1e-9 * np.eye(3), np.swapaxes(A, 1, 2))
    PX, Pb = X - A @ (pseudo_inverse @ X), b - (A @ (pseudo_inverse @ b[..., None]))[..., 0]
    H, h = np.einsum("fri,frj->ij", PX, PX), np.einsum("fri,fr->i", PX, Pb)
    H_vv, H_vg = H[:3, :3], H[:3, 3:]
    D = H[3:, 3:] - H_vg.T @ np.linalg.solve(H_vv, H_vg)
    g = _on_sphere(D, h[3:] - H_vg.T @ np.linalg.solve(H_vv, h[:3]), GRAVITY_M_S2)
    v = np.linalg.solve(H_vv, h[:3] - H_vg @ g)
    x = np.concatenate([v, g])
    landmarks = np.einsum("fir,fr->fi", pseudo_inverse, b - X @ x)
    places = v * motion.t_s[:, None] + 0.5 * g * motion.t_s[:, None] ** 2 + motion.dp
    optical_axes = (motion.R @ R_imu_cam)[..., 2]
    depths = np.einsum("kj,kfj->kf", optical_axes, landmarks - places[:, None])
    depth = (depths * tracks.seen).sum(axis=0) / tracks.seen.sum(axis=0)
    scale = np.maximum(depth, 0.1)[:, None]
    PX_image = PX / scale[..., None]
    covariance = np.linalg.inv(np.einsum("fri,frj->ij", PX_image, PX_image))[:3, :3]
    return _Solution(v, g, covariance, (PX @ x - Pb) / scale, float((depth > 0.1).mean()))


def _on_sphere(D: Array, d: Array, radius: float) -> Array:
    """Return the x (3,) of the given length that minimizes xᵀDx − 2dᵀx.

    It is (D + λI)⁻¹ d, and its length falls with λ from infinity, at minus the smallest eigenvalue, to zero.
    """
    eigenvalues, U = np.linalg.eigh(D)
    c = U.T @ d

    def excess(shift: float) -> float:
        return float(np.sum((c / (eigenvalues - eigenvalues[0] + shift)) ** 2) - radius**2)

    low, high = 1e-9 * float(eigenvalues[-1]), 2.0 * float(np.linalg.norm(d)) / radius + 1e-12
    shift = brentq(excess, low, high) if excess(low) > 0.0 > excess(high) else low
    return np.asarray(U @ (c / (eigenvalues - eigenvalues[0] + shift)))
