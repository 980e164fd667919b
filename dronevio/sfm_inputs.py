"""Inputs of structure from motion besides the images: an earlier reconstruction, and known poses."""

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from dronevio.estimator.sfm.model import KnownPoses
from dronevio.estimator.sfm.placement.world import WorldFrame
from dronevio.eval.metrics.association import interpolate
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.geodesy import AltitudeReference, GeodeticPoint
from dronevio.models.image_sets import ImageSet
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import read_reconstruction
from dronevio.models.reconstructions.colmap import is_colmap
from dronevio.models.recordings.files import read_text
from dronevio.models.recordings.open import read_trajectory

PosesOf = Literal["imu", "camera"]
"""Whose poses a trajectory states."""

MAX_GAP_S = 0.1
"""Longest time between two poses of a trajectory between which it is interpolated [s]."""


@dataclass(frozen=True, eq=False)
class EarlierResult:
    """A reconstruction to which images are added."""

    reconstruction: Reconstruction
    """Cameras, poses and points."""
    world: WorldFrame = field(default_factory=WorldFrame)
    """How its world frame is determined; arbitrary for files that do not say it."""


def read_earlier(path: Path) -> EarlierResult:
    """Read the folder of a result of ``dronevio sfm``, of which the first component is used, or a model of COLMAP.

    Raises:
        InputError: The path is neither, is damaged, or has no images.
    """
    reconstruction = read_reconstruction(path)
    if not reconstruction.image_names:
        raise InputError(path, "points without images", "the result of dronevio sfm, or a model of COLMAP")
    return EarlierResult(reconstruction, read_world(path / "report.json"))


def read_world(report: Path) -> WorldFrame:
    """Return what the report of a result states about its world frame; an arbitrary one if there is no report."""
    try:
        values = json.loads(read_text(report, "the report of a result"))
        is_metric, up, origin = values.get("unit") == "m", values.get("up"), values.get("origin")
        place = None if origin is None else _origin(origin)
    except (InputError, KeyError, ValueError, AttributeError, TypeError):
        return WorldFrame()
    return WorldFrame("earlier" if is_metric else "arbitrary", is_vertical=up == [0.0, 0.0, 1.0], origin=place)


def _origin(values: Any) -> GeodeticPoint:
    """Return the origin of a world frame in a report; a malformed one raises KeyError, TypeError or ValueError."""
    latitude, longitude, altitude = (float(values[name]) for name in ("latitude_deg", "longitude_deg", "altitude_m"))
    if not math.isfinite(latitude + longitude + altitude) or values["reference"] not in get_args(AltitudeReference):
        raise ValueError("a position on Earth is expected")
    return GeodeticPoint(latitude, longitude, altitude, values["reference"])


def read_poses(
    path: Path, images: ImageSet, of: PosesOf | None = None, sigma_m: float = 0.0, sigma_rad: float = 0.0
) -> KnownPoses:
    """Read known poses of images.

    Args:
        path: A model of COLMAP or a result of ``dronevio sfm``, whose images are found by their names, or a trajectory
            (TUM, EuRoC, or a recording with ground truth), which is interpolated at the time stamps of the images.
        images: The images.
        of: Whether a trajectory is that of the IMU, the default where the mounting of the cameras is known, or that of
            the camera.
        sigma_m: Standard deviation of the positions [m]; 0 for exact poses.
        sigma_rad: Standard deviation of the rotations [rad]; 0 for exact poses.

    Raises:
        InputError: The path is none of these, or is damaged.
        ConfigError: A trajectory cannot be assigned to the images, or no image has a pose.
    """
    if not path.exists():
        raise InputError(path, "no such file or folder", "a trajectory, a recording with truth, or a model of COLMAP")
    if _is_model(path):
        if of is not None:
            raise ConfigError(f"{path}: poses of the {of}; a model of COLMAP has those of the cameras")
        Ts_world_cam, is_vertical = _poses_by_name(path, images), False
    else:
        Ts_world_cam, is_vertical = _poses_by_time(path, images, of), True
    known = int(np.isfinite(Ts_world_cam[:, 0, 3]).sum())
    if known < 2:
        raise ConfigError(f"{path}: poses of {known} of the {len(images)} images; expected at least 2")
    return KnownPoses(Ts_world_cam, sigma_rad, sigma_m, is_vertical)


def with_cameras_of(path: Path, images: ImageSet) -> ImageSet:
    """Return images whose cameras without calibration begin with those of the model of COLMAP that has their poses.

    Args:
        path: The poses, see `read_poses`; those of a trajectory have no cameras.
        images: The images.
    """
    if not _is_model(path):
        return images
    model, row = read_reconstruction(path), {name: i for i, name in enumerate(images.names)}
    cameras = list(images.cameras)
    for name, number in zip(model.image_names, model.image_camera.tolist(), strict=True):
        if name not in row:
            continue
        k, known = int(images.image_camera[row[name]]), model.cameras[number]
        has_size = (known.width, known.height) == (cameras[k].width, cameras[k].height)
        if has_size and not images.is_calibrated[k]:
            cameras[k] = known
    return replace(images, cameras=tuple(cameras))


def _is_model(path: Path) -> bool:
    """Return whether a path is a model of COLMAP, or the result of ``dronevio sfm`` with one."""
    return path.is_dir() and any(is_colmap(path / name) for name in ("", "colmap-binary/0", "colmap-text/0"))


def _poses_by_name(path: Path, images: ImageSet) -> Array:
    """Return the poses (I, 4, 4) of the images that a reconstruction has, NaN for the others."""
    reconstruction = read_reconstruction(path)
    row = {name: i for i, name in enumerate(reconstruction.image_names)}
    unknown = np.full((4, 4), np.nan)
    return np.stack([reconstruction.Ts_world_cam[row[n]] if n in row else unknown for n in images.names])


def _poses_by_time(path: Path, images: ImageSet, of: PosesOf | None) -> Array:
    """Return the poses (I, 4, 4) of the images at whose times a trajectory has one, NaN for the others."""
    if images.t_ns is None:
        raise ConfigError(f"{path}: poses with time stamps for images without; expected a model of COLMAP")
    if images.Ts_imu_cam is None and of == "imu":
        raise ConfigError(f"{path}: poses of the IMU, whose mounting is unknown; expected poses of the camera")
    trajectory = read_trajectory(path)
    offset_ns = 0 if images.inertial is None or of == "camera" else round(images.inertial.time_offset_s * 1e9)
    times, row = np.unique(images.t_ns + offset_ns, return_inverse=True)
    found, used = interpolate(trajectory, times, MAX_GAP_S)
    Ts = np.full((len(times), 4, 4), np.nan)
    Ts[used] = found.Ts_world_imu
    Ts = Ts[row]
    return Ts if of == "camera" or images.Ts_imu_cam is None else Ts @ images.Ts_imu_cam[images.image_camera]
