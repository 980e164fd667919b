"""Conversion between the data types of this package and standard messages of ROS 2.

Times are integer nanoseconds and numbers are doubles in both, so the conversion is exact. The frames of reference are
``world``, ``base_link`` (the vehicle), ``imu0``, ``cam0``, ``cam1`` and so on.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuModel, ImuSamples, Times
from dronevio.models.lenses.lens import LENSES
from dronevio.models.recordings.bag.encodings import ENCODINGS, grey_pixels
from dronevio.models.recordings.bag.rectification import Rectification
from dronevio.models.recordings.bit_depth import DeepImage
from dronevio.models.recordings.calibration.camera_fields import LENS_NAMES
from dronevio.models.recordings.images import DamagedImageError, decode_deep_grey, encode_png
from dronevio.models.rig import Rig
from dronevio.models.rotation import inverse_pose, log_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

ImageMessage: TypeAlias = "ros.sensor_msgs__msg__Image | ros.sensor_msgs__msg__CompressedImage"
PoseMessage: TypeAlias = (
    "ros.nav_msgs__msg__Odometry | ros.geometry_msgs__msg__PoseStamped | ros.geometry_msgs__msg__TransformStamped"
)

WORLD, VEHICLE, IMU, CAMERA = "world", "base_link", "imu0", "cam{}"
"""Names of the frames of reference."""
LAST_NS = 2**31 * 10**9
"""Upper limit of time stamps in ROS, whose seconds have 31 bits [ns]."""

_ROS_LENSES = {**LENS_NAMES, "": "radtan", "fisheye": "equidistant"}
_LENGTHS = {0, 4, 5, 8}  # of the coefficients, which zeros may follow
_UNKNOWN = -1.0  # in the first element of a covariance, for missing data (sensor_msgs/Imu)


def header(t_ns: int, frame: str) -> ros.std_msgs__msg__Header:
    """Return a header with a time stamp and a frame of reference.

    Raises:
        ConfigError: The time is before 1970 or after 2038, which ROS cannot represent.
    """
    if not 0 <= t_ns < LAST_NS:
        raise ConfigError(f"a time stamp of {t_ns} ns; expected 0 to {LAST_NS}, the range of ROS")
    sec, nanosec = divmod(t_ns, 10**9)
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(sec, nanosec), frame)


def stamp_ns(raw: bytes) -> int:
    """Return the time stamp [ns] of a serialized message that begins with a header, without decoding the rest.

    Raises:
        ValueError: The message does not begin with a header.
    """
    if len(raw) < 12 or raw[:2] not in (b"\0\0", b"\0\1"):
        raise ValueError("a message that does not begin with a time stamp")
    return _time_ns("<iI" if raw[1] else ">iI", raw, 4)


def ros1_stamp_ns(raw: bytes) -> int:
    """Return the time stamp [ns] of a message of ROS 1 that begins with a header, a counter and the time stamp.

    Raises:
        ValueError: The message does not begin with a header.
    """
    if len(raw) < 12:
        raise ValueError("a message that does not begin with a time stamp")
    return _time_ns("<II", raw, 4)


def _time_ns(form: str, raw: bytes, at: int) -> int:
    """Return the time [ns] of seconds and nanoseconds at a place of a message, or raise ValueError."""
    sec, nanosec = struct.unpack_from(form, raw, at)
    if nanosec >= 10**9:
        raise ValueError(f"a time stamp with {nanosec} ns in addition to its seconds")
    return int(sec) * 10**9 + int(nanosec)


def imu_messages(samples: ImuSamples, model: ImuModel) -> Iterator[tuple[int, ros.sensor_msgs__msg__Imu]]:
    """Yield time stamp [ns] and message of each IMU sample; the covariances are those of the white noise."""
    unknown = np.zeros(9)
    unknown[0] = _UNKNOWN
    gyro, accel = (
        (density**2 * model.rate_hz * np.eye(3)).ravel()
        for density in (model.gyro_noise_density, model.accel_noise_density)
    )
    level = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)
    rows = zip(samples.t_ns.tolist(), samples.gyro_rad_s.tolist(), samples.accel_m_s2.tolist(), strict=True)
    for t_ns, w, a in rows:
        rate, force = ros.geometry_msgs__msg__Vector3(*w), ros.geometry_msgs__msg__Vector3(*a)
        yield t_ns, ros.sensor_msgs__msg__Imu(header(t_ns, IMU), level, unknown, rate, gyro, force, accel)


def odometry_messages(truth: Trajectory) -> Iterator[tuple[int, ros.nav_msgs__msg__Odometry]]:
    """Yield time stamp [ns] and message of each pose.

    The twist is given in the child frame, that of the IMU, as ROS specifies: the true velocity, and the mean angular
    velocity until the next pose.
    """
    pose_covariance = np.zeros(36)
    twist_covariance = np.zeros(36)
    linear, angular = np.zeros((len(truth), 3)), np.zeros((len(truth), 3))
    if truth.velocity_m_s is None or len(truth) < 2:
        twist_covariance[0] = _UNKNOWN
    else:
        R = truth.rotations
        linear = np.einsum("nji,nj->ni", R, truth.velocity_m_s)
        rotation = log_so3(np.einsum("nji,njk->nik", R[:-1], R[1:]))
        angular[:-1] = rotation / (np.diff(truth.t_ns) * 1e-9)[:, None]
        angular[-1] = angular[-2]
    poses = zip(truth.t_ns.tolist(), truth.p_world_imu.tolist(), truth.quat_wxyz.tolist(), strict=True)
    for (t_ns, p, (qw, qx, qy, qz)), v, w in zip(poses, linear.tolist(), angular.tolist(), strict=True):
        pose = ros.geometry_msgs__msg__Pose(
            ros.geometry_msgs__msg__Point(*p), ros.geometry_msgs__msg__Quaternion(qx, qy, qz, qw)
        )
        twist = ros.geometry_msgs__msg__Twist(ros.geometry_msgs__msg__Vector3(*v), ros.geometry_msgs__msg__Vector3(*w))
        yield (
            t_ns,
            ros.nav_msgs__msg__Odometry(
                header(t_ns, WORLD),
                IMU,
                ros.geometry_msgs__msg__PoseWithCovariance(pose, pose_covariance),
                ros.geometry_msgs__msg__TwistWithCovariance(twist, twist_covariance),
            ),
        )


def vector_messages(
    t_ns: Times, vectors: Array, frame: str
) -> Iterator[tuple[int, ros.geometry_msgs__msg__Vector3Stamped]]:
    """Yield time stamp [ns] and message of each vector (N, 3)."""
    for t, vector in zip(t_ns.tolist(), vectors.tolist(), strict=True):
        yield (
            t,
            ros.geometry_msgs__msg__Vector3Stamped(header(t, frame), ros.geometry_msgs__msg__Vector3(*vector)),
        )


def transform_messages(truth: Trajectory) -> Iterator[tuple[int, ros.tf2_msgs__msg__TFMessage]]:
    """Yield time stamp [ns] and message of each pose of the IMU in the world frame, for /tf."""
    rows = zip(truth.t_ns.tolist(), truth.p_world_imu.tolist(), truth.quat_wxyz.tolist(), strict=True)
    for t_ns, p, q in rows:
        yield t_ns, ros.tf2_msgs__msg__TFMessage([_transform(t_ns, WORLD, IMU, p, q)])


def rig_transforms(rig: Rig, t_ns: int) -> ros.tf2_msgs__msg__TFMessage:
    """Return the poses of the vehicle and the cameras in the IMU frame, for /tf_static."""
    poses = [(VEHICLE, inverse_pose(rig.T_vehicle_imu))]
    poses += [(CAMERA.format(number), camera.T_imu_cam) for number, camera in enumerate(rig.cameras)]
    return ros.tf2_msgs__msg__TFMessage(
        [
            _transform(t_ns, IMU, frame, T[:3, 3].tolist(), quat_wxyz_from_matrix(T[:3, :3]).tolist())
            for frame, T in poses
        ]
    )


def camera_info(
    model: CameraModel, t_ns: int, frame: str, rectification: Rectification | None = None
) -> ros.sensor_msgs__msg__CameraInfo:
    """Return the intrinsics of a camera as a message, which has no field for the readout time.

    ROS has names for ``radtan`` (``plumb_bob``, with eight coefficients ``rational_polynomial``) and ``equidistant``
    only; the others have ours, which programs of ROS do not know.

    Args:
        model: The camera.
        t_ns: Time stamp [ns].
        frame: Frame of reference.
        rectification: Rotation and projection of the rectified camera; those of the camera itself by default.
    """
    name, k = str(model.lens), list(model.distortion)
    if model.lens == "radtan":
        name, k = ("rational_polynomial", k) if len(k) == 8 else ("plumb_bob", [*k, 0.0][:5])  # plumb_bob has k3
    return ros.sensor_msgs__msg__CameraInfo(
        header=header(t_ns, frame),
        height=model.height,
        width=model.width,
        distortion_model=name,
        d=np.array(k),
        k=np.array([model.fx, 0.0, model.cx, 0.0, model.fy, model.cy, 0.0, 0.0, 1.0]),
        r=(rectification.R if rectification else np.eye(3)).ravel(),
        p=(rectification.P if rectification else np.hstack([model.K, np.zeros((3, 1))])).ravel(),
        binning_x=0,
        binning_y=0,
        roi=ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, do_rectify=False),
    )


def camera_model(path: Path, topic: str, info: ros.sensor_msgs__msg__CameraInfo) -> CameraModel:
    """Return the camera model of a CameraInfo message.

    Args:
        path: The bag, for error messages.
        topic: Topic of the message, for error messages.
        info: The message.

    Raises:
        InputError: The lens model is not supported, or the camera is not calibrated.
    """
    d = tuple(float(value) for value in info.d)
    name = _ROS_LENSES.get(info.distortion_model, info.distortion_model)
    if name not in LENSES:
        expected = "plumb_bob, rational_polynomial or equidistant"
        raise InputError(path, f"{topic}: distortion_model {info.distortion_model!r}", expected)
    counts = LENSES[name].COUNTS
    if any(d[counts[-1] :]) or len(d) not in _LENGTHS.union(counts):
        found = f"{topic}: distortion coefficients {list(d)}"
        raise InputError(path, found, f"{' or '.join(map(str, counts))}, possibly followed by zeros")
    count = next(count for count in counts if not any(d[count:]))
    k = (*d[:count], *(count - len(d)) * (0.0,))
    fx, fy, cx, cy = (float(info.k[i]) for i in (0, 4, 2, 5))
    try:
        return CameraModel(info.width, info.height, fx, fy, cx, cy, k, name)
    except ConfigError as error:
        raise InputError(path, f"{topic}: {str(error).partition('; ')[0]}", "a calibrated camera") from None


def image_message(image: Image, t_ns: int, frame: str, png: bool) -> ImageMessage:
    """Return a grey image (H, W) as a message, uncompressed or as PNG."""
    if png:
        data = np.frombuffer(encode_png(image), np.uint8)
        return ros.sensor_msgs__msg__CompressedImage(header(t_ns, frame), "mono8; png compressed", data)
    height, width = image.shape
    pixels = np.ascontiguousarray(image).ravel()
    return ros.sensor_msgs__msg__Image(header(t_ns, frame), height, width, "mono8", 0, width, pixels)


def is_grey_or_colour(message: ImageMessage) -> bool:
    """Return whether a message is an image that `grey_image` can read, which a depth image is not."""
    if isinstance(message, ros.sensor_msgs__msg__CompressedImage):
        return "compressedDepth" not in message.format
    return message.encoding in ENCODINGS


def grey_image(path: Path, where: str, message: ImageMessage, width: int, height: int) -> DeepImage:
    """Return the grey image (height, width) of a message, with 8 or 16 bits as it is stored.

    Args:
        path: The bag, for error messages.
        where: Topic and time, for error messages.
        message: The message.
        width: Expected number of columns [px].
        height: Expected number of rows [px].

    Raises:
        InputError: The image is damaged, or has another size or encoding.
    """
    if isinstance(message, ros.sensor_msgs__msg__CompressedImage):
        return decode_deep_grey(path, message.data.tobytes(), width, height, f"{where}: ")
    encoding = ENCODINGS.get(message.encoding)
    if encoding is None:
        found = f"{where}: an image with encoding {message.encoding!r}"
        raise InputError(path, found, f"one of {', '.join(ENCODINGS)}")
    if (message.width, message.height) != (width, height):
        found = f"{where}: an image of {message.width} × {message.height} px"
        raise InputError(path, found, f"an image of {width} × {height} px")
    if message.step < width * encoding.pixel_bytes or len(message.data) != message.step * height:
        found = f"{where}: an image of {len(message.data)} bytes in rows of {message.step}"
        raise DamagedImageError(path, found, f"{height} rows of at least {width * encoding.pixel_bytes} bytes")
    return grey_pixels(encoding, message.data, message.step, bool(message.is_bigendian), width)


def imu_halves(messages: Sequence[ros.sensor_msgs__msg__Imu]) -> tuple[Array | None, Array | None]:
    """Return angular velocities (N, 3) [rad/s] and specific forces (N, 3) [m/s²] of N messages.

    A half whose covariance says in any message that it is missing is None.
    """
    gyro = [(m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z) for m in messages]
    accel = [(m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z) for m in messages]
    has_gyro = all(m.angular_velocity_covariance[0] != _UNKNOWN for m in messages)
    has_accel = all(m.linear_acceleration_covariance[0] != _UNKNOWN for m in messages)
    return (
        np.array(gyro).reshape(-1, 3) if has_gyro else None,
        np.array(accel).reshape(-1, 3) if has_accel else None,
    )


def position_and_quat_wxyz(message: PoseMessage) -> tuple[float, ...]:
    """Return position x, y, z [m] and quaternion w, x, y, z of a pose message."""
    if isinstance(message, ros.geometry_msgs__msg__TransformStamped):
        p, q = message.transform.translation, message.transform.rotation
        return (p.x, p.y, p.z, q.w, q.x, q.y, q.z)
    pose = message.pose.pose if isinstance(message, ros.nav_msgs__msg__Odometry) else message.pose
    p_, q = pose.position, pose.orientation
    return (p_.x, p_.y, p_.z, q.w, q.x, q.y, q.z)


def velocity_in_body(message: PoseMessage) -> tuple[float, float, float] | None:
    """Return the velocity of a pose message in the body frame [m/s], None if it has none."""
    if not isinstance(message, ros.nav_msgs__msg__Odometry) or message.twist.covariance[0] == _UNKNOWN:
        return None
    v = message.twist.twist.linear
    return (v.x, v.y, v.z)


def _transform(
    t_ns: int, parent: str, child: str, p: Sequence[float], quat_wxyz: Sequence[float]
) -> ros.geometry_msgs__msg__TransformStamped:
    """Return the pose of a child frame in its parent frame as a message."""
    w, x, y, z = quat_wxyz
    return ros.geometry_msgs__msg__TransformStamped(
        header(t_ns, parent),
        child,
        ros.geometry_msgs__msg__Transform(
            ros.geometry_msgs__msg__Vector3(*p), ros.geometry_msgs__msg__Quaternion(x, y, z, w)
        ),
    )
