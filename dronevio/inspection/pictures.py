"""Images of a recording for the page: as they are, undistorted, and a pair with its matches."""

import base64

import cv2
import numpy as np

from dronevio.inspection.flow import Flow
from dronevio.models.arrays import Image
from dronevio.models.camera import CameraModel

WIDTH_PX = 560
"""Width of an image on the page [px]."""
GRID_LINES = 8
"""Number of vertical lines on an undistorted image, by which straight edges can be judged."""
MATCHES = 120
"""Largest number of matches that are drawn."""
_LINE = (80, 200, 255)  # BGR


def undistorted(image: Image, model: CameraModel) -> Image:
    """Return an image (H, W) as a pinhole of the same focal length sees it; black where the lens has no ray."""
    u, v = np.meshgrid(np.arange(model.width), np.arange(model.height))
    rays = np.stack([(u - model.cx) / model.fx, (v - model.cy) / model.fy, np.ones_like(u, np.float64)], axis=-1)
    pixels = np.nan_to_num(model.project(rays), nan=-1e4).astype(np.float32)
    return np.asarray(cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR), np.uint8)


def picture(image: Image, grid: bool = False) -> str:
    """Return an image (H, W) or (H, W, 3) BGR as JPEG in base64, reduced for the page, with straight lines if asked."""
    shown = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    height = round(shown.shape[0] * WIDTH_PX / shown.shape[1])
    shown = cv2.resize(shown, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    if grid:
        for k in range(1, GRID_LINES):
            x, y = k * WIDTH_PX // GRID_LINES, k * height // GRID_LINES
            cv2.line(shown, (x, 0), (x, height), _LINE, 1)
            cv2.line(shown, (0, y), (WIDTH_PX, y), _LINE, 1)
    _, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 78])
    return base64.b64encode(data.tobytes()).decode("ascii")


def with_matches(image: Image, flow: Flow) -> Image:
    """Return an image (H, W, 3) BGR of matches: lines from each feature to its position in the other image."""
    shown = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    chosen = np.linspace(0, len(flow.pixels[0]) - 1, min(MATCHES, len(flow.pixels[0]))).astype(int)
    for start, end in zip(flow.pixels[0][chosen], flow.pixels[1][chosen], strict=True):
        a, b = (tuple(np.rint(p).astype(int).tolist()) for p in (start, end))
        cv2.line(shown, a, b, _LINE, 2, cv2.LINE_AA)
        cv2.circle(shown, b, 4, (60, 110, 255), -1, cv2.LINE_AA)
    return np.asarray(shown, np.uint8)
