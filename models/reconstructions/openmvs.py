"""Reconstructions as scenes of OpenMVS: ``scene.mvs`` in its interface format, and the undistorted images.

OpenMVS has pinhole cameras without distortion. The images are undistorted: with the central focal length of their
camera they extend to the middle of each side, but to 60° from the optical axis at most; pixels that the camera does not
see are black. Pixel centres have integer
coordinates, and rotations map the world frame to the camera frame, whose axes are ours. Source: OpenMVS's
``libs/MVS/Interface.h``; files are of its version 3, which later versions read.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Floats, Image
from dronevio.models.camera import CameraModel
from dronevio.models.depth import Pinhole
from dronevio.models.errors import ConfigError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.parsing import check_image_name
from dronevio.models.recordings.files import write_bytes
from dronevio.models.recordings.images import encode_png, png_name

SCENE = "scene.mvs"
"""Name of the file of cameras, poses and points."""
IMAGES = "images"
"""Name of the folder of the undistorted images."""

_LIMIT = np.tan(np.radians(60.0))  # normalized coordinates beyond are cut off
_VERSION = 3
_LEAST_VIEWS = 2  # OpenMVS takes no points with fewer
_VIEW = np.dtype([("image", "<u4"), ("confidence", "<f4")])  # a confidence of 0 is unknown


@dataclass(frozen=True, eq=False)
class _Views:
    """The points of the scene, those that enough images see: N points with M views, ordered by point and image."""

    points: npt.NDArray[np.int64]
    """(N,) Indices of the points in the reconstruction."""
    images: npt.NDArray[np.int64]
    """(M,) Index of the image of each view."""
    counts: npt.NDArray[np.int64]
    """(N,) Number of views of each point."""


def write_openmvs(
    folder: Path, reconstruction: Reconstruction, read_image: Callable[[str], Image] | None = None
) -> None:
    """Write a scene of OpenMVS. Points that fewer than two images see are left out.

    Args:
        folder: The folder to write to; missing folders are created.
        reconstruction: The reconstruction to write.
        read_image: Returns the image with a name, grey (H, W) or red, green and blue (H, W, 3). The images are written
            undistorted as ``images/NAME.png``. With None, no image is written: ``images`` is expected to have them.

    Raises:
        ConfigError: No images are given, and a camera has distortion.
        InputError: The folder cannot be written to, an image cannot be read or has another size than its camera, or its
            name is not a path below a folder.
    """
    folder, r = Path(folder), reconstruction
    path = folder / SCENE
    for name in r.image_names:
        check_image_name(path, name)
    if read_image is None:
        _check_undistorted(r.cameras)
        files = [f"{IMAGES}/{name}" for name in r.image_names]
    else:
        files = [f"{IMAGES}/{png_name(name)}" for name in r.image_names]
        for number, camera in enumerate(r.cameras):
            map_px = _source_pixels(camera) if _has_distortion(camera) else None  # of one camera at a time
            for i in np.flatnonzero(r.image_camera == number).tolist():
                image = read_image(r.image_names[i])
                write_bytes(folder / files[i], encode_png(image if map_px is None else _undistorted(image, map_px)))
    write_bytes(path, _scene(r, files))


def _has_distortion(camera: CameraModel) -> bool:
    """Return whether a camera is other than a pinhole."""
    return camera.lens != "radtan" or any(camera.distortion)


def _check_undistorted(cameras: Sequence[CameraModel]) -> None:
    """Raise ConfigError if a camera has distortion."""
    distorted = next((i for i, camera in enumerate(cameras) if _has_distortion(camera)), None)
    if distorted is not None:
        raise ConfigError(f"OpenMVS: camera {distorted} has distortion; expected the images, to undistort them")


def _pinhole(camera: CameraModel) -> Pinhole:
    """Return the camera of the undistorted images; a pinhole stays as it is."""
    if not _has_distortion(camera):
        return Pinhole(camera.width, camera.height, camera.K)
    low, high = camera.normalized_bounds(_LIMIT)
    f = np.array(camera.central_focal_px)
    width, height = (max(1, int(n)) for n in np.floor(f * (high - low)))
    cx, cy = -f * low - 0.5
    return Pinhole(width, height, np.array([[f[0], 0.0, cx], [0.0, f[1], cy], [0.0, 0.0, 1.0]]))


def _source_pixels(camera: CameraModel) -> Floats:
    """Return the pixel (H, W, 2) of the camera at each pixel of its pinhole; −2, outside, where it sees none."""
    pixels = camera.project(_pinhole(camera).rays().astype(np.float64))
    return np.where(np.isfinite(pixels), pixels, -2.0).astype(np.float32)


def _undistorted(image: Image, map_px: Floats) -> Image:
    """Return the undistorted image (H, W, …)."""
    import cv2

    u, v = map_px[..., 0], map_px[..., 1]
    undistorted = np.array(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    height, width = image.shape[:2]
    undistorted[(u < -0.5) | (v < -0.5) | (u > width - 0.5) | (v > height - 0.5)] = 0
    return undistorted


def _scene(reconstruction: Reconstruction, files: Sequence[str]) -> bytes:
    """Return the content of the file: platforms, images and points.

    A platform has one camera at its origin; its poses are those of the images of this camera.
    """
    r = reconstruction
    parts = [b"MVSI", np.array([_VERSION, 0], "<u4").tobytes(), _count(len(r.cameras))]
    pose_of_image = np.empty(len(files), np.int64)
    for number, camera in enumerate(map(_pinhole, r.cameras)):
        images = np.flatnonzero(r.image_camera == number)
        pose_of_image[images] = np.arange(len(images))
        parts += [_text(f"camera {number}"), _count(1), _text("")]  # platform, its camera
        parts.append(np.array([camera.width, camera.height], "<u4").tobytes())
        parts += [_numbers(camera.K), _numbers(np.eye(3)), _numbers(np.zeros(3)), _count(len(images))]
        parts += [_numbers(T[:3, :3].T) + _numbers(T[:3, 3]) for T in r.Ts_world_cam[images]]
    parts.append(_count(len(files)))
    for i, file in enumerate(files):
        numbers = (r.image_camera[i], 0, pose_of_image[i], i)  # platform, camera, pose, image
        parts += [_text(file), np.array(numbers, "<u4").tobytes()]
    views = _views(r)
    positions = r.points[views.points].astype("<f4")
    rows = np.zeros(len(views.images), _VIEW)
    rows["image"] = views.images
    parts.append(_count(len(positions)))
    ends = np.cumsum(views.counts).tolist()
    for position, start, end in zip(positions, [0, *ends], ends, strict=False):
        parts += [position.tobytes(), _count(end - start), rows[start:end].tobytes()]
    blue_first = r.colours[views.points][:, ::-1]
    parts += [_count(0), _count(len(positions)), blue_first.tobytes()]  # normals, colours
    parts += [_count(0), _count(0), _count(0), _numbers(np.eye(4))]  # lines, their normals and colours, transformation
    return b"".join(parts)


def _views(reconstruction: Reconstruction) -> _Views:
    """Return the points that enough images see."""
    r = reconstruction
    pairs = np.unique(np.stack([r.observation_point, r.observation_image], axis=1), axis=0)
    counts = np.bincount(pairs[:, 0], minlength=len(r.points)).astype(np.int64)
    is_seen = counts >= _LEAST_VIEWS
    return _Views(np.flatnonzero(is_seen), pairs[is_seen[pairs[:, 0]], 1], counts[is_seen])


def _count(number: int) -> bytes:
    """Return the length of a list."""
    return np.array(number, "<u8").tobytes()


def _text(text: str) -> bytes:
    """Return a text with its length."""
    encoded = text.encode("utf-8")
    return _count(len(encoded)) + encoded


def _numbers(values: Array) -> bytes:
    """Return numbers of double precision, by rows."""
    return np.ascontiguousarray(values, "<f8").tobytes()
