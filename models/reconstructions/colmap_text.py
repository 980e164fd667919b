"""Text files of a sparse model of COLMAP: ``cameras.txt``, ``images.txt`` and ``points3D.txt``.

Source: https://colmap.github.io/format.html.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.reconstructions.colmap_cameras import camera_from_colmap, camera_to_colmap
from dronevio.models.reconstructions.colmap_model import ColmapCameras, ColmapImages, ColmapPoints
from dronevio.models.reconstructions.parsing import (
    Indices,
    check_image_name,
    check_unit_quaternion,
    colours_from_numbers,
    parse_integers,
    parse_numbers,
    truncated,
)
from dronevio.models.recordings.files import read_text, write_text
from dronevio.models.recordings.timed_table import numbered_rows

_CAMERA_ROW = "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
_IMAGE_ROW = "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
_KEYPOINTS_ROW = "POINTS2D[] as (X, Y, POINT3D_ID)"
_POINT_ROW = "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"


def read_cameras_text(path: Path) -> ColmapCameras:
    """Read ``cameras.txt``.

    Raises:
        InputError: The file is missing or damaged, or has a camera model that is not supported.
    """
    ids, models = [], []
    for line, row in numbered_rows(read_text(path, "the cameras of a COLMAP model")):
        fields = row.split()
        if len(fields) < 4:
            raise InputError(path, f"{len(fields)} fields", _CAMERA_ROW, line)
        camera_id, width, height = parse_integers(path, [fields[0], *fields[2:4]], line).tolist()
        parameters = parse_numbers(path, fields[4:], line).tolist()
        ids.append(camera_id)
        models.append(camera_from_colmap(path, camera_id, fields[1], (width, height), parameters, line))
    return ColmapCameras(np.array(ids, np.int64), tuple(models))


def read_images_text(path: Path) -> ColmapImages:
    """Read ``images.txt``. The row of the keypoints of the last image may be missing if it has none.

    Raises:
        InputError: The file is missing or damaged.
    """
    integers, poses, names, keypoints, point_ids = [], [], [], [], []
    for line, row, keypoint_row in _image_rows(read_text(path, "the images of a COLMAP model")):
        fields = row.split(maxsplit=9)
        if len(fields) < 10:
            raise InputError(path, f"{len(fields)} fields", _IMAGE_ROW, line)
        integers.append(parse_integers(path, [fields[0], fields[8]], line))
        poses.append(parse_numbers(path, fields[1:8], line))
        check_unit_quaternion(path, poses[-1][:4], line=line)
        names.append(check_image_name(path, fields[9], line))
        fields = keypoint_row.split()
        if len(fields) % 3:
            raise truncated(path, f"{len(fields)} fields instead of {_KEYPOINTS_ROW}", line + 1)
        keypoints.append(np.stack([parse_numbers(path, fields[k::3], line + 1) for k in (0, 1)], axis=1))
        point_ids.append(parse_integers(path, fields[2::3], line + 1))
    ids = np.array(integers, np.int64).reshape(-1, 2)
    pose = np.array(poses, np.float64).reshape(-1, 7)
    return ColmapImages(
        ids=ids[:, 0],
        names=tuple(names),
        camera_ids=ids[:, 1],
        quat_wxyz=pose[:, :4],
        p_cam_world=pose[:, 4:],
        keypoint_counts=np.array([len(k) for k in keypoints], np.int64),
        keypoints_px=np.concatenate([np.empty((0, 2)), *keypoints]),
        keypoint_point_ids=_concatenated(point_ids),
    )


def read_points_text(path: Path) -> ColmapPoints:
    """Read ``points3D.txt``.

    Raises:
        InputError: The file is missing or damaged.
    """
    ids, values, errors, tracks, lines = [], [], [], [], []
    for line, row in numbered_rows(read_text(path, "the points of a COLMAP model")):
        fields = row.split()
        if len(fields) < 8 or len(fields) % 2:
            raise truncated(path, f"{len(fields)} fields instead of {_POINT_ROW}", line)
        ids.append(parse_integers(path, fields[:1], line))
        values.append(parse_numbers(path, fields[1:7], line))
        errors.append(parse_numbers(path, fields[7:8], line, finite=False)[0])
        tracks.append(parse_integers(path, fields[8:], line))
        lines.append(line)
    value = np.array(values, np.float64).reshape(-1, 6)
    elements = _concatenated(tracks).reshape(-1, 2)
    return ColmapPoints(
        ids=_concatenated(ids),
        positions=value[:, :3],
        colours=colours_from_numbers(path, value[:, 3:], lines),
        errors_px=np.array(errors, np.float64),
        track_lengths=np.array([len(track) // 2 for track in tracks], np.int64),
        track_image_ids=elements[:, 0],
        track_keypoints=elements[:, 1],
    )


def write_cameras_text(path: Path, cameras: ColmapCameras) -> None:
    """Write ``cameras.txt``.

    Raises:
        InputError: The file cannot be written.
    """
    rows = [
        "# Camera list with one line of data per camera:",
        f"#   {_CAMERA_ROW}",
        f"# Number of cameras: {len(cameras.models)}",
    ]
    for camera_id, model in zip(cameras.ids.tolist(), cameras.models, strict=True):
        name, parameters = camera_to_colmap(model)
        rows.append(f"{camera_id} {name} {model.width} {model.height} {_text(np.array(parameters))}")
    write_text(path, "\n".join(rows) + "\n")


def write_images_text(path: Path, images: ColmapImages) -> None:
    """Write ``images.txt``.

    Raises:
        InputError: The file cannot be written.
    """
    n, mean = len(images.names), _mean(images.keypoint_counts)
    rows = [
        "# Image list with two lines of data per image:",
        f"#   {_IMAGE_ROW}",
        f"#   {_KEYPOINTS_ROW}",
        f"# Number of images: {n}, mean observations per image: {mean}",
    ]
    poses = np.hstack([images.quat_wxyz, images.p_cam_world])
    ends = np.cumsum(images.keypoint_counts).tolist()
    start = 0
    for i, end in enumerate(ends):
        keypoints = zip(
            images.keypoints_px[start:end].tolist(), images.keypoint_point_ids[start:end].tolist(), strict=True
        )
        rows.append(f"{images.ids[i]} {_text(poses[i])} {images.camera_ids[i]} {images.names[i]}")
        rows.append(" ".join(f"{x!r} {y!r} {point}" for (x, y), point in keypoints))
        start = end
    write_text(path, "\n".join(rows) + "\n")


def write_points_text(path: Path, points: ColmapPoints) -> None:
    """Write ``points3D.txt``.

    Raises:
        InputError: The file cannot be written.
    """
    rows = [
        "# 3D point list with one line of data per point:",
        f"#   {_POINT_ROW}",
        f"# Number of points: {len(points.ids)}, mean track length: {_mean(points.track_lengths)}",
    ]
    elements = np.stack([points.track_image_ids, points.track_keypoints], axis=1).reshape(-1)
    tracks = np.split(elements, 2 * np.cumsum(points.track_lengths)[:-1]) if len(points.ids) else []
    columns = zip(
        points.ids.tolist(),
        points.positions.tolist(),
        points.colours.tolist(),
        points.errors_px.tolist(),
        tracks,
        strict=True,
    )
    for point_id, (x, y, z), (red, green, blue), error, track in columns:
        fields = [point_id, repr(x), repr(y), repr(z), red, green, blue, repr(error), *track.tolist()]
        rows.append(" ".join(map(str, fields)))
    write_text(path, "\n".join(rows) + "\n")


def _image_rows(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield line number and text of the first row of each image, and the text of its second row, which may be empty."""
    lines = enumerate(text.split("\n"), 1)
    for line, row in lines:
        stripped = row.strip()
        if stripped and stripped[0] != "#":
            yield line, stripped, next(lines, (0, ""))[1]


def _concatenated(parts: list[Indices]) -> Indices:
    """Return the concatenation of arrays, of which there may be none."""
    return np.concatenate([np.empty(0, np.int64), *parts])


def _mean(counts: Indices) -> float:
    """Return the mean of counts, 0 if there are none."""
    return float(counts.mean()) if len(counts) else 0.0


def _text(values: Array) -> str:
    """Return numbers as text without loss of precision, separated by spaces."""
    return " ".join(map(repr, values.tolist()))
