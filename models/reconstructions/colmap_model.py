"""The contents of the three files of a sparse model of COLMAP, and their conversion from and to a reconstruction.

Poses map the world frame to the camera frame. Numbers (ids) of cameras, images and points are arbitrary in files; here
they count from 1 in files that are written, and the order of a reconstruction that is read is that of the numbers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.colmap_cameras import PIXEL_SHIFT
from dronevio.models.rotation import inverse_pose, matrix_from_quat_wxyz, pose_matrix, quat_wxyz_from_matrix

Indices = npt.NDArray[np.int64]

NO_POINT = -1
"""Number of the point of a keypoint that observes no point."""


@dataclass(frozen=True, eq=False)
class ColmapCameras:
    """Contents of the file of cameras."""

    ids: Indices
    """(K,) Numbers of the cameras."""
    models: tuple[CameraModel, ...]
    """Camera models (K,), converted to the pixel coordinates of this project."""


@dataclass(frozen=True, eq=False)
class ColmapImages:
    """Contents of the file of images: C images with P keypoints, ordered by image."""

    ids: Indices
    """(C,) Numbers of the images."""
    names: tuple[str, ...]
    """Names of the images (C,)."""
    camera_ids: Indices
    """(C,) Number of the camera of each image."""
    quat_wxyz: Array
    """(C, 4) Rotations from the world frame to the camera frame; not exactly of unit length."""
    p_cam_world: Array
    """(C, 3) Origin of the world frame in the camera frame."""
    keypoint_counts: Indices
    """(C,) Number of keypoints of each image."""
    keypoints_px: Array
    """(P, 2) Keypoints in the pixel coordinates of COLMAP [px]."""
    keypoint_point_ids: Indices
    """(P,) Number of the point that each keypoint observes, or `NO_POINT`."""


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """Contents of the file of points: N points whose tracks have T elements, ordered by point."""

    ids: Indices
    """(N,) Numbers of the points."""
    positions: Array
    """(N, 3) Positions in the world frame."""
    colours: npt.NDArray[np.uint8]
    """(N, 3) Colours: red, green, blue."""
    errors_px: Array
    """(N,) Mean reprojection errors [px]; −1 if unknown."""
    track_lengths: Indices
    """(N,) Number of elements of the track of each point."""
    track_image_ids: Indices
    """(T,) Number of the image of each track element."""
    track_keypoints: Indices
    """(T,) Index of the keypoint in its image of each track element."""

    @classmethod
    def empty(cls) -> Self:
        """Return the contents of a file without points."""
        none = np.empty(0, np.int64)
        return cls(none, np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0), none, none, none)


def reconstruction_from_colmap(
    paths: tuple[Path, Path, Path], cameras: ColmapCameras, images: ColmapImages, points: ColmapPoints
) -> Reconstruction:
    """Return the reconstruction of a sparse model. Keypoints without a point are left out.

    Args:
        paths: The files of cameras, images and points, for error messages.
        cameras: Contents of the file of cameras.
        images: Contents of the file of images.
        points: Contents of the file of points.

    Raises:
        InputError: A number occurs twice or refers to nothing, or the tracks contradict the keypoints.
    """
    cameras_path, images_path, points_path = paths
    camera_order, camera_ids = _sorted_unique(cameras_path, "camera", cameras.ids)
    image_order, image_ids = _sorted_unique(images_path, "image", images.ids)
    point_order, point_ids = _sorted_unique(points_path, "point", points.ids)
    image_camera = _lookup(images_path, "camera", camera_ids, images.camera_ids)
    _check_tracks(points_path, images, points)

    starts = np.cumsum(images.keypoint_counts) - images.keypoint_counts
    counts = images.keypoint_counts[image_order]
    keypoint_order = _ranges(starts[image_order], counts)
    point_id = images.keypoint_point_ids[keypoint_order]
    observed = point_id != NO_POINT
    T_cam_world = pose_matrix(matrix_from_quat_wxyz(images.quat_wxyz), images.p_cam_world)
    return Reconstruction(
        cameras=tuple(cameras.models[i] for i in camera_order),
        image_names=tuple(images.names[i] for i in image_order),
        image_camera=image_camera[image_order],
        Ts_world_cam=inverse_pose(T_cam_world)[image_order],
        points=points.positions[point_order],
        colours=points.colours[point_order],
        observation_image=np.repeat(np.arange(len(image_ids)), counts)[observed],
        observation_point=_lookup(images_path, "point", point_ids, point_id[observed]),
        observation_px=images.keypoints_px[keypoint_order][observed] - PIXEL_SHIFT,
    )


def colmap_from_reconstruction(reconstruction: Reconstruction) -> tuple[ColmapCameras, ColmapImages, ColmapPoints]:
    """Return the contents of the three files of a sparse model.

    The observations of an image are its keypoints, in the order of the reconstruction.
    """
    r = reconstruction
    by_image = np.argsort(r.observation_image, kind="stable")
    image, point = r.observation_image[by_image], r.observation_point[by_image]
    counts = np.bincount(image, minlength=len(r.image_names)).astype(np.int64)
    keypoint = np.arange(len(image)) - (np.cumsum(counts) - counts)[image]
    by_point = np.argsort(point, kind="stable")
    T_cam_world = inverse_pose(r.Ts_world_cam)
    cameras = ColmapCameras(_count_from_1(len(r.cameras)), r.cameras)
    images = ColmapImages(
        ids=_count_from_1(len(r.image_names)),
        names=r.image_names,
        camera_ids=r.image_camera + 1,
        quat_wxyz=quat_wxyz_from_matrix(T_cam_world[:, :3, :3]),
        p_cam_world=T_cam_world[:, :3, 3],
        keypoint_counts=counts,
        keypoints_px=r.observation_px[by_image] + PIXEL_SHIFT,
        keypoint_point_ids=point + 1,
    )
    points = ColmapPoints(
        ids=_count_from_1(len(r.points)),
        positions=r.points,
        colours=r.colours,
        errors_px=_mean_errors_px(r),
        track_lengths=r.track_lengths(),
        track_image_ids=image[by_point] + 1,
        track_keypoints=keypoint[by_point],
    )
    return cameras, images, points


def _mean_errors_px(reconstruction: Reconstruction) -> Array:
    """Return the mean reprojection error (N,) of each point [px]; −1 for a point that projects into no image."""
    errors = reconstruction.reprojection_errors_px()
    finite = np.isfinite(errors)
    point = reconstruction.observation_point[finite]
    n = len(reconstruction.points)
    count = np.bincount(point, minlength=n)
    total = np.bincount(point, weights=errors[finite], minlength=n)
    return np.where(count > 0, total / np.maximum(count, 1), -1.0)


def _check_tracks(path: Path, images: ColmapImages, points: ColmapPoints) -> None:
    """Check that the tracks of the points consist of the keypoints that observe them.

    Raises:
        InputError: A track element is no such keypoint, or the numbers of both differ.
    """
    expected = "tracks that agree with the points of the images"
    order = np.argsort(images.ids, kind="stable")
    image = order[_lookup(path, "image", images.ids[order], points.track_image_ids)]
    index = points.track_keypoints
    starts = np.cumsum(images.keypoint_counts) - images.keypoint_counts
    point_id = np.repeat(points.ids, points.track_lengths)
    valid = (index >= 0) & (index < images.keypoint_counts[image])
    valid[valid] = images.keypoint_point_ids[(starts[image] + index)[valid]] == point_id[valid]
    wrong = np.flatnonzero(~valid)
    if wrong.size:
        i = wrong[0]
        found = f"point {point_id[i]} with keypoint {index[i]} of image {points.track_image_ids[i]}"
        raise InputError(path, f"{found}, which does not observe it", expected)
    observed = int(np.count_nonzero(images.keypoint_point_ids != NO_POINT))
    if len(index) != observed:
        raise InputError(path, f"{len(index)} track elements for {observed} observations", expected)


def _sorted_unique(path: Path, what: str, ids: Indices) -> tuple[Indices, Indices]:
    """Return the order that sorts numbers (N,), and the sorted numbers.

    Raises:
        InputError: A number occurs twice, or is negative.
    """
    order = np.argsort(ids, kind="stable")
    ordered = ids[order]
    repeated = ordered[1:][ordered[1:] == ordered[:-1]]
    if repeated.size:
        raise InputError(path, f"{what} {repeated[0]} twice", f"one {what} of each number")
    if ordered.size and ordered[0] < 0:
        raise InputError(path, f"{what} {ordered[0]}", f"a {what} number from 0 to 2⁶³ − 1")
    return order, ordered


def _lookup(path: Path, what: str, sorted_ids: Indices, ids: Indices) -> Indices:
    """Return the indices (M,) of numbers (M,) in sorted numbers (N,).

    Raises:
        InputError: A number is not among the sorted ones.
    """
    index = np.searchsorted(sorted_ids, ids)
    known = index < len(sorted_ids)
    known[known] = sorted_ids[index[known]] == ids[known]
    missing = ids[~known]
    if missing.size:
        raise InputError(path, f"a reference to {what} {missing[0]}, which does not exist", f"an existing {what}")
    return index.astype(np.int64)


def _ranges(starts: Indices, counts: Indices) -> Indices:
    """Return the concatenation of the ranges that begin at starts (C,) and have lengths (C,)."""
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(np.repeat(starts, counts) + within, dtype=np.int64)


def _count_from_1(n: int) -> Indices:
    """Return the numbers from 1 to n."""
    return np.arange(1, n + 1, dtype=np.int64)
