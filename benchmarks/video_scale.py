"""What the IMU of a video knows of its scale: structure from motion against the accelerometer, over windows of time.

The path of the images, whose scale is unknown, is fitted to the double integral of the specific force, with initial
position and velocity, gravity and the accelerometer's bias unknown as well. A window does not show the scale where
another one fits nearly as well: the table has the distance between both for a quarter and for twice the true scale, in
millimetres and in pixels at the median distance of the points.

    benchmarks/video_scale.py VIDEO --calibration camera.yaml --positions position_enu.csv

The positions are rows of time since 1.5e9 s, east, north and up.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import dronevio as dv
from dronevio.models.arrays import Array
from dronevio.models.image_sets.recording import image_recording
from dronevio.models.imu import ImuSamples
from dronevio.models.imu_presets import imu_named
from dronevio.models.recordings.open import open_recording
from dronevio.models.rotation import exp_so3, log_so3

START_S = 1.5e9
WINDOWS_S = ((0.0, 1.5), (0.0, 3.0), (1.0, 4.0), (2.0, 5.0), (0.0, 4.0), (0.0, 5.5), (0.0, 11.0))


@dataclass(frozen=True)
class Command:
    """Compare the scale of a video by its IMU with that of known positions."""

    video: tyro.conf.Positional[Path]
    """Video with telemetry."""
    calibration: tuple[Path, ...]
    """Calibration of the camera."""
    positions: Path
    """Positions of the camera: time, east, north, up."""
    every: int = 5
    """Distance between the frames that are used."""
    last: int = 345
    """Last frame that is used."""
    imu: str = "MPU-6050"
    """IMU whose noise is assumed."""


def similarity(source: Array, target: Array) -> tuple[float, float]:
    """Return the scale that aligns positions (N, 3) with others, and the remaining error [m] (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    D = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    scale = float((S * D).sum() / (a**2).sum())
    error = scale * a @ (U @ np.diag(D) @ Vt).T - b
    return scale, float(np.sqrt((error**2).sum(axis=1).mean()))


def inertial_path(t_s: Array, Ts_world_cam: Array, R_imu_cam: Array, imu: ImuSamples) -> Array:
    """Return the double integral (M, 3) of the specific force, turned into the world, at the times (M,) of frames."""
    imu_s = imu.t_ns * 1e-9
    near = (imu_s >= t_s[0]) & (imu_s <= t_s[-1])
    first = Ts_world_cam[0, :3, :3]
    turns = log_so3(first.T @ Ts_world_cam[:, :3, :3])
    turn = np.stack([np.interp(imu_s[near], t_s, axis) for axis in turns.T], axis=1)
    force = np.einsum("nij,nj->ni", first @ exp_so3(turn), imu.accel_m_s2[near] @ R_imu_cam)
    path = force
    for _ in range(2):
        steps = 0.5 * (path[1:] + path[:-1]) * np.diff(imu_s[near])[:, None]
        path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return np.stack([np.interp(t_s, imu_s[near], axis) for axis in path.T], axis=1)


def fit(t_s: Array, positions: Array, integral: Array, scale: float | None = None) -> tuple[float, float]:
    """Return the scale of positions (M, 3), and the remaining error [m] with it or with a given one.

    The unknowns are the scale, and per axis the initial position and velocity, and gravity with the bias.
    """
    tau = t_s - t_s[0]
    polynomials = np.kron(np.stack([np.ones_like(tau), tau, 0.5 * tau**2], axis=1), np.eye(3))
    columns = np.column_stack([positions.ravel(), polynomials])
    target = integral.ravel()
    if scale is not None:
        columns, target = polynomials, target - scale * positions.ravel()
    solution = np.linalg.lstsq(columns, target, rcond=None)[0]
    error = (target - columns @ solution).reshape(-1, 3)
    return float(solution[0]) if scale is None else scale, float(np.sqrt((error**2).sum(axis=1).mean()))


def main(command: Command) -> None:
    """Print the table."""
    recording = open_recording(command.video, calibration=command.calibration, imu=imu_named(command.imu))
    images = image_recording(recording, frames=range(0, command.last + 1, command.every))
    result = dv.sfm(images).reconstructions[0]
    t_s = np.array([int(name.rpartition("/")[2]) for name in result.image_names]) * 1e-9
    order = np.argsort(t_s)
    t_s, poses = t_s[order], result.Ts_world_cam[order]
    known = np.loadtxt(command.positions, delimiter=",")
    known = known[(known[:, 0] - START_S >= t_s[0]) & (known[:, 0] - START_S <= t_s[-1])]
    at_known = np.stack([np.interp(known[:, 0] - START_S, t_s, axis) for axis in poses[:, :3, 3].T], axis=1)
    true_scale, error_m = similarity(at_known, known[:, 1:])
    depth = np.array([np.median(((result.points - T[:3, 3]) @ T[:3, 2]) * true_scale) for T in poses])
    focal_px = recording.rig.cameras[0].model.fx
    print(f"{len(t_s)} of {len(images)} images, {error_m:.2f} m from the positions after a similarity")
    print("window [s]   scale by IMU / by positions   error [mm]   at 1/4 of the scale [mm] [px]   at twice [mm] [px]")
    for start_s, end_s in WINDOWS_S:
        rows = np.flatnonzero((t_s >= start_s) & (t_s <= end_s) & (t_s >= recording.imu.t_ns[0] * 1e-9))
        times, positions = t_s[rows], poses[rows, :3, 3] * true_scale
        integral = inertial_path(times, poses[rows], recording.rig.cameras[0].T_imu_cam[:3, :3], recording.imu)
        scale, error = fit(times, positions, integral)
        others = [fit(times, positions, integral, factor)[1] for factor in (0.25, 2.0)]
        pixels = [focal_px * other / float(np.median(depth[rows])) for other in others]
        print(
            f"{start_s:4.1f} – {end_s:4.1f}   {scale:27.3f}   {1e3 * error:10.1f}"
            f"   {1e3 * others[0]:17.1f} {pixels[0]:12.2f}   {1e3 * others[1]:10.1f} {pixels[1]:7.2f}"
        )


if __name__ == "__main__":
    main(tyro.cli(Command, description=__doc__))
