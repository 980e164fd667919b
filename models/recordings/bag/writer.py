"""Writing of recordings as ROS 2 bags with standard messages.

=============================== ================================= =====================================================
``/camN/image_raw``              sensor_msgs/Image                 or ``/camN/image_raw/compressed``, CompressedImage
``/camN/camera_info``            sensor_msgs/CameraInfo            intrinsics, rectification of pairs
``/imu0``                        sensor_msgs/Imu                   without an orientation
``/groundtruth/odometry``        nav_msgs/Odometry                 pose of the IMU in the world, twist in the IMU frame
``/groundtruth/velocity``        geometry_msgs/Vector3Stamped      in the world; also ``gyro_bias``, ``accel_bias``
``/groundtruth/frames``          std_msgs/String                   true exposure of the frames, as a table
``/tf``, ``/tf_static``          tf2_msgs/TFMessage                world to imu0; imu0 to base_link and to the cameras
``/calibration``                 std_msgs/String                   the rig as Kalibr's camchain and imu0
=============================== ================================= =====================================================

Vectors, tables and texts carry the fields that other standard messages lack, so that a bag is read without loss of
precision. Messages are written in the order of their time stamps, which are also their log times, one at a time, so
that memory does not grow with the length of the recording.
"""

import heapq
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.errors import InputError
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.recordings.bag.file import typestore
from dronevio.models.recordings.bag.messages import (
    CAMERA,
    IMU,
    WORLD,
    camera_info,
    image_message,
    imu_messages,
    odometry_messages,
    rig_transforms,
    transform_messages,
    vector_messages,
)
from dronevio.models.recordings.bag.rectification import rectifications
from dronevio.models.recordings.calibration.kalibr import CAMERA_TOPIC, IMU_TOPIC, camchain_yaml, imu_yaml
from dronevio.models.recordings.calibration.yaml_text import indented
from dronevio.models.recordings.frame_truth import FrameTruth, frame_truth_text
from dronevio.models.state import Trajectory

Storage = Literal["mcap", "sqlite3"]
Images = Literal["raw", "png"]

CALIBRATION_TOPIC = "/calibration"
"""Topic of the rig, as the text of Kalibr's files."""
TRUTH_TOPIC, FRAME_TRUTH_TOPIC = "/groundtruth/odometry", "/groundtruth/frames"
"""Topics of the true trajectory and of the ground truth of the frames."""
TRUE_VECTORS = {
    "/groundtruth/velocity": ("velocity_m_s", WORLD),
    "/groundtruth/gyro_bias": ("gyro_bias_rad_s", IMU),
    "/groundtruth/accel_bias": ("accel_bias_m_s2", IMU),
}
"""Topics of those fields of the true trajectory that Odometry lacks or rounds, with their fields and frames."""
COMPRESSED = "/compressed"
"""Suffix of topics with compressed images, by the naming convention of ROS."""

_METADATA_VERSION: Literal[8] = 8  # of rosbag2; the newest that distributions before Kilted read
_LATCHED = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=QosTime(0, 0),
    lifespan=QosTime(0, 0),
    liveliness=QosLiveliness.SYSTEM_DEFAULT,
    liveliness_lease_duration=QosTime(0, 0),
    avoid_ros_namespace_conventions=False,
)
_LATCHED_TOPICS = (CALIBRATION_TOPIC, FRAME_TRUTH_TOPIC, "/tf_static")

Timed = tuple[int, str, object]  # time stamp [ns], topic, message


