"""Reprojection errors of observations by cameras with any lens, and their derivatives.

A point P appears to a camera with rotation R and position p at the pixel π(Rᵀ(P − p)). The pose is moved by a step
(ω, v) in the frame of the camera: R Exp(ω), p + R v. Derivatives of π are central differences, which are exact to eight
digits and the same for all lenses.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import exp_so3

Indices = npt.NDArray[np.int64]

BLOCK = 6
"""Number of variables of a pose, and of a camera, whose intrinsics are padded."""
_STEP = 1e-5  # of the differences, relative to the distance of a point
_COEFFICIENT_STEP = 1e-6  # of a distortion coefficient


@dataclass(frozen=True, eq=False)
class Variables:
    """What a bundle adjustment estimates."""

    Ts_world_cam: Array
    """(I, 4, 4) Poses of the images."""
    points: Array
    """(T, 3) Points."""
    cameras: tuple[CameraModel, ...]
    """(K,) Cameras."""

    def moved(self, poses: Array, points: Array, intrinsics: Array) -> "Variables":
        """Return the variables after a step.

        Args:
            poses: (I, 6) Rotation vector and translation of each image in its own frame.
            points: (T, 3) Steps of the points.
            intrinsics: (K, 6) Steps of the focal length and of the distortion coefficients of each camera, padded.
        """
        Ts, R = self.Ts_world_cam.copy(), self.Ts_world_cam[:, :3, :3]
        Ts[:, :3, :3] = R @ exp_so3(poses[:, :3])
        Ts[:, :3, 3] += np.einsum("nij,nj->ni", R, poses[:, 3:])
        cameras = tuple(
            with_intrinsics(camera, intrinsics_of(camera) + step[: len(intrinsics_of(camera))])
            if step.any()
            else camera
            for camera, step in zip(self.cameras, intrinsics, strict=True)
        )
        return Variables(Ts, self.points + points, cameras)


@dataclass(frozen=True, eq=False)
class Observations:
    """M observations of T points in I images by K cameras."""

    image: Indices
    """(M,) Image of each observation."""
    point: Indices
    """(M,) Point of each observation."""
    camera: Indices
    """(M,) Camera of each observation."""
    pixels: Array
    """(M, 2) Observed pixels."""
    sigma_px: Array
    """(M,) Standard deviation of each coordinate [px]."""


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Derivatives of the residuals in standard deviations."""

    pose: Array
    """(M, 2, 6) By the step of the pose."""
    point: Array
    """(M, 2, 3) By the point."""
    intrinsics: Array
    """(M, 2, 6) By focal length and distortion coefficients; 0 for those that are not estimated."""


def intrinsics_of(camera: CameraModel) -> Array:
    """Return the focal length along x [px] and the distortion coefficients (1 + C,) of a camera."""
    return np.array([camera.fx, *camera.distortion])


def with_intrinsics(camera: CameraModel, values: Array) -> CameraModel:
    """Return a camera with other `intrinsics_of`; both focal lengths are the same."""
    f, *distortion = values.tolist()
    return replace(camera, fx=f, fy=f, distortion=tuple(distortion))


def residuals(observations: Observations, x: Variables) -> Array:
    """Return the residuals (M, 2) in standard deviations; NaN where a camera does not see its point."""
    return _projected(observations, x, _in_camera(observations, x)) - _scaled(observations, observations.pixels)


def derivatives(observations: Observations, x: Variables, estimated: Indices) -> Derivatives:
    """Return the derivatives of `residuals`; NaN where those are.

    Args:
        observations: The observations.
        x: The variables.
        estimated: (K,) Number of `intrinsics_of` each camera that are estimated, from the first on.
    """
    p = _in_camera(observations, x)
    step = _STEP * np.linalg.norm(p, axis=1)
    D = np.empty((len(p), 2, 3))
    for axis in range(3):
        shift = np.zeros_like(p)
        shift[:, axis] = step
        difference = _projected(observations, x, p + shift) - _projected(observations, x, p - shift)
        D[..., axis] = difference / (2.0 * step[:, None])
    R = x.Ts_world_cam[observations.image, :3, :3]
    by_pose = np.concatenate([np.cross(D, p[:, None]), -D], axis=2)
    return Derivatives(by_pose, D @ np.swapaxes(R, 1, 2), _by_intrinsics(observations, x, p, estimated))


def _by_intrinsics(observations: Observations, x: Variables, p: Array, estimated: Indices) -> Array:
    """Return the derivatives (M, 2, 6) by the intrinsics of points (M, 3) in the camera frames."""
    result = np.zeros((len(p), 2, BLOCK))
    for parameter in range(int(estimated.max(initial=0))):
        rows: Mask = estimated[observations.camera] > parameter
        pixels = []
        for sign in (1.0, -1.0):
            cameras = []
            for camera, count in zip(x.cameras, estimated.tolist(), strict=True):
                values = intrinsics_of(camera)
                if count > parameter:
                    values[parameter] += sign * _intrinsic_step(camera, parameter)
                    cameras.append(with_intrinsics(camera, values))
                else:
                    cameras.append(camera)
            pixels.append(_projected(observations, replace(x, cameras=tuple(cameras)), p))
        steps = np.array([_intrinsic_step(camera, parameter) for camera in x.cameras])[observations.camera[rows]]
        result[rows, :, parameter] = (pixels[0] - pixels[1])[rows] / (2.0 * steps[:, None])
    return result


def _intrinsic_step(camera: CameraModel, parameter: int) -> float:
    return _STEP * camera.fx if parameter == 0 else _COEFFICIENT_STEP


def _in_camera(observations: Observations, x: Variables) -> Array:
    """Return the points (M, 3) of the observations in the frames of their cameras."""
    T = x.Ts_world_cam[observations.image]
    return np.asarray(np.einsum("nji,nj->ni", T[:, :3, :3], x.points[observations.point] - T[:, :3, 3]))


def _projected(observations: Observations, x: Variables, p: Array) -> Array:
    """Return the pixels (M, 2) of points (M, 3) in the frames of the cameras, in standard deviations."""
    pixels = np.empty((len(p), 2))
    for k in np.unique(observations.camera).tolist():
        rows = slice(None) if len(x.cameras) == 1 else observations.camera == k
        pixels[rows] = x.cameras[k].project(p[rows])
    return _scaled(observations, pixels)


def _scaled(observations: Observations, pixels: Array) -> Array:
    return np.asarray(pixels / observations.sigma_px[:, None])
