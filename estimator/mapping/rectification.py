"""Rectification of a pair of cameras with any lenses: both images on one plane, whose rows are epipolar lines.

Source: Fusiello, Trucco and Verri, "A compact algorithm for rectification of stereo pairs", MVA 2000, with lenses of
any model, whose images are sampled at the rays of two pinholes.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from dronevio.models.arrays import Array, Floats, Image, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.depth import Pinhole
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import inverse_pose

MAX_ANGLE_DEG = 55.0
"""Largest angle from the rectified optical axis that is kept, horizontally and vertically [deg]."""
MAX_SIDE_PX = 480
"""Largest side of the images, which are reduced by a whole number [px]."""
MIN_SIDE_TANGENT = 0.15
"""Smallest extent of the view that both cameras share, to either side of its middle, at depth 1."""
MAX_SLANT_DEG = 50.0
"""Largest angle between the optical axis of a camera and the rectified one [deg]."""
_SAMPLES = 129  # on each axis of the view, from which its bounds are taken


@dataclass(frozen=True, eq=False)
class PinholeMap:
    """Map from the pixels of a pinhole to those of the image of a lens, which is reduced by a whole number first."""

    size: tuple[int, int]
    """Width and height of the reduced image [px]."""
    u: Floats
    """(H, W) Columns in the reduced image [px]."""
    v: Floats
    """(H, W) Rows in the reduced image [px]."""
    mask: Mask
    """(H, W) True where the pixel lies in the image."""

    @classmethod
    def of(cls, model: CameraModel, camera: Pinhole, R_cam_pinhole: Array, reduction: int = 1) -> "PinholeMap":
        """Return the map of a lens to a pinhole that is turned against it."""
        pixels = _pixels(model, camera.rays().astype(np.float64) @ R_cam_pinhole.T)
        inside = np.isfinite(pixels[..., 0])
        size = max(1, model.width // reduction), max(1, model.height // reduction)
        reduced = (pixels + 0.5) * (np.array(size) / [model.width, model.height]) - 0.5
        u, v = np.moveaxis(np.where(inside[..., None], reduced, 0.0).astype(np.float32), -1, 0)
        return cls(size, np.ascontiguousarray(u), np.ascontiguousarray(v), inside)

    def apply(self, image: Image) -> Image:
        """Return the image (H, W) of the pinhole of an image of the lens."""
        if (image.shape[1], image.shape[0]) != self.size:
            image = np.asarray(cv2.resize(image, self.size, interpolation=cv2.INTER_AREA))
        return np.asarray(cv2.remap(image, self.u, self.v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


@dataclass(frozen=True, eq=False)
class Rectification:
    """A rectified pair: a point at depth z lies by its disparity f b / z farther left in the right image."""

    left: int
    """Index of the left camera in the rig."""
    right: int
    """Index of the right camera."""
    camera: Pinhole
    """Camera of both images."""
    baseline_m: float
    """Distance b of the cameras [m]."""
    T_imu_left: Array
    """(4, 4) Pose of the rectified left camera in the IMU frame."""
    maps: tuple[PinholeMap, PinholeMap]
    """Maps of the left and the right image."""

    @property
    def fb(self) -> float:
        """Product of focal length and baseline [px m]."""
        return float(self.camera.K[0, 0]) * self.baseline_m


def rectified_pair(rig: Rig) -> Rectification | None:
    """Return the rectification of the two cameras of a rig that share the largest view; None if no pair shares one."""
    count = len(rig.cameras)
    found = [pair for i in range(count) for j in range(i + 1, count) if (pair := _rectified(rig.cameras, i, j))]
    return max(found, key=lambda pair: (pair.maps[0].mask & pair.maps[1].mask).sum() * pair.fb, default=None)


def _rectified(cameras: tuple[RigCamera, ...], first: int, second: int) -> Rectification | None:
    """Return the rectification of two cameras; None if they do not share a view beside each other."""
    left, right = first, second
    T_left_right = inverse_pose(cameras[left].T_imu_cam) @ cameras[right].T_imu_cam
    if T_left_right[0, 3] < 0.0:  # the rectified image is upright
        left, right, T_left_right = right, left, inverse_pose(T_left_right)
    baseline_m = float(np.linalg.norm(T_left_right[:3, 3]))
    if baseline_m < 1e-3:
        return None
    # Axes: x along the baseline, z as close as possible to both optical axes
    x = T_left_right[:3, 3] / baseline_m
    axes = np.stack([np.array([0.0, 0.0, 1.0]), T_left_right[:3, 2]])
    z = axes.sum(axis=0) - (axes.sum(axis=0) @ x) * x
    if np.linalg.norm(z) < 1e-6:
        return None
    z /= np.linalg.norm(z)
    if np.any(axes @ z < math.cos(math.radians(MAX_SLANT_DEG))):
        return None
    R_left = np.stack([x, np.cross(z, x), z], axis=1)
    R_right = T_left_right[:3, :3].T @ R_left
    models = cameras[left].model, cameras[right].model
    # Bounds: what both cameras see far away, on the central row and column
    limit = math.tan(math.radians(MAX_ANGLE_DEG))
    t = np.linspace(-limit, limit, _SAMPLES)
    centre = _shared_centre(models, (R_left, R_right), t)
    if centre is None:
        return None
    low, high = np.empty(2), np.empty(2)
    for axis in (0, 1):
        rays = np.ones((_SAMPLES, 3))
        rays[:, :2] = centre
        rays[:, axis] = t
        seen = _seen(models, (R_left, R_right), rays)
        low[axis], high[axis] = _run_around(t, seen, centre[axis])
    if np.any(high - low < 2.0 * MIN_SIDE_TANGENT):
        return None
    # The focal length is that of the coarser camera, divided by a whole number
    focal = min(min(model.central_focal_px) for model in models)
    reduction = max(1, math.ceil(focal * float((high - low).max()) / MAX_SIDE_PX))
    f = focal / reduction
    width, height = (int(n) for n in np.floor(f * (high - low)))
    K = np.array([[f, 0.0, -f * low[0] - 0.5], [0.0, f, -f * low[1] - 0.5], [0.0, 0.0, 1.0]])
    camera = Pinhole(width, height, K)
    maps = (
        PinholeMap.of(models[0], camera, R_left, reduction),
        PinholeMap.of(models[1], camera, R_right, reduction),
    )
    T_imu_left = cameras[left].T_imu_cam.copy()
    T_imu_left[:3, :3] = T_imu_left[:3, :3] @ R_left
    return Rectification(left, right, camera, baseline_m, T_imu_left, maps)


def _pixels(model: CameraModel, rays: Array) -> Array:
    """Return the pixels (…, 2) of rays (…, 3) in the image of a lens; NaN outside the image."""
    pixels = model.project(rays)
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels >= -0.5) & (pixels <= [model.width - 0.5, model.height - 0.5]), axis=-1)
    return np.where(inside[..., None], pixels, np.nan)


def _seen(models: tuple[CameraModel, CameraModel], rotations: tuple[Array, Array], rays: Array) -> Mask:
    """Return whether both cameras see rays (…, 3) of the rectified camera."""
    first, second = (
        np.isfinite(_pixels(model, rays @ R.T)[..., 0]) for model, R in zip(models, rotations, strict=True)
    )
    return np.asarray(first & second)


def _shared_centre(models: tuple[CameraModel, CameraModel], rotations: tuple[Array, Array], t: Array) -> Array | None:
    """Return the middle (2,) of the view that both cameras share, at depth 1; None without one."""
    x, y = np.meshgrid(t[::4], t[::4])
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    shared = rays[_seen(models, rotations, rays)][:, :2]
    return np.asarray(shared.mean(axis=0)) if len(shared) else None


def _run_around(t: Array, seen: Mask, middle: float) -> tuple[float, float]:
    """Return the first and the last of the values (N,) around a middle that are seen; the middle twice if it is not."""
    at = int(np.argmin(np.abs(t - middle)))
    if not seen[at]:
        return middle, middle
    before, after = np.flatnonzero(~seen[:at]), np.flatnonzero(~seen[at:])
    return float(t[before[-1] + 1] if len(before) else t[0]), float(t[at + after[0] - 1] if len(after) else t[-1])
