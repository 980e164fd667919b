"""What library calls answer to measurements of wrong types, sizes and values."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dronevio as dv
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.state import NO_IMAGE, CameraFrame

GYRO, ACCEL = np.zeros((2, 3)), np.full((2, 3), 9.81)
T_NS = np.array([5_000_000, 10_000_000])
IMAGE = np.zeros((480, 752), np.uint8)


def estimator() -> VisualInertialOdometry:
    """Return an estimator of a stereo rig before its first measurement."""
    return VisualInertialOdometry(rig_named("euroc-stereo"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((T_NS * 1e-9, GYRO, ACCEL), "ImuSamples.t_ns of type float64; expected whole nanoseconds"),
        ((T_NS.tolist(), GYRO, ACCEL), "ImuSamples.t_ns of type list; expected an array"),
        ((T_NS, GYRO.tolist(), ACCEL), "ImuSamples.gyro_rad_s of type list; expected an array"),
        ((T_NS, GYRO, ACCEL.astype(str)), "expected numbers, float64"),
        ((T_NS[0], GYRO, ACCEL), "ImuSamples.t_ns of type int64; expected an array"),
        ((T_NS[::-1], GYRO, ACCEL), "do not increase: 5000000 ns after 10000000 ns"),
        ((T_NS, GYRO[:1], ACCEL), r"expected \(N,\), \(N, 3\), \(N, 3\)"),
    ],
)
def test_wrong_imu_samples_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ImuSamples(*arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.05, (IMAGE,)), "time stamp 0.05; expected whole nanoseconds"),
        ((50_000_000, IMAGE), "images of type ndarray; expected a tuple"),
    ],
)
def test_wrong_frames_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CameraFrame(*arguments)


@pytest.mark.parametrize(
    ("push", "message"),
    [
        (lambda vio: vio.add_imu([0.0] * 7), "IMU samples of type list; expected ImuSamples"),
        (
            lambda vio: vio.add_imu(ImuSamples(T_NS, GYRO, np.where(np.eye(2, 3), np.nan, ACCEL))),
            "IMU sample at 5000000 ns with accel_m_s2 = .nan, 9.81, 9.81.; expected finite numbers",
        ),
        (lambda vio: vio.add_frame(CameraFrame(0, ())), "with 0 images; expected 2, one for each camera"),
        (lambda vio: vio.add_frame(CameraFrame(0, (IMAGE,))), "with 1 images; expected 2, one for each camera"),
        (lambda vio: vio.add_frame(CameraFrame(0, (IMAGE,) * 3)), "with 3 images; expected 2, one for each camera"),
        (lambda vio: vio.add_frame(CameraFrame(0, (IMAGE, IMAGE[:9]))), r"image 1 is uint8 array of shape \(9, 752\)"),
    ],
)
def test_estimators_refuse_wrong_measurements(push: Callable[[VisualInertialOdometry], None], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        push(estimator())


def test_a_camera_may_have_no_image() -> None:
    assert estimator().add_frame(CameraFrame(0, (IMAGE, NO_IMAGE))).state is None


def test_odometry_needs_a_camera() -> None:
    with pytest.raises(ConfigError, match="a rig without cameras; expected at least one camera"):
        VisualInertialOdometry(Rig(()))
    with pytest.raises(ConfigError, match="a rig of type str; expected Rig"):
        VisualInertialOdometry("euroc")  # type: ignore[arg-type]


def test_arguments_of_another_type_are_named(noise_recording: Callable[..., Any]) -> None:
    with pytest.raises(ConfigError, match=r"estimate\(\) of int; expected a recording or its path"):
        dv.estimate(5)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"estimate\(\) with 'vio'; expected an estimator or a VioConfig"):
        dv.estimate(noise_recording(), "vio")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="slam=True with an estimator of type VisualInertialOdometry"):
        dv.estimate(noise_recording(), dv.VisualInertialOdometry(noise_recording().rig), slam=True)
    without = replace(noise_recording(), rig=Rig(()))
    with pytest.raises(ConfigError, match="a rig without cameras"):
        dv.estimate(without)
