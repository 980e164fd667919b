"""Rigs and frames of a model of COLMAP: ``rigs`` and ``frames``, as text or binary files, since COLMAP 3.12.

A rig has one reference sensor and the poses ``sensor_from_rig`` of the others; a frame is one moment of a rig, with its
pose ``rig_from_world`` and its images. The frame of the rig is here that of its first camera. Where a model has frames,
COLMAP takes the poses of images from them. Source: COLMAP's ``src/colmap/scene/reconstruction_io_binary.cc`` and
``reconstruction_io_text.cc``.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.parsing import Indices
from dronevio.models.recordings.files import write_bytes, write_text
from dronevio.models.rotation import inverse_pose, nearest_rotations, pose_matrix, quat_wxyz_from_matrix

RIG_ID = 1
"""Number of the rig."""

_CAMERA_TYPE = 0  # SensorType::CAMERA
_RIG = np.dtype([("count", "<u8"), ("id", "<u4"), ("sensors", "<u4"), ("type", "<i4"), ("sensor", "<u4")])
_SENSOR = np.dtype([("type", "<i4"), ("sensor", "<u4"), ("has_pose", "u1"), ("pose", "<f8", 7)])
_FRAME = np.dtype([("id", "<u4"), ("rig", "<u4"), ("pose", "<f8", 7), ("count", "<u4")])
_DATA = np.dtype([("type", "<i4"), ("sensor", "<u4"), ("image", "<u8")])


@dataclass(frozen=True, eq=False)
class RigFrames:
    """Which of the C images of a reconstruction were taken at the same time by a rig of its K cameras."""

    image_frame: Indices
    """(C,) Number of the frame of each image; images of one frame were taken at the same time by different cameras."""
    Ts_rig_cam: Array
    """(K, 4, 4) Calibrated poses of the cameras in the frame of the rig, in the unit of the reconstruction."""

    def check(self, reconstruction: Reconstruction) -> None:
        """Check the shapes, and that a frame has at most one image of each camera.

        Raises:
            ConfigError: They are others than those of the reconstruction, or a camera has two images in a frame.
        """
        shapes = {"image_frame": (len(reconstruction.image_names),), "Ts_rig_cam": (len(reconstruction.cameras), 4, 4)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ConfigError(f"rig: {name} has shape {getattr(self, name).shape}; expected {shape}")
        pairs = np.stack([self.image_frame, reconstruction.image_camera], axis=1)
        found, counts = np.unique(pairs, axis=0, return_counts=True)
        if np.any(counts > 1):
            frame, camera = found[counts > 1][0].tolist()
            raise ConfigError(f"rig: two images of camera {camera} in frame {frame}; expected at most one")


@dataclass(frozen=True, eq=False)
class _Contents:
    """Contents of both files: one rig of K cameras, F frames with C images, ordered by frame and camera."""

    sensor_poses: Array
    """(K − 1, 7) Quaternion w, x, y, z and translation of ``sensor_from_rig`` of all cameras but the first."""
    frame_poses: Array
    """(F, 7) The same of ``rig_from_world``."""
    frame_counts: Indices
    """(F,) Number of images of each frame."""
    camera_ids: Indices
    """(C,) Numbers of the cameras of the images."""
    image_ids: Indices
    """(C,) Numbers of the images."""


def write_rig_files(rigs: Path, frames: Path, reconstruction: Reconstruction, rig: RigFrames, binary: bool) -> None:
    """Write the files of rigs and frames, whose numbers count from 1 as those of `write_colmap`.

    The pose of a frame is the mean of those that its images and their mounting state.

    Args:
        rigs: The file ``rigs``.
        frames: The file ``frames``.
        reconstruction: The reconstruction, with at least one image.
        rig: Its rig.
        binary: Whether to write binary files instead of text.

    Raises:
        ConfigError: The rig contradicts the reconstruction.
        InputError: A file cannot be written.
    """
    contents = _contents(reconstruction, rig)
    if binary:
        write_bytes(rigs, _rigs_binary(contents))
        write_bytes(frames, _frames_binary(contents))
    else:
        write_text(rigs, _rigs_text(contents))
        write_text(frames, _frames_text(contents))


def _contents(reconstruction: Reconstruction, rig: RigFrames) -> _Contents:
    """Return what the files contain.

    Raises:
        ConfigError: The rig contradicts the reconstruction.
    """
    rig.check(reconstruction)
    r = reconstruction
    Ts_cam_ref = inverse_pose(rig.Ts_rig_cam) @ rig.Ts_rig_cam[:1]
    Ts_world_ref = r.Ts_world_cam @ Ts_cam_ref[r.image_camera]
    order = np.lexsort((r.image_camera, rig.image_frame))
    _, first, counts = np.unique(rig.image_frame[order], return_index=True, return_counts=True)
    mean = np.add.reduceat(Ts_world_ref[order], first, axis=0) / counts[:, None, None]
    Ts_world_ref = pose_matrix(nearest_rotations(mean[:, :3, :3]), mean[:, :3, 3])
    return _Contents(
        sensor_poses=_rows(Ts_cam_ref[1:]),
        frame_poses=_rows(inverse_pose(Ts_world_ref)),
        frame_counts=counts.astype(np.int64),
        camera_ids=r.image_camera[order] + 1,
        image_ids=order.astype(np.int64) + 1,
    )


def _rows(Ts: Array) -> Array:
    """Return quaternions w, x, y, z and translations (N, 7) of poses (N, 4, 4)."""
    return np.hstack([quat_wxyz_from_matrix(Ts[:, :3, :3]), Ts[:, :3, 3]])


def _rigs_binary(contents: _Contents) -> bytes:
    """Return the binary file of rigs."""
    count = len(contents.sensor_poses)
    sensors = np.zeros(count, _SENSOR)
    sensors["type"], sensors["sensor"], sensors["has_pose"] = _CAMERA_TYPE, np.arange(2, count + 2), 1
    sensors["pose"] = contents.sensor_poses
    return np.array((1, RIG_ID, count + 1, _CAMERA_TYPE, 1), _RIG).tobytes() + sensors.tobytes()


def _frames_binary(contents: _Contents) -> bytes:
    """Return the binary file of frames."""
    heads = np.zeros(len(contents.frame_counts), _FRAME)
    heads["id"], heads["rig"] = np.arange(1, len(heads) + 1), RIG_ID
    heads["pose"], heads["count"] = contents.frame_poses, contents.frame_counts
    data = np.zeros(len(contents.image_ids), _DATA)
    data["type"], data["sensor"], data["image"] = _CAMERA_TYPE, contents.camera_ids, contents.image_ids
    ends = np.cumsum(contents.frame_counts).tolist()
    parts = [np.array(len(heads), "<u8").tobytes()]
    for head, start, end in zip(heads, [0, *ends], ends, strict=False):
        parts += [head.tobytes(), data[start:end].tobytes()]
    return b"".join(parts)


def _rigs_text(contents: _Contents) -> str:
    """Return the text file of rigs."""
    count = len(contents.sensor_poses) + 1
    sensors = [f"CAMERA {i} 1 {_text(pose)}" for i, pose in enumerate(contents.sensor_poses.tolist(), 2)]
    rows = [
        "# Rig calib list with one line of data per calib:",
        "#   RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, "
        "[QW, QX, QY, QZ, TX, TY, TZ])",
        "# Number of rigs: 1",
        " ".join([f"{RIG_ID} {count} CAMERA 1", *sensors]),
    ]
    return "\n".join(rows) + "\n"


def _frames_text(contents: _Contents) -> str:
    """Return the text file of frames."""
    rows = [
        "# Frame list with one line of data per frame:",
        "#   FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, "
        "DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)",
        f"# Number of frames: {len(contents.frame_counts)}",
    ]
    pairs = zip(contents.camera_ids.tolist(), contents.image_ids.tolist(), strict=True)
    data = [f"CAMERA {camera} {image}" for camera, image in pairs]
    start = 0
    counts = contents.frame_counts.tolist()
    for number, (pose, count) in enumerate(zip(contents.frame_poses.tolist(), counts, strict=True), 1):
        rows.append(" ".join([f"{number} {RIG_ID} {_text(pose)} {count}", *data[start : start + count]]))
        start += count
    return "\n".join(rows) + "\n"


def _text(values: list[float]) -> str:
    """Return numbers as text without loss of precision, separated by spaces."""
    return " ".join(map(repr, values))
