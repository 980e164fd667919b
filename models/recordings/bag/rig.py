"""The rig of a bag: from Kalibr's files, from our own calibration in it, or from CameraInfo and tf."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.imu import Sampling
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.messages import camera_model
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.topics import camera_info_topic
from dronevio.models.recordings.bag.writer import CALIBRATION_TOPIC
from dronevio.models.recordings.calibration.kalibr import KalibrCalibration, calibration_of, read_calibration
from dronevio.models.recordings.calibration.yaml_document import parse_yaml
from dronevio.models.recordings.files import blamed_on
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import inverse_pose, matrix_from_quat_wxyz, pose_matrix

Array = npt.NDArray[np.float64]

_TF_TYPE, _STRING_TYPE, _INFO_TYPE = "tf2_msgs/msg/TFMessage", "std_msgs/msg/String", "sensor_msgs/msg/CameraInfo"
_UNIT_TOLERANCE = 1e-3


def read_calibrations(bag: BagFile, files: Sequence[Path], rate_hz: float = 20.0) -> list[KalibrCalibration]:
    """Return what is said of the rig, the most important first: by the user's files, by our own text in the bag.

    Raises:
        InputError: A file or the text is damaged.
    """
    said = [read_calibration(files, rate_hz)] if files else []
    if bag.topics.get(CALIBRATION_TOPIC) == _STRING_TYPE:
        message = cast("ros.std_msgs__msg__String", bag.first(CALIBRATION_TOPIC))
        text = parse_yaml(Path(f"{bag.path}:{CALIBRATION_TOPIC}"), message.data)
        said.append(calibration_of([text], rate_hz))
    return said


def bag_rig(bag: BagFile, topics: BagTopics, said: Sequence[KalibrCalibration], rate_hz: float) -> tuple[Rig, Sampling]:
    """Return the rig whose cameras are those of the given topics, and what its IMU's samples are.

    Args:
        bag: The bag.
        topics: Images and IMU.
        said: What Kalibr's files say.
        rate_hz: How often frames come [Hz].

    Raises:
        InputError: A piece is missing; the message says which.
    """
    imus = [calibration for calibration in said if calibration.imu is not None]
    if not imus:
        raise bag.fault(
            "nothing about the noise of its IMU", "Kalibr's imu.yaml with it (calibration): gyroscope_noise_density ..."
        )
    chains = [calibration for calibration in said if calibration.cameras]
    cameras = chains[0].cameras if chains else _cameras_of_messages(bag, topics, rate_hz)
    if len(cameras) < len(topics.images):
        raise bag.fault(
            f"{len(topics.images)} topics with images, but {len(cameras)} cameras in the calibration", "as many"
        )
    first = imus[0]
    assert first.imu is not None
    with blamed_on(bag.path):
        rig = Rig(
            cameras=cameras[: len(topics.images)],
            imu=first.imu,
            T_vehicle_imu=first.T_vehicle_imu,
            time_offset_s=chains[0].time_offset_s if chains else 0.0,
        )
    return rig, first.sampling


def _cameras_of_messages(bag: BagFile, topics: BagTopics, rate_hz: float) -> tuple[RigCamera, ...]:
    """Return the cameras as CameraInfo and /tf_static describe them, or raise InputError."""
    poses = _static_poses(bag)
    imu_frame = _frame_of(bag, topics.imu)
    cameras = []
    for topic in topics.images:
        info_topic = camera_info_topic(topic)
        if bag.topics.get(info_topic) != _INFO_TYPE:
            raise bag.fault(f"{topic} without {info_topic}", "that, or Kalibr's camchain.yaml with it (calibration)")
        info = cast("ros.sensor_msgs__msg__CameraInfo", bag.first(info_topic))
        frame = _frame_of(bag, topic)
        T_imu_cam = _pose_between(poses, imu_frame, frame)
        if T_imu_cam is None:
            raise bag.fault(
                f"no way from {imu_frame!r} to {frame!r} in /tf_static",
                "where the camera is, or Kalibr's camchain.yaml with it (calibration)",
            )
        with blamed_on(bag.path):
            cameras.append(RigCamera(camera_model(bag.path, info_topic, info), T_imu_cam, rate_hz))
    return tuple(cameras)


def _frame_of(bag: BagFile, topic: str) -> str:
    """Return the frame of reference that a topic's first message names."""
    message = bag.first(topic)
    return str(cast("ros.sensor_msgs__msg__Image", message).header.frame_id).lstrip("/")


def _static_poses(bag: BagFile) -> dict[tuple[str, str], Array]:
    """Return the pose (4, 4) of each frame in each of its neighbours, by the names of the two, or raise InputError."""
    poses: dict[tuple[str, str], Array] = {}
    for topic in bag.of_type(_TF_TYPE):
        if not topic.endswith("tf_static"):
            continue
        for message in bag.decoded(topic):
            for transform in cast("ros.tf2_msgs__msg__TFMessage", message).transforms:
                t, q = transform.transform.translation, transform.transform.rotation
                quat = np.array([q.w, q.x, q.y, q.z])
                parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
                length = math.hypot(*quat)
                if not abs(length - 1.0) < _UNIT_TOLERANCE:
                    found = f"{topic}: a quaternion of length {length:.3g} from {parent!r} to {child!r}"
                    raise bag.fault(found, "one of length 1")
                T = pose_matrix(matrix_from_quat_wxyz(quat / length), np.array([t.x, t.y, t.z]))
                poses[parent, child], poses[child, parent] = T, inverse_pose(T)
    return poses


def _pose_between(poses: dict[tuple[str, str], Array], start: str, goal: str) -> Array | None:
    """Return the pose (4, 4) of one frame in another along whatever chain of neighbours, None where there is none."""
    reached, front = {start: np.eye(4)}, [start]
    while front:
        here = front.pop(0)
        for (a, b), T_a_b in poses.items():
            if a == here and b not in reached:
                reached[b] = reached[here] @ T_a_b
                front.append(b)
    return reached.get(goal)
