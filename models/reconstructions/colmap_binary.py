"""Binary files of a sparse model of COLMAP: ``cameras.bin``, ``images.bin`` and ``points3D.bin``, little endian.

Source: COLMAP's ``src/colmap/scene/reconstruction_io_utils.cc`` and ``scripts/python/read_write_model.py``.
"""

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.reconstructions.colmap_cameras import (
    MODEL_IDS,
    PARAMETERS,
    camera_from_colmap,
    camera_to_colmap,
    check_supported,
    model_name,
)
from dronevio.models.reconstructions.colmap_model import ColmapCameras, ColmapImages, ColmapPoints
from dronevio.models.reconstructions.parsing import (
    ByteReader,
    check_image_name,
    check_numbers,
    check_unit_quaternion,
    truncated,
)
from dronevio.models.recordings.files import read_bytes, write_bytes

_CAMERA = np.dtype([("id", "<u4"), ("model", "<i4"), ("width", "<u8"), ("height", "<u8")])
_IMAGE = np.dtype([("id", "<u4"), ("quat_wxyz", "<f8", 4), ("p_cam_world", "<f8", 3), ("camera_id", "<u4")])
_KEYPOINT = np.dtype([("px", "<f8", 2), ("point_id", "<i8")])  # −1 is 2⁶⁴ − 1, which marks a keypoint without a point
_POINT = np.dtype([("id", "<i8"), ("position", "<f8", 3), ("colour", "u1", 3), ("error_px", "<f8"), ("length", "<u8")])
_TRACK = np.dtype([("image_id", "<u4"), ("keypoint", "<u4")])
_SMALLEST_CAMERA = _CAMERA.itemsize + 3 * 8
_SMALLEST_IMAGE = _IMAGE.itemsize + 1 + 8
_LENGTH = struct.Struct("<Q")


def read_cameras_binary(path: Path) -> ColmapCameras:
    """Read ``cameras.bin``.

    Raises:
        InputError: The file is missing or damaged, or has a camera model that is not supported.
    """
    reader = ByteReader(path, read_bytes(path, "the cameras of a COLMAP model"))
    ids, models = [], []
    for _ in range(reader.count("cameras", _SMALLEST_CAMERA)):
        camera_id, model_id, width, height = reader.array(_CAMERA, 1, "a camera")[0].tolist()
        name = model_name(model_id)
        check_supported(path, camera_id, name)
        parameters = reader.array(np.dtype("<f8"), len(PARAMETERS[name]), f"the parameters of camera {camera_id}")
        check_numbers(path, parameters, f"camera {camera_id}: ")
        ids.append(camera_id)
        models.append(camera_from_colmap(path, camera_id, name, (width, height), parameters.tolist()))
    reader.end()
    return ColmapCameras(np.array(ids, np.int64), tuple(models))


def read_images_binary(path: Path) -> ColmapImages:
    """Read ``images.bin``.

    Raises:
        InputError: The file is missing or damaged.
    """
    reader = ByteReader(path, read_bytes(path, "the images of a COLMAP model"))
    heads, names, keypoints = [], [], []
    for _ in range(reader.count("images", _SMALLEST_IMAGE)):
        head = reader.array(_IMAGE, 1, "an image")
        where = f"image {head['id'][0]}: "
        check_unit_quaternion(path, check_numbers(path, head["quat_wxyz"][0], where), where)
        check_numbers(path, head["p_cam_world"], where)
        heads.append(head)
        names.append(check_image_name(path, reader.text(f"{where}the name")))
        count = reader.count(f"keypoints of image {head['id'][0]}", _KEYPOINT.itemsize)
        keypoints.append(reader.array(_KEYPOINT, count, f"{where}the keypoints"))
        check_numbers(path, keypoints[-1]["px"], where)
    reader.end()
    images = np.concatenate([np.empty(0, _IMAGE), *heads])
    points = np.concatenate([np.empty(0, _KEYPOINT), *keypoints])
    return ColmapImages(
        ids=images["id"].astype(np.int64),
        names=tuple(names),
        camera_ids=images["camera_id"].astype(np.int64),
        quat_wxyz=images["quat_wxyz"].astype(np.float64),
        p_cam_world=images["p_cam_world"].astype(np.float64),
        keypoint_counts=np.array([len(k) for k in keypoints], np.int64),
        keypoints_px=points["px"].astype(np.float64),
        keypoint_point_ids=points["point_id"].astype(np.int64),
    )


