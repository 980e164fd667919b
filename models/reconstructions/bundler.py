"""Reconstructions as files of Bundler, version 0.3: one text file with cameras and points, and a list of the images.

Bundler's camera looks along −z with y up. Its pixel coordinates have their origin at the image centre and y up. The
projection of a point (x, y, z) in the camera frame is f (1 + k1 r² + k2 r⁴) p with p = −(x, y) / z and r = |p|: that of
our ``radtan`` with equal focal lengths and the principal point at the image centre. Source: Snavely, Bundler v0.4
User's Manual, 2009.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.parsing import (
    LARGEST_IMAGE_PX,
    LARGEST_NUMBER,
    Indices,
    check_image_name,
    check_image_size,
    check_numbers,
    colours_from_numbers,
    nearest_valid_rotations,
    parse_integers,
    truncated,
)
from dronevio.models.recordings.files import as_input_error, read_text, write_text
from dronevio.models.rotation import inverse_pose, pose_matrix

HEADER = "# Bundle file v0.3"
"""First line of a file."""

_CAMERA_NUMBERS = 15  # f, k1, k2, the rows of R, t
_POINT_NUMBERS = 7  # position, colour, number of observations
_VIEW_NUMBERS = 4  # camera, keypoint, x, y
_FLIP_YZ = np.diag([1.0, -1.0, -1.0])  # between a camera with y up that looks along −z and ours
_CENTRE_TOLERANCE_PX = 1e-6


@dataclass(frozen=True, eq=False)
class _Contents:
    """Numbers of a file: C cameras, N points, M observations."""

    cameras: Array
    """(C, 15) Numbers f, k1, k2, R by rows and t of each camera; zeros if it is not registered."""
    points: Array
    """(N, 6) Position and colour of each point."""
    view_point: Indices
    """(M,) Index of the point of each observation."""
    view_camera: Indices
    """(M,) Index of the camera of each observation."""
    view_px: Array
    """(M, 2) Observations from the image centre, x right and y up [px]."""


def read_bundler(
    path: Path, image_list: Path | None = None, image_sizes: Sequence[tuple[int, int]] | None = None
) -> Reconstruction:
    """Read a file of Bundler. Cameras that are not registered (with focal length 0) are left out.

    The file contains no image sizes. Where they are not given, the size of an image is the smallest that contains all
    observations of the images with the same focal length and distortion. Because Bundler's pixel coordinates begin at
    the image centre, an unknown size changes the pixels of the observations, but not their reprojection errors.

    Args:
        path: The file, usually ``bundle.out``.
        image_list: File with the name of an image at the beginning of each line. By default, it is the first that
            exists of ``NAME.list.txt`` and ``list.txt`` in the folder of ``NAME.out`` or ``NAME.bundle.out``; images
            without a list are named after their position.
        image_sizes: Width and height of all images [px], also of those that are not registered.

    Raises:
        InputError: A file is missing, damaged or truncated, or has another version.
        ConfigError: The number of image sizes differs from that of the cameras.
    """
    path = Path(path)
    contents = _parse(path, read_text(path, "a file of Bundler"))
    n = len(contents.cameras)
    list_path = image_list if image_list is not None else _default_list(path)
    names = [f"image{i:06d}" for i in range(n)] if list_path is None else _read_list(Path(list_path), n)
    sizes = _smallest_sizes(path, contents) if image_sizes is None else [(int(w), int(h)) for w, h in image_sizes]
    if len(sizes) != n:
        raise ConfigError(f"{path}: {len(sizes)} image sizes; expected one for each of {n} cameras")
    registered = np.flatnonzero(contents.cameras[:, 0])
    new_index = np.full(n, -1)
    new_index[registered] = np.arange(len(registered))
    observation_image = new_index[contents.view_camera]
    if np.any(observation_image < 0):
        camera = contents.view_camera[observation_image < 0][0]
        raise InputError(path, f"an observation in camera {camera}, which is not registered", "a registered camera")
    models = [_camera(path, contents.cameras[i], sizes[i]) for i in registered]
    distinct = {model: i for i, model in enumerate(dict.fromkeys(models))}
    numbers = contents.cameras[registered]
    R_cam_world = _FLIP_YZ @ nearest_valid_rotations(path, numbers[:, 3:12].reshape(-1, 3, 3))
    centre = _centres(np.array([sizes[i] for i in registered], np.int64).reshape(-1, 2))
    return Reconstruction(
        cameras=tuple(distinct),
        image_names=tuple(names[i] for i in registered),
        image_camera=np.array([distinct[model] for model in models], np.int64),
        Ts_world_cam=inverse_pose(pose_matrix(R_cam_world, numbers[:, 12:] @ _FLIP_YZ)),
        points=contents.points[:, :3],
        colours=colours_from_numbers(path, contents.points[:, 3:]),
        observation_image=observation_image,
        observation_point=contents.view_point,
        observation_px=contents.view_px * [1.0, -1.0] + centre[observation_image],
    )


def write_bundler(path: Path, reconstruction: Reconstruction) -> None:
    """Write a file of Bundler, and beside it the list of the images: ``NAME.list.txt`` for ``NAME.out``.

    Args:
        path: The file to write.
        reconstruction: The reconstruction to write.

    Raises:
        ConfigError: A camera is not one of Bundler, or the name of an image contains a space.
        InputError: A file cannot be written, or the name of an image is not a path below a folder.
    """
    path, r = Path(path), reconstruction
    for i, camera in enumerate(r.cameras):
        check_bundler_camera(i, camera)
    for name in r.image_names:
        if len(check_image_name(path, name).split()) != 1:
            raise ConfigError(f"Bundler: image name {name!r}; expected a name without spaces")
    intrinsics = np.array([(c.fx, *c.distortion[:2]) for c in r.cameras]).reshape(-1, 3)[r.image_camera]
    T_cam_world = inverse_pose(r.Ts_world_cam)
    R, t = _FLIP_YZ @ T_cam_world[:, :3, :3], T_cam_world[:, :3, 3] @ _FLIP_YZ
    lines = [HEADER, f"{len(r.image_names)} {len(r.points)}"]
    for i in range(len(r.image_names)):
        lines += [_text(row) for row in (intrinsics[i], *R[i], t[i])]

    sizes = np.array([(c.width, c.height) for c in r.cameras], np.int64).reshape(-1, 2)[r.image_camera]
    px = (r.observation_px - _centres(sizes)[r.observation_image]) * [1.0, -1.0]
    keypoint = _ranks(r.observation_image, len(r.image_names))
    order = np.argsort(r.observation_point, kind="stable")
    images, keypoints, pixels = r.observation_image[order].tolist(), keypoint[order].tolist(), px[order].tolist()
    views = [f"{i} {k} {x!r} {y!r}" for i, k, (x, y) in zip(images, keypoints, pixels, strict=True)]
    start = 0
    for position, colour, count in zip(r.points, r.colours.tolist(), r.track_lengths().tolist(), strict=True):
        lines += [_text(position), " ".join(map(str, colour))]
        lines.append(" ".join([str(count), *views[start : start + count]]))
        start += count
    write_text(path.with_suffix(".list.txt"), "".join(f"{name}\n" for name in r.image_names))
    write_text(path, "\n".join(lines) + "\n")


def _parse(path: Path, text: str) -> _Contents:
    """Return the numbers of a file.

    Raises:
        InputError: The file has another version, or is damaged or truncated.
    """
    header, _, body = text.partition("\n")
    if header.strip() != HEADER:
        raise InputError(path, repr(header[:40]), f"the first line {HEADER!r}", 1)
    fields = body.split()
    try:
        values = list(map(float, fields))
    except ValueError:
        raise _first_text_error(path, body) from None
    if len(values) < 2:
        raise truncated(path, "no numbers of cameras and points", 2)
    n_cameras, n_points = parse_integers(path, fields[:2], 2).tolist()
    n_numbers = 2 + n_cameras * _CAMERA_NUMBERS + n_points * _POINT_NUMBERS
    if min(n_cameras, n_points) < 0 or n_numbers > len(values):
        raise truncated(path, f"{len(values)} numbers for {n_cameras} cameras and {n_points} points")

    starts, counts = [], []
    offset = first = 2 + n_cameras * _CAMERA_NUMBERS
    for i in range(n_points):
        starts.append(offset)
        left = len(values) - offset - _POINT_NUMBERS
        if left < 0:
            raise truncated(path, f"the end of the file within point {i}", _line_of_field(body, len(values) - 1))
        count = values[offset + _POINT_NUMBERS - 1]
        if not (0 <= count * _VIEW_NUMBERS <= left and count == int(count)):
            line = _line_of_field(body, offset + _POINT_NUMBERS - 1)
            raise truncated(path, f"{left} numbers after point {i} with {count:g} observations", line)
        counts.append(int(count))
        offset += _POINT_NUMBERS + _VIEW_NUMBERS * counts[-1]
    if offset != len(values):
        raise InputError(path, f"{len(values) - offset} numbers after the last point", "the end of the file")

    numbers = np.array(values)
    wrong = np.flatnonzero(~(np.abs(numbers) <= LARGEST_NUMBER))
    if wrong.size:
        check_numbers(path, numbers[wrong], line=_line_of_field(body, int(wrong[0])))
    is_point = np.zeros(len(numbers), np.bool_)
    is_point[np.add.outer(np.array(starts, np.int64), np.arange(_POINT_NUMBERS)).reshape(-1)] = True
    views = numbers[first:][~is_point[first:]].reshape(-1, _VIEW_NUMBERS)
    if np.any((views[:, 0] != np.floor(views[:, 0])) | (views[:, 0] < 0) | (views[:, 0] >= n_cameras)):
        raise InputError(path, "an observation in a camera that does not exist", f"cameras 0 to {n_cameras - 1}")
    return _Contents(
        cameras=numbers[2:first].reshape(-1, _CAMERA_NUMBERS),
        points=numbers[is_point].reshape(-1, _POINT_NUMBERS)[:, :6],
        view_point=np.repeat(np.arange(n_points), counts),
        view_camera=views[:, 0].astype(np.int64),
        view_px=views[:, 2:],
    )


def _camera(path: Path, numbers: Array, size_px: tuple[int, int]) -> CameraModel:
    """Return the camera model of the numbers (15,) of a camera."""
    f, k1, k2 = numbers[:3].tolist()
    check_image_size(path, *size_px)
    cx, cy = _centres(np.array(size_px)).tolist()
    with as_input_error(path):
        return CameraModel(*size_px, f, f, cx, cy, (k1, k2, 0.0, 0.0))


def check_bundler_camera(index: int, camera: CameraModel) -> None:
    """Check that a camera is one of Bundler.

    Raises:
        ConfigError: The camera has another lens, unequal focal lengths, tangential distortion, or a principal point
            that is not the image centre.
    """
    where = f"Bundler: camera {index} has"
    if camera.lens != "radtan":
        raise ConfigError(f"{where} the lens {camera.lens}; expected radtan, or the format of COLMAP")
    if any(camera.distortion[2:]):
        raise ConfigError(f"{where} tangential distortion or k3 to k6; expected none, or the format of COLMAP")
    if not np.isclose(camera.fx, camera.fy, rtol=1e-12, atol=0.0):
        raise ConfigError(f"{where} focal lengths {camera.fx} and {camera.fy} px; expected equal ones")
    centre = _centres(np.array([camera.width, camera.height]))
    if not np.allclose([camera.cx, camera.cy], centre, rtol=0.0, atol=_CENTRE_TOLERANCE_PX):
        found = f"the principal point ({camera.cx}, {camera.cy}) px"
        raise ConfigError(f"{where} {found}; expected the image centre, {tuple(centre.tolist())}")


def _centres(sizes_px: Indices) -> Array:
    """Return the image centres (…, 2) of image sizes (…, 2) [px]."""
    return np.asarray((sizes_px - 1) / 2.0)


def _smallest_sizes(path: Path, contents: _Contents) -> list[tuple[int, int]]:
    """Return the smallest image sizes that contain the observations, equal for images with equal f, k1 and k2."""
    _, group = np.unique(contents.cameras[:, :3], axis=0, return_inverse=True)
    group = group.reshape(-1)
    extents = np.zeros((len(contents.cameras), 2))
    np.maximum.at(extents, group[contents.view_camera], np.abs(contents.view_px))
    largest = extents.max(initial=0.0)
    if 2.0 * largest > LARGEST_IMAGE_PX:
        raise InputError(path, f"an observation at {largest:g} px", f"images of up to {LARGEST_IMAGE_PX} px")
    sizes = np.maximum(np.ceil(2.0 * extents), 1.0).astype(np.int64)[group]
    return [(width, height) for width, height in sizes.tolist()]


def _default_list(path: Path) -> Path | None:
    """Return the list of images that belongs to a file, None if there is none."""
    stem = path.stem.removesuffix(".bundle")
    for name in (f"{path.stem}.list.txt", f"{stem}.list.txt", "list.txt"):
        if path.with_name(name).is_file():
            return path.with_name(name)
    return None


def _read_list(path: Path, n: int) -> list[str]:
    """Return the names of n images.

    Raises:
        InputError: The file cannot be read, has another number of rows, or a name is no path below a folder.
    """
    text = read_text(path, "a list of images")
    rows = [(line, row) for line, row in enumerate(text.split("\n"), 1) if row.strip()]
    if len(rows) != n:
        raise InputError(path, f"{len(rows)} images", f"one for each of {n} cameras")
    return [check_image_name(path, row.split()[0], line) for line, row in rows]


def _first_text_error(path: Path, body: str) -> InputError:
    """Return the error about the first field that is not a number."""
    for line, row in enumerate(body.split("\n"), 2):
        for field in row.split():
            try:
                float(field)
            except ValueError:
                return InputError(path, repr(field[:40]), "a number", line)
    return InputError(path, "a field that is not a number", "numbers")


def _line_of_field(body: str, index: int) -> int:
    """Return the line number of a field, given its index behind the header."""
    count = 0
    for line, row in enumerate(body.split("\n"), 2):
        count += len(row.split())
        if count > index:
            return line
    return 2


def _ranks(groups: Indices, n: int) -> Indices:
    """Return for each of M elements how many earlier ones belong to the same of n groups."""
    order = np.argsort(groups, kind="stable")
    counts = np.bincount(groups, minlength=n)
    ranks = np.empty(len(groups), np.int64)
    ranks[order] = np.arange(len(groups)) - np.repeat(np.cumsum(counts) - counts, counts)
    return ranks


def _text(values: Array) -> str:
    """Return numbers as text without loss of precision, separated by spaces."""
    return " ".join(map(repr, values.tolist()))
