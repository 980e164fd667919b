"""Corrections of a rig's calibration and of gravity, as a vector and as text."""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.estimator.intrinsics import IntrinsicCorrections
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import exp_so3, pose_matrix

COMMON_PARAMETERS = 3
"""Number of parameters that are not of one camera: time offset, gravity, scale of the gyroscope."""
GRAVITY = 1
"""Index of the correction of gravity in the vector of all parameters."""
GYRO_SCALE = 2
"""Index of that of the gyroscope's scale."""
PARAMETERS_PER_CAMERA = 10
"""Number of parameters of a camera: rotation (3), translation (3), focal length, principal point (2), distortion."""


MEAN_RADIUS2 = 0.3
"""Mean squared radius of image observations, by which a radial distortion acts as a focal length does."""
MEAN_COORDINATE = 0.4
"""Root mean square of a normalized image coordinate."""
ROWS_PER_CAMERA = 2
"""Number of rows of a camera in the matrix of `inverse_depth_errors`."""
MIN_PARALLEL, MIN_BASELINE_M = 0.5, 1e-3
"""Smallest cosine between the axes of two cameras, and smallest distance across these [m], that measure depths."""


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections of time offset, gravity, extrinsics and intrinsics of C cameras, or their standard deviations.

    The vector of all parameters begins with time offset, gravity and scale of the gyroscope, followed by the ten
    parameters of each camera.
    """

    time_offset_s: float
    """Correction of the time offset, t_imu = t_cam + offset [s]."""
    gravity_m_s2: float
    """Correction of the magnitude of gravity [m/s²]."""
    gyro_scale: float
    """Relative correction of the gyroscope's scale; an unknown of the adjustments that is not applied."""
    rotation_rad: Array
    """(C, 3) Rotation vectors in the camera frames, applied on the right: R_imu_cam Exp(rotation) [rad]."""
    translation_m: Array
    """(C, 3) Corrections of the camera positions in the IMU frame [m]."""
    focal: Array
    """(C, 1) Relative corrections of the focal lengths; see `IntrinsicCorrections`."""
    principal: Array
    """(C, 2) Corrections of the principal points in units of fx and fy."""
    radial: Array
    """(C, 1) Corrections of the first radial coefficient of the distortion; see `IntrinsicCorrections`."""

    @classmethod
    def from_vector(cls, x: Array) -> "Corrections":
        """Return the corrections of a vector (3 + 10 C,) of parameters."""
        rows = x[COMMON_PARAMETERS:].reshape(-1, PARAMETERS_PER_CAMERA)
        of_camera = np.split(rows, [3, 6, 7, 9], axis=1)
        return cls(float(x[0]), float(x[GRAVITY]), float(x[GYRO_SCALE]), *of_camera)

    def intrinsics(self, models: tuple[CameraModel, ...]) -> IntrinsicCorrections:
        """Return the corrections of the intrinsics of the C given cameras."""
        return IntrinsicCorrections(self.focal[:, 0], self.principal, self.radial[:, 0], models)

    def applied_to(self, given: Calibration) -> Calibration:
        """Return a given calibration with the corrections applied."""
        Ts = given.Ts_imu_cam @ pose_matrix(exp_so3(self.rotation_rad), np.zeros_like(self.translation_m))
        Ts[:, :3, 3] += self.translation_m
        cameras = (replace(camera, T_imu_cam=T) for camera, T in zip(given.rig.cameras, Ts, strict=True))
        has_intrinsics = any(part.any() for part in (self.focal, self.principal, self.radial))
        return Calibration(
            replace(given.rig, cameras=tuple(cameras)),
            self.time_offset_s,
            self.intrinsics(given.models) if has_intrinsics else None,
            self.gravity_m_s2,
        )

    def __str__(self) -> str:
        """Return the corrections that are not zero as text, or "none"."""
        parts = [f"time offset {1e3 * self.time_offset_s:+.1f} ms"] if self.time_offset_s else []
        parts += [f"gravity {self.gravity_m_s2:+.3f} m/s²"] if self.gravity_m_s2 else []
        for i in range(len(self.rotation_rad)):
            quantities = (
                ("rotation", np.degrees(self.rotation_rad[i]), 2, "°"),
                ("translation", 1e3 * self.translation_m[i], 0, " mm"),
                ("focal length", 1e2 * self.focal[i], 2, " %"),
                ("principal point", 1e3 * self.principal[i], 1, " mrad"),
                ("radial distortion", self.radial[i], 4, ""),
            )
            parts += [
                f"camera {i} {name} {' '.join(f'{number:+.{digits}f}' for number in values.tolist())}{unit}"
                for name, values, digits, unit in quantities
                if values.any()
            ]
        return ", ".join(parts) or "none"


def seen_errors(size: int) -> Array:
    """Return what the first camera shows of errors of a vector of parameters, a matrix (6, size).

    Time offset, and its view; see `view_errors`.
    """
    A = np.zeros((6, size))
    A[0, 0] = 1.0
    A[1:] = view_errors(size, 0)
    return A


def view_errors(size: int, camera: int) -> Array:
    """Return what a camera shows of errors of a vector of parameters, a matrix (5, size).

    Rotation of the view about each axis, focal length, and radial distortion. A principal point that is wrong by c
    turns the view as a rotation by (c_y, -c_x, 0) does.
    """
    A, first = np.zeros((5, size)), COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * camera
    A[:3, first : first + 3] = np.eye(3)
    A[0, first + 8], A[1, first + 7] = 1.0, -1.0
    A[3, first + 6] = A[4, first + 9] = 1.0
    return A


def inverse_depth_errors(given: Calibration) -> Array:
    """Return what errors of a vector of D parameters add to inverse depths by stereo [1/m], a matrix (2 C, D).

    Each camera has two rows. It is compared with the earlier one whose axis is most parallel: by the relative rotation
    of their views about the axis across the baseline, and by the root mean square over the image of what their focal
    lengths and distortions differ by. Cameras that share no view with an earlier one have zeros.
    """
    Rs, p = given.Ts_imu_cam[:, :3, :3], given.Ts_imu_cam[:, :3, 3]
    size = COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * len(Rs)
    A = np.zeros((ROWS_PER_CAMERA * len(Rs), size))
    for j in range(1, len(Rs)):
        i = int(np.argmax(Rs[:j, :, 2] @ Rs[j, :, 2]))
        across = np.cross(p[j] - p[i], Rs[i, :, 2])
        length_m = float(np.linalg.norm(across))
        if Rs[i, :, 2] @ Rs[j, :, 2] < MIN_PARALLEL or length_m < MIN_BASELINE_M:
            continue
        of_i, of_j = view_errors(size, i), view_errors(size, j)
        A[ROWS_PER_CAMERA * j] = across @ (Rs[j] @ of_j[:3] - Rs[i] @ of_i[:3]) / length_m**2
        A[ROWS_PER_CAMERA * j + 1] = MEAN_COORDINATE * ((of_j - of_i)[3] + MEAN_RADIUS2 * (of_j - of_i)[4]) / length_m
    return A
