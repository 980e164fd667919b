"""Reconstructions of the images of a recording: names, gray values of the points, and the images as files.

COLMAP, and what starts from its models, such as nerfstudio and gaussian splatting, expect a folder with ``images`` and
``sparse/0``.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.colmap import write_colmap
from dronevio.models.reconstructions.colmap_rigs import RigFrames
from dronevio.models.recordings.files import read_bytes, write_bytes
from dronevio.models.recordings.images import encode_png

Flags = npt.NDArray[np.bool_]

EIGHT_BITS = 8
"""Significant bits of images whose files are copied; those of more bits are written anew."""


@dataclass(frozen=True, eq=False)
class RecordedReconstruction:
    """A reconstruction of images of a recording."""

    reconstruction: Reconstruction
    """The reconstruction; `Reconstruction.image_camera` are the indices of the cameras in the rig of the recording."""
    stamps_ns: Times
    """(C,) Time stamp of the frame of each image [ns]; images of one frame follow each other."""
    Ts_imu_cam: Array | None = None
    """(K, 4, 4) Poses of the cameras in the IMU frame, with which the images of a frame agree; None if unknown."""


def image_name(camera: int, stamp_ns: int) -> str:
    """Return the name of an image by the index of its camera and the time stamp of its frame [ns]."""
    return f"cam{camera}/{stamp_ns}.png"


def with_images(recorded: RecordedReconstruction, recording: Recording, folder: Path | None = None) -> Reconstruction:
    """Return a reconstruction whose points have the mean gray value of the images where they are observed.

    Images have the names of their files below a folder for each camera, ``cam0`` and so on; those of a bag or a video
    keep the names by time stamps. Images that the recording lacks are left out.

    Args:
        recorded: The reconstruction.
        recording: The recording of its images, of which one frame is read at a time.
        folder: Folder in which the images are written with their names; None to write none. Files of 8 bits are copied
            as they are, also coloured ones.

    Raises:
        ConfigError: The recording has no frame at a time of an image.
        InputError: An image cannot be read or written.
    """
    return _with_images(recorded, recording, folder)[0]


def write_colmap_folder(folder: Path, recorded: RecordedReconstruction, recording: Recording) -> None:
    """Write a folder from which programs that read models of COLMAP start: ``images``, and the model in ``sparse/0``.

    The images of one time are a frame of a rig, if the mounting of several cameras is known.

    Args:
        folder: The folder to write to, empty or new.
        recorded: The reconstruction.
        recording: The recording of its images.

    Raises:
        InputError: The folder cannot be written to or contains another model, or an image cannot be read.
        ConfigError: COLMAP does not have the lens of a camera, or the recording has no frame at a time of an image.
    """
    reconstruction, is_kept = _with_images(recorded, recording, folder / "images")
    Ts_imu_cam, rig = recorded.Ts_imu_cam, None
    if Ts_imu_cam is not None and len(Ts_imu_cam) > 1:
        rig = RigFrames(recorded.stamps_ns[is_kept], Ts_imu_cam)
    write_colmap(folder / "sparse" / "0", reconstruction, rig=rig)


def _with_images(
    recorded: RecordedReconstruction, recording: Recording, folder: Path | None
) -> tuple[Reconstruction, Flags]:
    """Return the result of `with_images`, and which images (C,) it has."""
    r = recorded.reconstruction
    by_image = np.argsort(r.observation_image, kind="stable")
    bounds = np.searchsorted(r.observation_image[by_image], np.arange(len(r.image_names) + 1))
    names, gray, is_there = list(r.image_names), np.zeros(len(r.observation_px)), np.zeros(len(r.image_names), np.bool_)
    for i, index, image in _images(recorded, recording):
        is_there[i] = image.size > 0
        if not is_there[i]:
            continue
        rows = by_image[bounds[i] : bounds[i + 1]]
        column, row = np.rint(r.observation_px[rows]).astype(np.int64).T
        gray[rows] = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
        names[i], file = _named(recording, int(r.image_camera[i]), index, names[i])
        if folder is not None:
            content = encode_png(image) if file is None else read_bytes(file, "an image of the recording")
            write_bytes(folder / names[i], content)
    sums = np.bincount(r.observation_point, gray, len(r.points))
    mean = np.rint(sums / np.maximum(r.track_lengths(), 1)).astype(np.uint8)
    coloured = replace(r, image_names=tuple(names), colours=np.repeat(mean[:, None], 3, axis=1))
    return (coloured if is_there.all() else _with_some_images(coloured, is_there)), is_there


def _images(recorded: RecordedReconstruction, recording: Recording) -> Iterator[tuple[int, int, npt.NDArray[np.uint8]]]:
    """Yield each image with its index in a reconstruction and the index of its frame in the recording."""
    frames = np.searchsorted(recording.frame_times_ns, recorded.stamps_ns)
    latest, images = -1, tuple[npt.NDArray[np.uint8], ...]()
    for i, (index, stamp_ns) in enumerate(zip(frames.tolist(), recorded.stamps_ns.tolist(), strict=True)):
        if index == len(recording.frame_times_ns) or recording.frame_times_ns[index] != stamp_ns:
            raise ConfigError(f"{recording.name}: no frame at {stamp_ns} ns; expected the recording of the map")
        if index != latest:
            latest, images = index, recording.frame(index).images
        yield i, index, images[int(recorded.reconstruction.image_camera[i])]


def _named(recording: Recording, camera: int, frame: int, name: str) -> tuple[str, Path | None]:
    """Return the name of an image and the file of which it can be a copy, None without one.

    Where the recording has files, it is the name of the file below a folder of the camera, and otherwise a given one.
    """
    files, bits = getattr(recording, "image_files", None), getattr(recording, "image_bits", None)
    file: Path | None = None if files is None else files[camera][frame]
    if file is None:
        return name, None
    if bits is None or bits[camera] != EIGHT_BITS:
        return f"cam{camera}/{file.stem}.png", None
    return f"cam{camera}/{file.name}", file


def _with_some_images(reconstruction: Reconstruction, is_kept: Flags) -> Reconstruction:
    """Return a reconstruction with some of its images (C,), and the observations in them; its points stay."""
    r, of_kept = reconstruction, is_kept[reconstruction.observation_image]
    return replace(
        r,
        image_names=tuple(name for name, kept in zip(r.image_names, is_kept.tolist(), strict=True) if kept),
        image_camera=r.image_camera[is_kept],
        Ts_world_cam=r.Ts_world_cam[is_kept],
        observation_image=(np.cumsum(is_kept) - 1)[r.observation_image[of_kept]],
        observation_point=r.observation_point[of_kept],
        observation_px=r.observation_px[of_kept],
    )
