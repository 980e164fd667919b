"""Depth from a stereo pair: semi-global matching, a step of least squares, and rejection of what is not certain.

The matcher (Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008) returns the
disparity of a pixel to a part of a pixel; `dronevio.estimator.mapping.refinement` improves it, tells its standard
deviation, and finds the windows at which a depth is not to be trusted.
"""

import math

import cv2
import numpy as np

from dronevio.estimator.mapping.camera_pose import delay_s, pose_after
from dronevio.estimator.mapping.occlusion import occluded
from dronevio.estimator.mapping.rectification import Rectification
from dronevio.estimator.mapping.refinement import least_squares_step
from dronevio.estimator.mapping.rejection import borrowed, edges, slopes, speckles, variance_around
from dronevio.models.arrays import Floats, Image
from dronevio.models.depth import DepthImage
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate

NEAREST_M = 0.4
"""Smallest depth that is searched [m]."""
FLOOR_PX = 0.06
"""Standard deviation of the disparity by calibration and interpolation [px]."""
MAX_SIGMA_PX = 0.6
"""Largest standard deviation of a disparity that is used [px]."""
MAX_STEP_PX = 0.8
"""Largest step from the disparity of the matcher [px]."""
LEAST_MARGIN_PX = 3.0
"""Disparity by which a surface in an explained hole may be nearer than the one beside it: with less, poles of 2 cm were
falsely free beside other edges [px]."""
MATCH_BLOCK_PX = 5
_SMALL_PENALTY, _LARGE_PENALTY = 8, 64  # of the matcher, for each pixel of a block
_UNIQUENESS, _CONSISTENCY_PX = 25, 1
_SPECKLE_PX, _SPECKLE_RANGE_PX = 300, 1
_FIXED = 16.0  # the matcher returns sixteenths


class StereoDepth:
    """Depth images of a rectified pair; a `DepthSource`."""

    def __init__(self, rig: Rig, pair: Rectification) -> None:
        """Take a rig and the rectification of two of its cameras."""
        self._rig = rig
        self._pair = pair
        nearest = math.ceil(pair.fb / NEAREST_M / 16.0) * 16
        self._disparities = int(np.clip(nearest, 16, max(16, pair.camera.width // 16 * 16)))
        block = MATCH_BLOCK_PX**2
        self._matcher = cv2.StereoSGBM.create(
            0,
            self._disparities,
            MATCH_BLOCK_PX,
            _SMALL_PENALTY * block,
            _LARGE_PENALTY * block,
            _CONSISTENCY_PX,
            31,
            _UNIQUENESS,
            _SPECKLE_PX,
            _SPECKLE_RANGE_PX,
            cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        self._masks = [map_.mask.astype(np.uint8) for map_ in pair.maps]
        self._columns, self._rows = np.meshgrid(
            np.arange(pair.camera.width, dtype=np.float32), np.arange(pair.camera.height, dtype=np.float32)
        )

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image of the left camera of a frame; None without a state or one of the images.

        The cameras are exposed at the same time; see `dronevio.estimator.mapping.depth_source` where they are not.
        """
        pair = self._pair
        if estimate.state is None or any(frame.images[k].size == 0 for k in (pair.left, pair.right)):
            return None
        left, right = (map_.apply(frame.images[k]) for k, map_ in zip((pair.left, pair.right), pair.maps, strict=True))
        disparity, sigma = self.disparity(left, right)
        known = disparity > 0.0
        depth = np.divide(np.float32(pair.fb), disparity, out=np.zeros_like(disparity), where=known)
        sigma_m = np.where(known, depth * depth * sigma / np.float32(pair.fb), np.float32(0.0))
        T_odom_imu = pose_after(estimate.state, delay_s(self._rig, frame, pair.left))
        most = occluded(disparity)
        least = np.where(most > 0.0, np.float32(pair.fb) / (most + np.float32(LEAST_MARGIN_PX)), np.float32(0.0))
        return DepthImage(frame.t_ns, pair.camera, T_odom_imu @ pair.T_imu_left, depth, sigma_m, left, least)

    def disparity(self, left: Image, right: Image) -> tuple[Floats, Floats]:
        """Return the disparities (H, W) and their standard deviations (H, W) of rectified images [px]; 0 for unknown.

        Args:
            left: (H, W) Left image.
            right: (H, W) Right image.
        """
        right = self._equalised(left, right)
        coarse = self._matched(left, right)
        known = (coarse > 0.0) & (coarse < self._disparities - 2)  # what is nearer is matched to the last ones
        warped = self._warped(right, coarse)
        grey = left.astype(np.float32)
        gradient = np.float32(-0.5) * (_derivative(grey) + _derivative(warped))
        step, sigma = least_squares_step(grey, warped, gradient)
        disparity = coarse + step
        known &= (disparity > 0.0) & (np.abs(step) <= MAX_STEP_PX) & (sigma <= MAX_SIGMA_PX)
        # A match outside the right image is none
        in_right = cv2.remap(self._masks[1], self._columns - disparity, self._rows, cv2.INTER_NEAREST)
        known &= (np.asarray(in_right) > 0) & (self._masks[0] > 0)
        # A depth counts where the pixel, and not what is beside it, tells it
        zero = np.float32(0.0)
        slope = slopes(coarse)
        known &= ~edges(np.where(known, coarse, zero), coarse, slope)
        known &= ~borrowed(np.where(known, disparity, zero), gradient * gradient)
        known &= ~speckles(np.where(known, disparity, zero))
        disparity = np.where(known, disparity, zero)
        variance = sigma * sigma + variance_around(disparity, coarse, slope) + np.float32(FLOOR_PX**2)
        return disparity, np.where(known, np.sqrt(variance), zero)

    def _matched(self, left: Image, right: Image) -> Floats:
        """Return the disparities (H, W) of the matcher [px]; not more than 0 where there is none."""
        D = self._disparities  # the matcher leaves out as many columns on the left
        padded = [cv2.copyMakeBorder(image, 0, 0, D, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
        return np.asarray(self._matcher.compute(*padded)[:, D:].astype(np.float32) / np.float32(_FIXED))

    def _equalised(self, left: Image, right: Image) -> Image:
        """Return the right image with the mean and the contrast of the left one: the exposures may differ."""
        (m, s), (n, t) = (
            [float(value[0, 0]) for value in cv2.meanStdDev(image, mask=mask)]
            for image, mask in zip((left, right), self._masks, strict=True)
        )
        gain = float(np.clip(s / t, 0.5, 2.0)) if t > 0.0 else 1.0
        return np.asarray(cv2.addWeighted(right, gain, right, 0.0, m - gain * n))

    def _warped(self, right: Image, disparity: Floats) -> Floats:
        """Return the right image (H, W) warped into the left one by disparities."""
        columns = self._columns - disparity
        image = right.astype(np.float32)
        return np.asarray(cv2.remap(image, columns, self._rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _derivative(image: Floats) -> Floats:
    """Return the derivative (H, W) along the rows, by central differences."""
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE))
