"""The body of a quadrotor in the 3D view: solid at the true pose, as a wireframe at an estimated pose."""

from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.rig import Rig
from dronevio.models.rotation import inverse_pose, pose_matrix

SPAN_M = 0.56
"""Distance between the centres of opposite rotors, plus a rotor, of the body at its own size [m]."""
_HUBS = 0.2 * np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)]) / np.sqrt(2.0)
_ROTOR_RADIUS_M, _ROTOR_HEIGHT_M = 0.08, 0.035
_ROTOR_SIDES = 20
_CORE = ((0.0, 0.0, 0.0), (0.075, 0.05, 0.028))  # centre and half extents [m]
_NOSE = ((0.085, 0.0, 0.0), (0.02, 0.03, 0.018))
_ARM_HALF_M = (0.1, 0.012, 0.009)
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))  # vertex 4 (x > 0) + 2 (y > 0) + (z > 0)
_SIDES = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
_NOSE_LIGHTER, _ROTOR_LIGHTER = 0.75, 0.45  # shares of white in the colour
_SHADES = np.array([0.72, 0.72, 0.82, 0.82, 0.6, 1.0])  # brightness of the sides −x, x, −y, y, −z, z


@dataclass(frozen=True, eq=False)
class DroneBody:
    """Triangles and edges of a quadrotor in the frame of the IMU."""

    triangles: Array
    """(F, 3, 3) Corners of the triangles [m]."""
    lightness: Array
    """(F,) Share of white in the colour of each triangle."""
    shades: Array
    """(F,) Brightness of each triangle."""
    edges: tuple[Array, ...]
    """Polylines (P, 3) of arms, core, nose and rotors [m]."""

    @classmethod
    def of(cls, rig: Rig, span_m: float = SPAN_M) -> Self:
        """Return the body of a drone of a given span [m] with the IMU and the cameras of a rig."""
        scale = span_m / SPAN_M
        T = inverse_pose(_T_vehicle_imu(rig))
        parts = [(_box(*_CORE), 0.0, _SHADES), (_box(*_NOSE), _NOSE_LIGHTER, _SHADES)]
        rotors = []
        angles = np.linspace(0.0, 2.0 * np.pi, _ROTOR_SIDES + 1)
        for x, y in _HUBS:
            yaw = np.arctan2(y, x)
            R = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
            parts.append((_box((0.1, 0.0, 0.0), _ARM_HALF_M) @ R.T, 0.0, _SHADES))
            hub = np.array([x, y, _ROTOR_HEIGHT_M])
            rim = hub + _ROTOR_RADIUS_M * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
            rotors.append(rim)
            disc = np.stack([np.broadcast_to(hub, rim[1:].shape), rim[:-1], rim[1:]], axis=1)
            parts.append((disc, _ROTOR_LIGHTER, np.ones(len(disc))))

        def in_imu(points: Array) -> Array:
            return np.asarray(scale * points @ T[:3, :3].T + T[:3, 3])

        frame = [np.array([(*hub, 0.0), (0.0, 0.0, 0.0)]) for hub in _HUBS]
        frame += [np.array([(*hub, 0.0), (*hub, _ROTOR_HEIGHT_M)]) for hub in _HUBS]
        nose = np.array([(0.075, 0.05, 0.0), (0.13, 0.0, 0.0), (0.075, -0.05, 0.0)])
        return cls(
            in_imu(np.concatenate([triangles for triangles, _, _ in parts])),
            np.concatenate([np.full(len(triangles), lightness) for triangles, lightness, _ in parts]),
            np.concatenate(
                [np.resize(np.repeat(shades, 2), len(t)) if len(t) == 12 else shades for t, _, shades in parts]
            ),
            tuple(in_imu(line) for line in (*frame, nose, *rotors)),
        )

    def colours(self, rgb: tuple[int, int, int]) -> npt.NDArray[np.uint8]:
        """Return the colours (3 F, 3) of the corners of all triangles of a body of a colour."""
        light = self.lightness[:, None]
        mixed = ((1.0 - light) * np.array(rgb) + light * 255.0) * self.shades[:, None]
        return np.repeat(mixed.round().astype(np.uint8), 3, axis=0)


def _box(centre: tuple[float, float, float], half: tuple[float, float, float]) -> Array:
    """Return the triangles (12, 3, 3) of a box, two for each side."""
    sides = (np.array(centre) + _CORNERS * half)[_SIDES]
    return np.stack([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]], axis=1).reshape(-1, 3, 3)


def _T_vehicle_imu(rig: Rig) -> Array:
    """Return the mounting of the IMU; if it is not known, the first camera looks ahead."""
    if not rig.cameras or not np.array_equal(rig.T_vehicle_imu, np.eye(4)):
        return rig.T_vehicle_imu
    R_imu_cam = rig.cameras[0].T_imu_cam[:3, :3]
    R_imu_vehicle = np.stack([R_imu_cam[:, 2], -R_imu_cam[:, 0], -R_imu_cam[:, 1]], axis=1)
    return pose_matrix(R_imu_vehicle.T, np.zeros(3))
