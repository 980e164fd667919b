"""Corrections of a rig's calibration and of gravity, as a vector and as text."""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, pose_matrix

COMMON_PARAMETERS = 2
"""Number of parameters that are not of one camera: time offset, gravity."""
GRAVITY = 1
"""Index of the correction of gravity in the vector of all parameters."""
PARAMETERS_PER_CAMERA = 10
"""Number of parameters of a camera: rotation (3), translation (3), focal lengths (2), principal point (2)."""


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections of time offset, gravity, extrinsics and intrinsics of C cameras, or their standard deviations.

    The vector of all parameters begins with time offset and gravity, followed by the ten parameters of each camera.
    """

    time_offset_s: float
    """Correction of the time offset, t_imu = t_cam + offset [s]."""
    gravity_m_s2: float
    """Correction of the magnitude of gravity [m/s²]."""
    rotation_rad: Array
    """(C, 3) Rotation vectors in the camera frames, applied on the right: R_imu_cam Exp(rotation) [rad]."""
    translation_m: Array
    """(C, 3) Corrections of the camera positions in the IMU frame [m]."""
    focal: Array
    """(C, 2) Relative corrections of fx and fy, applied as fx (1 + focal)."""
    principal: Array
    """(C, 2) Corrections of the principal points in units of fx and fy."""

    @classmethod
    def from_vector(cls, x: Array) -> "Corrections":
        """Return the corrections of a vector (2 + 10 C,) of parameters."""
        rows = x[COMMON_PARAMETERS:].reshape(-1, PARAMETERS_PER_CAMERA)
        return cls(float(x[0]), float(x[GRAVITY]), rows[:, 0:3], rows[:, 3:6], rows[:, 6:8], rows[:, 8:10])

    def applied_to(self, given: Calibration) -> Calibration:
        """Return a given calibration with the corrections applied."""
        Ts = given.Ts_imu_cam @ pose_matrix(exp_so3(self.rotation_rad), np.zeros_like(self.translation_m))
        Ts[:, :3, 3] += self.translation_m
        cameras = (replace(camera, T_imu_cam=T) for camera, T in zip(given.rig.cameras, Ts, strict=True))
        rig, has_intrinsics = replace(given.rig, cameras=tuple(cameras)), self.focal.any() or self.principal.any()
        focal, principal = (self.focal, self.principal) if has_intrinsics else (None, None)
        return Calibration(rig, self.time_offset_s, focal, principal, self.gravity_m_s2)

    def __str__(self) -> str:
        """Return the corrections that are not zero as text, or "none"."""
        parts = [f"time offset {1e3 * self.time_offset_s:+.1f} ms"] if self.time_offset_s else []
        parts += [f"gravity {self.gravity_m_s2:+.3f} m/s²"] if self.gravity_m_s2 else []
        for i in range(len(self.rotation_rad)):
            quantities = (
                ("rotation", np.degrees(self.rotation_rad[i]), 2, "°"),
                ("translation", 1e3 * self.translation_m[i], 0, " mm"),
                ("focal lengths", 1e2 * self.focal[i], 2, " %"),
                ("principal point", 1e3 * self.principal[i], 1, " mrad"),
            )
            parts += [
                f"camera {i} {name} {' '.join(f'{number:+.{digits}f}' for number in values.tolist())}{unit}"
                for name, values, digits, unit in quantities
                if values.any()
            ]
        return ", ".join(parts) or "none"