def read_points_binary(path: Path) -> ColmapPoints:
    """Read ``points3D.bin``.

    Raises:
        InputError: The file is missing or damaged.
    """
    data = read_bytes(path, "the points of a COLMAP model")
    reader = ByteReader(path, data)
    n = reader.count("points", _POINT.itemsize)
    lengths = _track_lengths(path, data, n)
    is_point = _is_point(lengths)
    body = reader.array(np.dtype(np.uint8), len(is_point), "the points")
    reader.end()
    points, tracks = body[is_point].view(_POINT), body[~is_point].view(_TRACK)
    return ColmapPoints(
        ids=points["id"].astype(np.int64),
        positions=check_numbers(path, points["position"].astype(np.float64)),
        colours=points["colour"].astype(np.uint8),
        errors_px=points["error_px"].astype(np.float64),
        track_lengths=lengths,
        track_image_ids=tracks["image_id"].astype(np.int64),
        track_keypoints=tracks["keypoint"].astype(np.int64),
    )


def write_cameras_binary(path: Path, cameras: ColmapCameras) -> None:
    """Write ``cameras.bin``.

    Raises:
        InputError: The file cannot be written.
    """
    parts = [_LENGTH.pack(len(cameras.models))]
    for camera_id, model in zip(cameras.ids.tolist(), cameras.models, strict=True):
        name, parameters = camera_to_colmap(model)
        parts.append(np.array((camera_id, MODEL_IDS[name], model.width, model.height), _CAMERA).tobytes())
        parts.append(np.array(parameters, "<f8").tobytes())
    write_bytes(path, b"".join(parts))


def write_images_binary(path: Path, images: ColmapImages) -> None:
    """Write ``images.bin``.

    Raises:
        InputError: The file cannot be written.
    """
    heads = np.empty(len(images.names), _IMAGE)
    heads["id"], heads["camera_id"] = images.ids, images.camera_ids
    heads["quat_wxyz"], heads["p_cam_world"] = images.quat_wxyz, images.p_cam_world
    keypoints = np.empty(len(images.keypoints_px), _KEYPOINT)
    keypoints["px"], keypoints["point_id"] = images.keypoints_px, images.keypoint_point_ids
    parts = [_LENGTH.pack(len(heads))]
    start = 0
    for i, count in enumerate(images.keypoint_counts.tolist()):
        parts += [heads[i].tobytes(), images.names[i].encode("utf-8"), b"\0", _LENGTH.pack(count)]
        parts.append(keypoints[start : start + count].tobytes())
        start += count
    write_bytes(path, b"".join(parts))


def write_points_binary(path: Path, points: ColmapPoints) -> None:
    """Write ``points3D.bin``.

    Raises:
        InputError: The file cannot be written.
    """
    heads = np.empty(len(points.ids), _POINT)
    heads["id"], heads["position"], heads["colour"] = points.ids, points.positions, points.colours
    heads["error_px"], heads["length"] = points.errors_px, points.track_lengths
    tracks = np.empty(len(points.track_image_ids), _TRACK)
    tracks["image_id"], tracks["keypoint"] = points.track_image_ids, points.track_keypoints
    is_point = _is_point(points.track_lengths)
    body = np.empty(len(is_point), np.uint8)
    body[is_point], body[~is_point] = heads.view(np.uint8), tracks.view(np.uint8)
    write_bytes(path, _LENGTH.pack(len(heads)) + body.tobytes())


def _track_lengths(path: Path, data: bytes, n: int) -> npt.NDArray[np.int64]:
    """Return the track lengths (n,) of the points in a file, which give the places of the points.

    Raises:
        InputError: The data end before the last point.
    """
    lengths = []
    offset = _LENGTH.size
    for i in range(n):
        end = offset + _POINT.itemsize
        if end > len(data):
            raise truncated(path, f"{len(data) - offset} bytes where point {i} of {n} needs {_POINT.itemsize}")
        (length,) = _LENGTH.unpack_from(data, end - _LENGTH.size)
        offset = end + length * _TRACK.itemsize
        if offset > len(data):
            raise truncated(path, f"a count of {length} track elements of point {i} in {len(data) - end} bytes")
        lengths.append(length)
    return np.array(lengths, np.int64)


def _is_point(track_lengths: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return for each byte behind the count of the points whether it belongs to a point, and not to its track."""
    sizes = np.stack([np.full_like(track_lengths, _POINT.itemsize), _TRACK.itemsize * track_lengths], axis=1)
    return np.repeat(np.tile([True, False], len(track_lengths)), sizes.reshape(-1))
