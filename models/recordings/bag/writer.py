"""Flights as ROS 2 bags, out: standard messages that rosbag2, Foxglove and every node understand.

=============================== ================================= =====================================================
``/cam0/image_raw`` ...          sensor_msgs/Image                 or ``/cam0/image_raw/compressed``, CompressedImage
``/cam0/camera_info`` ...        sensor_msgs/CameraInfo            the lens, one a frame
``/imu0``                        sensor_msgs/Imu                   without an orientation
``/groundtruth/odometry``        nav_msgs/Odometry                 pose of the IMU in the world, twist in the IMU frame
``/groundtruth/velocity`` ...    geometry_msgs/Vector3Stamped      velocity in the world; ``gyro_bias``, ``accel_bias``
``/groundtruth/frames``          std_msgs/String                   when and how frames were really exposed, as a table
``/tf``, ``/tf_static``          tf2_msgs/TFMessage                world to imu0; imu0 to base_link and to the cameras
``/calibration``                 std_msgs/String                   the rig, to the bit, as Kalibr's camchain and imu0
=============================== ================================= =====================================================

What standard messages cannot hold is thus in the last four lines, as text where need be, and a bag is read back to the
bit. Messages are written in the order of their time stamps, which are also when they are said to be received: there is
one clock. They leave one at a time, so that memory does not grow with the flight.
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
from dronevio.models.recordings.calibration.kalibr import CAMERA_TOPIC, IMU_TOPIC, camchain_yaml, imu_yaml, indented
from dronevio.models.recordings.frame_truth import FrameTruth, frame_truth_text
from dronevio.models.state import Trajectory

Storage = Literal["mcap", "sqlite3"]
Images = Literal["raw", "png"]

CALIBRATION_TOPIC = "/calibration"
"""Where the rig is, as the text of Kalibr's files."""
TRUTH_TOPIC, FRAME_TRUTH_TOPIC = "/groundtruth/odometry", "/groundtruth/frames"
"""Where the true motion is, and the truth about the frames."""
TRUE_VECTORS = {
    "/groundtruth/velocity": ("velocity_m_s", WORLD),
    "/groundtruth/gyro_bias": ("gyro_bias_rad_s", IMU),
    "/groundtruth/accel_bias": ("accel_bias_m_s2", IMU),
}
"""Where each field of the true motion is that an Odometry cannot hold to the bit, and its frame of reference."""
COMPRESSED = "/compressed"
"""What ROS adds to the topic of images that are compressed."""

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
    """Write a recording as a bag, all of it or nothing.

    Args:
        path: An ``.mcap`` or ``.db3`` file, or else a folder as ``ros2 bag`` makes it, with ``metadata.yaml``.
        recording: What to write.
        storage: What the bag is made of.
        images: Pixel by pixel, which every node reads, or PNG, which takes half the room.
        progress: Told how many frames are done.
        frame_truth: The truth about the frames, where it is known.
        overwrite: Replace a bag that is there already, in the end.

    Raises:
        ConfigError: A time stamp is before 1970 or after 2038, which ROS cannot express.
        InputError: A frame cannot be read, or something is in the way.
    """
    path = Path(path).absolute()
    _refuse_to_destroy(path, overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=path.parent))
    except OSError as error:
        raise InputError(path, f"it cannot be made ({error.strerror})", "a place where I may write") from None
    try:
        folder = scratch / path.stem
        _write(folder, recording, storage, images, progress, frame_truth)
        suffix = ".mcap" if storage == "mcap" else ".db3"
        made = folder / f"{path.stem}{suffix}" if path.suffix == suffix else folder
        _refuse_to_destroy(path, overwrite)
        if path.is_dir():
            path.rename(scratch / "old")
        made.replace(path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _refuse_to_destroy(path: Path, overwrite: bool) -> None:
    """Raise InputError if something is in the way that is no bag to replace."""
    if not path.exists():
        return
    if not overwrite:
        raise InputError(path, "it exists already", "a new name, or --overwrite")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        raise InputError(path, "it holds no metadata.yaml, so it is no bag", "a new name, or an earlier bag")
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise InputError(path, "a file that is no bag", "a new name, or an earlier bag")


def calibration_text(recording: Recording) -> str:
    """Return the rig of a recording, to the bit, as one text that holds both of Kalibr's files."""
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
    """Yield what is said once, at the start."""
    starts = [times[0] for times in (recording.imu.t_ns, recording.frame_times_ns) if len(times)]
    if recording.ground_truth is not None and len(recording.ground_truth):
        starts.append(recording.ground_truth.t_ns[0])
    t_ns = int(min(starts, default=0))
    yield t_ns, CALIBRATION_TOPIC, ros.std_msgs__msg__String(calibration_text(recording))
    yield t_ns, "/tf_static", rig_transforms(recording.rig, t_ns)
    if frame_truth is not None:
        yield t_ns, FRAME_TRUTH_TOPIC, ros.std_msgs__msg__String(frame_truth_text(frame_truth))


def _truth(truth: Trajectory) -> Iterator[Iterator[Timed]]:
    """Yield the streams of the true motion."""
    yield ((t_ns, TRUTH_TOPIC, message) for t_ns, message in odometry_messages(truth))
    yield ((t_ns, "/tf", message) for t_ns, message in transform_messages(truth))
    for topic, (field, frame) in TRUE_VECTORS.items():
        vectors = getattr(truth, field)
        if vectors is not None:
            yield _on(topic, vector_messages(truth.t_ns, vectors, frame))


def _on(topic: str, messages: Iterator[tuple[int, object]]) -> Iterator[Timed]:
    """Yield messages with their topic."""
    return ((t_ns, topic, message) for t_ns, message in messages)


def _frames(recording: Recording, images: Images, progress: Progress) -> Iterator[Timed]:
    """Yield the images and camera descriptions of each frame."""
    count = len(recording.frame_times_ns)
    progress(0, count)
    for index in range(count):
        frame = recording.frame(index)
        for number, (camera, image) in enumerate(zip(recording.rig.cameras, frame.images, strict=True)):
            topic, reference = CAMERA_TOPIC.format(number), CAMERA.format(number)
            message = image_message(image, frame.t_ns, reference, images == "png")
            yield frame.t_ns, topic + (COMPRESSED if images == "png" else ""), message
            yield frame.t_ns, f"/cam{number}/camera_info", camera_info(camera.model, frame.t_ns, reference)
        progress(index + 1, count)
