"""Depth from a stereo pair: rectification of any lens, and semi-global matching.

Source: Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008.
"""

import cv2
import numpy as np

from dronevio.models.arrays import Array, Floats
from dronevio.models.camera import CameraModel
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.rig import Rig
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import CameraFrame, Estimate

SIGMA_PX = 0.5
"""Standard deviation of the disparity at half the resolution [px]."""
_DISPARITIES = 64
_WINDOW_PX = 5


class StereoDepth:
    """Depth images of a stereo pair at half the resolution of its first camera."""

    def __init__(self, rig: Rig) -> None:
        """Derive the rectification of the first two cameras of a rig."""
        left, right = rig.cameras[:2]
        T_left_right = inverse_pose(left.T_imu_cam) @ right.T_imu_cam
        x = T_left_right[:3, 3] / np.linalg.norm(T_left_right[:3, 3])
        y = np.cross([0.0, 0.0, 1.0], x)
        y /= np.linalg.norm(y)
        R_left_rect = np.stack([x, y, np.cross(x, y)], axis=1)
        self._baseline_m = float(np.linalg.norm(T_left_right[:3, 3]))
        model = left.model
        f = 0.5 * model.central_focal_px[0]
        width, height = model.width // 2, model.height // 2
        self.camera = Pinhole(
            width, height, np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
        )
        self._maps = tuple(
            _rectification(camera, self.camera, R)
            for camera, R in ((left.model, R_left_rect), (right.model, T_left_right[:3, :3].T @ R_left_rect))
        )
        self._T_imu_cam = left.T_imu_cam.copy()
        self._T_imu_cam[:3, :3] = left.T_imu_cam[:3, :3] @ R_left_rect
        self._matcher = cv2.StereoSGBM.create(
            0, _DISPARITIES, _WINDOW_PX, 8 * _WINDOW_PX**2, 32 * _WINDOW_PX**2, 1, 31, 10, 100, 2
        )

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image of a frame at its estimated pose; None without a pose or an image."""
        images = frame.images[:2]
        if estimate.state is None or any(image.size == 0 for image in images):
            return None
        left, right = (
            cv2.remap(image, *maps, cv2.INTER_LINEAR) for image, maps in zip(images, self._maps, strict=True)
        )
        disparity = self._matcher.compute(left, right).astype(np.float32) / 16.0
        known = disparity > 1.0
        fb = np.float32(self.camera.K[0, 0] * self._baseline_m)
        depth = np.where(known, fb / np.where(known, disparity, 1.0), 0.0).astype(np.float32)
        sigma = (depth * depth * np.float32(SIGMA_PX) / fb).astype(np.float32)
        T_odom_cam = np.asarray(estimate.state.T_world_imu @ self._T_imu_cam)
        return DepthImage(frame.t_ns, self.camera, T_odom_cam, depth, sigma, np.asarray(left))


def _rectification(model: CameraModel, camera: Pinhole, R_cam_rect: Array) -> tuple[Floats, Floats]:
    """Return the columns and rows (H, W) of the image of a lens at the pixels of a rectified camera."""
    uv = model.project(camera.rays().astype(np.float64) @ R_cam_rect.T)
    uv = np.where(np.isfinite(uv), uv, -1e4).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])
