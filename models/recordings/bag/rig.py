"""Calibration of a bag: from Kalibr's files, from the topic ``/calibration``, or from CameraInfo and tf."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuModel, Sampling
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.messages import camera_model
from dronevio.models.recordings.bag.missing import MissingParts, missing
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.topics import camera_info_topic
from dronevio.models.recordings.bag.writer import CALIBRATION_TOPIC
from dronevio.models.recordings.calibration.calibration import Calibration
from dronevio.models.recordings.calibration.reading import calibration_of, read_calibration
from dronevio.models.recordings.calibration.yaml_document import parse_yaml
from dronevio.models.recordings.files import as_input_error
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import inverse_pose, matrix_from_quat_wxyz, pose_matrix

_TF_TYPE, _STRING_TYPE, _INFO_TYPE = "tf2_msgs/msg/TFMessage", "std_msgs/msg/String", "sensor_msgs/msg/CameraInfo"
_UNIT_TOLERANCE = 1e-3


def read_calibrations(bag: BagFile, files: Sequence[Path], rate_hz: float = 20.0) -> list[Calibration]:
    """Return the calibrations of a bag in the order of their precedence: that of files, that of ``/calibration``.

    Args:
        bag: The bag.
        files: Calibration files of Kalibr or Basalt.
        rate_hz: Frame rate of cameras without one in their calibration [Hz].

    Raises:
        InputError: A file or the text of the topic is damaged.
    """
    calibrations = [read_calibration(files, rate_hz)] if files else []
    if bag.topics.get(CALIBRATION_TOPIC) == _STRING_TYPE:
        message = cast("ros.std_msgs__msg__String", bag.first_message(CALIBRATION_TOPIC))
        text = parse_yaml(Path(f"{bag.path}:{CALIBRATION_TOPIC}"), message.data)
        calibrations.append(calibration_of([text], rate_hz))
    return calibrations


def bag_rig(
    bag: BagFile,
    topics: BagTopics,
    used: Sequence[int],
    calibrations: Sequence[Calibration],
    rate_hz: float,
    parts: MissingParts,
    imu: ImuModel | None = None,
) -> tuple[Rig, Sampling]:
    """Return the rig of the given topics, and the sampling of its IMU.

    Args:
        bag: The bag.
        topics: Topics of images and IMU.
        used: Index in a calibration of the camera of each image topic.
        calibrations: Calibrations of files or of the bag, in the order of their precedence.
        rate_hz: Frame rate [Hz].
        parts: The parts that the bag lacks, to which those of the calibration are added.
        imu: Model of the IMU that replaces that of the calibrations.

    Raises:
        InputError: The bag lacks something; the message names all of it.
    """
    imus = [calibration for calibration in calibrations if calibration.imu is not None]
    if not imus and imu is None:
        with parts.collected():
            raise missing(
                bag,
                "no noise densities of the IMU",
                "Kalibr's imu.yaml (--calibration imu.yaml), or the name of an IMU (--imu BMI088)",
            )
    chains = [calibration for calibration in calibrations if calibration.cameras]
    cameras = chains[0].cameras if chains else _cameras_of_messages(bag, topics, rate_hz, parts)
    parts.check()
    if chains and len(cameras) <= max(used):
        raise bag.error(
            f"{len(cameras)} cameras in the calibration, and images of cam{max(used)}",
            "the calibration of all cameras, or others to use (--cameras)",
        )
    model = imu or imus[0].imu
    assert model is not None
    with as_input_error(bag.path):
        rig = Rig(
            cameras=cameras,
            imu=model,
            T_vehicle_imu=imus[0].T_vehicle_imu if imus else np.eye(4),
            time_offset_s=chains[0].time_offset_s if chains else 0.0,
        )
    return rig.with_cameras(used if chains else range(len(cameras))), imus[0].sampling if imus else "point"


def _cameras_of_messages(bag: BagFile, topics: BagTopics, rate_hz: float, parts: MissingParts) -> tuple[RigCamera, ...]:
    """Return the cameras according to CameraInfo and /tf_static; what is missing is added to ``parts``."""
    poses = _static_poses(bag)
    imu_frame = _frame_of(bag, topics.imu[0]) if topics.imu else None
    cameras = []
    for topic in topics.images:
        info_topic = camera_info_topic(topic)
        has_info = bag.topics.get(info_topic) == _INFO_TYPE
        with parts.collected():
            if not has_info:
                expected = "that topic, or Kalibr's camchain.yaml (--calibration camchain.yaml)"
                raise missing(bag, f"{topic} without {info_topic}", expected)
        if imu_frame is None:
            continue
        frame = _frame_of(bag, topic)
        T_imu_cam = _pose_between(poses, imu_frame, frame)
        with parts.collected():
            if T_imu_cam is None:
                raise missing(
                    bag,
                    f"no transform from {imu_frame!r} to {frame!r} in /tf_static",
                    "the pose of the camera, or Kalibr's camchain.yaml (--calibration camchain.yaml)",
                )
        if has_info and T_imu_cam is not None:
            info = cast("ros.sensor_msgs__msg__CameraInfo", bag.first_message(info_topic))
            with as_input_error(bag.path):
                cameras.append(RigCamera(camera_model(bag.path, info_topic, info), T_imu_cam, rate_hz))
    return tuple(cameras)


def _frame_of(bag: BagFile, topic: str) -> str:
    """Return the frame of reference in the first message of a topic."""
    message = bag.first_message(topic)
    return str(cast("ros.sensor_msgs__msg__Image", message).header.frame_id).lstrip("/")


def _static_poses(bag: BagFile) -> dict[tuple[str, str], Array]:
    """Return the poses (4, 4) between adjacent frames by (parent, child) and (child, parent), or raise InputError."""
    poses: dict[tuple[str, str], Array] = {}
    for topic in bag.topics_of_type(_TF_TYPE):
        if not topic.endswith("tf_static"):
            continue
        for message in bag.messages(topic):
            for transform in cast("ros.tf2_msgs__msg__TFMessage", message).transforms:
                t, q = transform.transform.translation, transform.transform.rotation
                quat = np.array([q.w, q.x, q.y, q.z])
                parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
                length = math.hypot(*quat)
                if not abs(length - 1.0) < _UNIT_TOLERANCE:
                    found = f"{topic}: a quaternion of length {length:.3g} from {parent!r} to {child!r}"
                    raise bag.error(found, "a unit quaternion")
                T = pose_matrix(matrix_from_quat_wxyz(quat / length), np.array([t.x, t.y, t.z]))
                poses[parent, child], poses[child, parent] = T, inverse_pose(T)
    return poses


def _pose_between(poses: dict[tuple[str, str], Array], start: str, goal: str) -> Array | None:
    """Return the pose (4, 4) of frame ``goal`` in frame ``start`` by breadth-first search, None if not connected."""
    reached, queue = {start: np.eye(4)}, [start]
    while queue:
        current = queue.pop(0)
        for (a, b), T_a_b in poses.items():
            if a == current and b not in reached:
                reached[b] = reached[current] @ T_a_b
                queue.append(b)
    return reached.get(goal)
