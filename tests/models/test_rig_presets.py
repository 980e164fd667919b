"""Named rigs, and the refusal of invalid ones by field and value."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.rig import EUROC_CAM0, EUROC_T_IMU_CAM0, EUROC_T_IMU_CAM1, Rig, RigCamera, euroc_rig
from dronevio.models.rig_presets import NANO_CAMERA, RIGS, TUM_VI_CAMERA, UZH_FPV_CAMERA, rig_named

FORWARD = {"euroc": 0.999, "euroc-stereo": 0.999, "rolling": 0.999}


@pytest.mark.parametrize("name", RIGS)
def test_named_rigs_face_forward_with_valid_pixels(name: str) -> None:
    rig = rig_named(name)
    for camera in rig.cameras:
        T_vehicle_cam = rig.T_vehicle_imu @ camera.T_imu_cam
        assert T_vehicle_cam[0, 2] > FORWARD.get(name, 1.0 - 1e-12)
        assert T_vehicle_cam[2, 1] < -0.99
        width, height = camera.model.width, camera.model.height
        border = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
        assert np.isfinite(camera.model.unproject(border)).all()
    for left, right in zip(rig.cameras[:-1], rig.cameras[1:], strict=True):
        baseline = np.linalg.inv(left.T_imu_cam) @ right.T_imu_cam
        assert 0.05 < baseline[0, 3] < 0.15  # the left camera is first


def test_the_default_rig_is_eurocs() -> None:
    ours, theirs = rig_named("euroc"), euroc_rig()
    np.testing.assert_array_equal(ours.cameras[0].T_imu_cam, theirs.cameras[0].T_imu_cam)
    assert ours.cameras[0].model == theirs.cameras[0].model
    assert next(iter(RIGS)) == "euroc"
    baseline = np.linalg.inv(EUROC_T_IMU_CAM0) @ EUROC_T_IMU_CAM1
    assert np.linalg.norm(baseline[:3, 3]) == pytest.approx(0.110, abs=5e-4)  # Burri et al. 2016


def test_fields_of_view_are_as_documented() -> None:
    for model, horizontal_deg, diagonal_deg in (
        (UZH_FPV_CAMERA, 133.0, 170.0),
        (TUM_VI_CAMERA, 154.0, 230.0),
        (NANO_CAMERA, None, 87.0),
    ):
        width, height = model.width, model.height
        middle = np.array([[-0.5, model.cy], [width - 0.5, model.cy]])
        corners = np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]])
        angles = [np.rad2deg(np.arccos(model.unproject(ends)[:, 2]).sum()) for ends in (middle, corners)]
        assert horizontal_deg is None or angles[0] == pytest.approx(horizontal_deg, abs=1.0)
        assert angles[1] == pytest.approx(diagonal_deg, abs=4.0)


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"unknown rig 'eurok'; expected one of euroc, euroc-stereo"):
        rig_named("eurok")


def changed(row: int, column: int, value: float) -> Array:
    """Return EuRoC's extrinsics with one changed element."""
    T = EUROC_T_IMU_CAM0.copy()
    T[row, column] = value
    return T


@pytest.mark.parametrize(
    ("T", "words"),
    [
        (np.zeros((4, 4)), "determinant 0"),
        (changed(0, 0, 0.1), "off the identity"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant -1"),
        (changed(1, 3, np.nan), "finite"),
        (changed(3, 0, 0.5), "last row"),
        (2.0 * np.eye(4), "determinant 8"),
        (np.eye(3), r"shape \(3, 3\)"),
    ],
)
def test_invalid_poses_are_refused(T: Array, words: str) -> None:
    with pytest.raises(ConfigError, match=f"T_imu_cam.*{words}"):
        RigCamera(EUROC_CAM0, T)
    with pytest.raises(ConfigError, match=f"T_vehicle_imu.*{words}"):
        replace(euroc_rig(), T_vehicle_imu=T)


def test_invalid_rates_and_times_are_refused() -> None:
    camera = euroc_rig().cameras[0]
    for rate_hz in (0.0, np.nan):
        with pytest.raises(ConfigError, match=f"rate_hz = {rate_hz}"):
            replace(camera, rate_hz=rate_hz)
    for readout_s, expected in ((-0.01, "a number, 0 to 1"), (0.06, "0 to 0.05 s")):
        with pytest.raises(ConfigError, match=f"readout_s = {readout_s}; expected {expected}"):
            replace(camera, readout_s=readout_s)
    with pytest.raises(ConfigError, match="time_offset_s = inf"):
        replace(euroc_rig(), time_offset_s=np.inf)


def test_different_frame_rates_are_refused() -> None:
    camera = euroc_rig().cameras[0]
    with pytest.raises(ConfigError, match=r"rate_hz = 20.0, 30.0; expected one rate"):
        Rig((camera, replace(camera, rate_hz=30.0)))