def write_bag(
    path: Path,
    recording: Recording,
    storage: Storage = "mcap",
    images: Images = "raw",
    progress: Progress = silent,
    frame_truth: FrameTruth | None = None,
    overwrite: bool = False,
) -> None:
    """Write a recording as a bag, atomically.

    Args:
        path: An ``.mcap`` or ``.db3`` file, or a folder with ``metadata.yaml`` as ``ros2 bag`` writes it.
        recording: Recording to write.
        storage: Storage format of the bag.
        images: ``raw`` for uncompressed images, which all nodes can read, or ``png``, which needs half of the space.
        progress: Callback that receives the number of written frames.
        frame_truth: Ground truth of the frames, None if it is unknown.
        overwrite: Whether to replace an existing bag.

    Raises:
        ConfigError: A time stamp is before 1970 or after 2038, which ROS cannot represent.
        InputError: A frame cannot be read, or the path exists and must not be replaced.
    """
    path = Path(path).absolute()
    _check_replaceable(path, overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=path.parent))
    except OSError as error:
        raise InputError(path, f"cannot be created ({error.strerror})", "a writable folder") from None
    try:
        folder = scratch / path.stem
        _write(folder, recording, storage, images, progress, frame_truth)
        suffix = ".mcap" if storage == "mcap" else ".db3"
        written = folder / f"{path.stem}{suffix}" if path.suffix == suffix else folder
        _check_replaceable(path, overwrite)
        if path.is_dir():
            path.rename(scratch / "old")
        written.replace(path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _check_replaceable(path: Path, overwrite: bool) -> None:
    """Raise InputError if a path exists and is not a bag that may be replaced."""
    if not path.exists():
        return
    if not overwrite:
        raise InputError(path, "the path exists already", "a new name, or --overwrite")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        raise InputError(path, "a folder without metadata.yaml, which is not a bag", "a new name, or an earlier bag")
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise InputError(path, "a file that is not a bag", "a new name, or an earlier bag")


def calibration_text(recording: Recording) -> str:
    """Return the rig of a recording as one text with both of Kalibr's files, without loss of precision."""
    imu = imu_yaml(recording.rig, recording.imu.sampling)
    return f"{camchain_yaml(recording.rig)}imu0:\n{indented(imu)}"


def _write(
    folder: Path,
    recording: Recording,
    storage: Storage,
    images: Images,
    progress: Progress,
    frame_truth: FrameTruth | None,
) -> None:
    """Write a bag as a folder."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    truth = recording.ground_truth
    streams = [
        _latched(recording, frame_truth),
        ((t_ns, IMU_TOPIC, message) for t_ns, message in imu_messages(recording.imu, recording.rig.imu)),
        _frames(recording, images, progress),
        *(_truth(truth) if truth is not None else ()),
    ]
    with Writer(folder, version=_METADATA_VERSION, storage_plugin=plugin) as writer:
        connections = {}
        for t_ns, topic, message in heapq.merge(*streams, key=lambda timed: timed[0]):
            msgtype = str(message.__msgtype__)
            if topic not in connections:
                qos = (_LATCHED,) if topic in _LATCHED_TOPICS else ()
                connections[topic] = writer.add_connection(
                    topic, msgtype, typestore=typestore(), offered_qos_profiles=qos
                )
            writer.write(connections[topic], t_ns, typestore().serialize_cdr(message, msgtype))


def _latched(recording: Recording, frame_truth: FrameTruth | None) -> Iterator[Timed]:
    """Yield the messages that are written once, at the start."""
    starts = [times[0] for times in (recording.imu.t_ns, recording.frame_times_ns) if len(times)]
    if recording.ground_truth is not None and len(recording.ground_truth):
        starts.append(recording.ground_truth.t_ns[0])
    t_ns = int(min(starts, default=0))
    yield t_ns, CALIBRATION_TOPIC, ros.std_msgs__msg__String(calibration_text(recording))
    yield t_ns, "/tf_static", rig_transforms(recording.rig, t_ns)
    if frame_truth is not None:
        yield t_ns, FRAME_TRUTH_TOPIC, ros.std_msgs__msg__String(frame_truth_text(frame_truth))


def _truth(truth: Trajectory) -> Iterator[Iterator[Timed]]:
    """Yield the message streams of the ground truth."""
    yield ((t_ns, TRUTH_TOPIC, message) for t_ns, message in odometry_messages(truth))
    yield ((t_ns, "/tf", message) for t_ns, message in transform_messages(truth))
    for topic, (field, frame) in TRUE_VECTORS.items():
        vectors = getattr(truth, field)
        if vectors is not None:
            yield _with_topic(topic, vector_messages(truth.t_ns, vectors, frame))


def _with_topic(topic: str, messages: Iterator[tuple[int, object]]) -> Iterator[Timed]:
    """Return messages with their topic."""
    return ((t_ns, topic, message) for t_ns, message in messages)


def _frames(recording: Recording, images: Images, progress: Progress) -> Iterator[Timed]:
    """Yield the images and the CameraInfo messages of each frame."""
    count, rectified = len(recording.frame_times_ns), rectifications(recording.rig)
    progress(0, count)
    for index in range(count):
        frame = recording.frame(index)
        delays_ns = frame.image_delays_ns or (0,) * len(frame.images)
        timed = sorted(zip(delays_ns, range(len(frame.images)), frame.images, strict=True), key=lambda each: each[:2])
        for delay_ns, number, image in timed:
            if image.size:
                t_ns, reference = frame.t_ns + delay_ns, CAMERA.format(number)
                model, rectification = recording.rig.cameras[number].model, rectified[number]
                topic = CAMERA_TOPIC.format(number) + (COMPRESSED if images == "png" else "")
                yield t_ns, topic, image_message(image, t_ns, reference, images == "png")
                yield t_ns, f"/cam{number}/camera_info", camera_info(model, t_ns, reference, rectification)
        progress(index + 1, count)
