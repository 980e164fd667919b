"""Configuration files of other programs have the fields of their examples, with the right meaning.

The interpretation of each program is implemented here independently: OpenCV parses the YAML files as the programs do,
and its projections verify the order of the coefficients.
"""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix

TIMES_NS = np.array([1403715273262142976, 1403715273312142976])
AT_REST = ImuSamples.empty()
P_CAM = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 1.5], [0.0, 0.0, 3.0]])


def files_of(program: str, rig: Rig, folder: Path) -> dict[str, Path]:
    texts = CONFIGURATIONS[program](rig, TIMES_NS, AT_REST)
    for name, text in texts.items():
        (folder / name).write_text(text)
    return {name: folder / name for name in texts}


def opened(path: Path) -> Any:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    return storage


def rows(node: Any) -> Array:
    return np.array([[node.at(i).at(j).real() for j in range(node.at(i).size())] for i in range(node.size())])


def numbers(node: Any) -> Array:
    return np.array([node.at(i).real() for i in range(node.size())])


def projected(lens: str, fx: float, fy: float, cx: float, cy: float, k: Any) -> Array:
    """Return the pixels of `P_CAM` by the camera models of OpenCV."""
    K, k = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(k, dtype=np.float64)
    zero = np.zeros(3)
    if lens == "equidistant":
        return np.asarray(cv2.fisheye.projectPoints(P_CAM[:, None], zero, zero, K, k)[0][:, 0], np.float64)
    return np.asarray(cv2.projectPoints(P_CAM[:, None], zero, zero, K, k)[0][:, 0], np.float64)


def assert_is(model: CameraModel, intrinsics: Iterable[float], k: Any) -> None:
    """Assert that a camera is the same as that of four intrinsics and four coefficients."""
    fx, fy, cx, cy = intrinsics
    np.testing.assert_allclose(projected(model.lens, fx, fy, cx, cy, k), model.project(P_CAM), atol=1e-9)


@pytest.mark.parametrize("name", RIGS)
def test_openvins(tmp_path: Path, name: str) -> None:
    """OpenVINS parses with OpenCV, and needs the keys of ``config/euroc_mav``."""
    rig = rig_named(name)
    files = files_of("openvins", rig, tmp_path)
    settings = opened(files["estimator_config.yaml"])
    for key in ("relative_config_imu", "relative_config_imucam"):
        assert (tmp_path / settings.getNode(key).string()).exists()
    assert settings.getNode("max_cameras").real() == len(rig.cameras)
    assert settings.getNode("gravity_mag").real() == 9.81
    assert not settings.getNode("init_window_time").empty() and not settings.getNode("feat_rep_slam").empty()
    chain = opened(files["kalibr_imucam_chain.yaml"])
    for i, camera in enumerate(rig.cameras):
        node = chain.getNode(f"cam{i}")
        np.testing.assert_array_equal(rows(node.getNode("T_imu_cam")), camera.T_imu_cam)
        np.testing.assert_allclose(rows(node.getNode("T_cam_imu")) @ camera.T_imu_cam, np.eye(4), atol=1e-5)
        assert node.getNode("distortion_model").string() == camera.model.lens
        assert node.getNode("camera_model").string() == "pinhole"
        assert numbers(node.getNode("resolution")).tolist() == [camera.model.width, camera.model.height]
        assert node.getNode("rostopic").string() == f"/cam{i}/image_raw"
        assert_is(camera.model, numbers(node.getNode("intrinsics")), numbers(node.getNode("distortion_coeffs")))
    storage = opened(files["kalibr_imu_chain.yaml"])  # its nodes are valid while it exists
    imu = storage.getNode("imu0")
    assert imu.getNode("gyroscope_noise_density").real() == rig.imu.gyro_noise_density
    assert imu.getNode("accelerometer_random_walk").real() == rig.imu.accel_random_walk
    assert imu.getNode("update_rate").real() == rig.imu.rate_hz
    assert imu.getNode("model").string() == "kalibr" and imu.getNode("rostopic").string() == "/imu0"
    for key, size in {"T_i_b": 4, "Tw": 3, "R_IMUtoGYRO": 3, "Ta": 3, "R_IMUtoACC": 3}.items():
        np.testing.assert_array_equal(rows(imu.getNode(key)), np.eye(size))
    np.testing.assert_array_equal(rows(imu.getNode("Tg")), np.zeros((3, 3)))


@pytest.mark.parametrize("name", RIGS)
def test_vins_fusion(tmp_path: Path, name: str) -> None:
    rig = rig_named(name)
    files = files_of("vins", rig, tmp_path)
    stereo = len(rig.cameras) > 1
    config = opened(files["stereo_imu_config.yaml" if stereo else "mono_imu_config.yaml"])
    assert config.getNode("imu").real() == 1 and config.getNode("num_of_cam").real() == len(rig.cameras)
    assert config.getNode("td").real() == rig.time_offset_s
    noise = rig.imu.gyro_noise_density * np.sqrt(rig.imu.rate_hz)
    np.testing.assert_allclose(config.getNode("gyr_n").real(), noise)
    for i, camera in enumerate(rig.cameras):
        np.testing.assert_array_equal(config.getNode(f"body_T_cam{i}").mat(), camera.T_imu_cam)
        cam = opened(tmp_path / config.getNode(f"cam{i}_calib").string())
        m = camera.model
        assert (cam.getNode("image_width").real(), cam.getNode("image_height").real()) == (m.width, m.height)
        projection, distortion = cam.getNode("projection_parameters"), cam.getNode("distortion_parameters")
        if m.lens == "equidistant":
            assert cam.getNode("model_type").string() == "KANNALA_BRANDT"
            names, k = ("mu", "mv", "u0", "v0"), [projection.getNode(n).real() for n in ("k2", "k3", "k4", "k5")]
        else:
            assert cam.getNode("model_type").string() == "PINHOLE"
            names, k = ("fx", "fy", "cx", "cy"), [distortion.getNode(n).real() for n in ("k1", "k2", "p1", "p2")]
        assert_is(m, (projection.getNode(n).real() for n in names), k)


@pytest.mark.parametrize("name", RIGS)
def test_orbslam3(tmp_path: Path, name: str) -> None:
    """The parser of ORB-SLAM3 distinguishes integers and numbers with a point."""
    rig = rig_named(name)
    files = files_of("orbslam3", rig, tmp_path)
    settings = opened(files["settings.yaml"])
    assert settings.getNode("File.version").string() == "1.0"
    fisheye = rig.cameras[0].model.lens == "equidistant"
    assert settings.getNode("Camera.type").string() == ("KannalaBrandt8" if fisheye else "PinHole")
    for key in ("Camera.width", "Camera.height", "Camera.fps", "ORBextractor.nFeatures"):
        assert settings.getNode(key).isInt(), key
    for key in ("IMU.NoiseGyro", "IMU.NoiseAcc", "IMU.GyroWalk", "IMU.AccWalk", "IMU.Frequency"):
        assert settings.getNode(key).isReal(), key
    assert settings.getNode("IMU.AccWalk").real() == rig.imu.accel_random_walk
    for i, camera in enumerate(rig.cameras, 1):
        names = ("fx", "fy", "cx", "cy", *(("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")))
        nodes = [settings.getNode(f"Camera{i}.{n}") for n in names]
        assert all(node.isReal() for node in nodes)
        values = [node.real() for node in nodes]
        assert_is(camera.model, values[:4], values[4:])
    np.testing.assert_allclose(settings.getNode("IMU.T_b_c1").mat(), rig.cameras[0].T_imu_cam, atol=1e-7)
    if len(rig.cameras) > 1:  # maps points of the right camera into the left one
        T_left_right = settings.getNode("Stereo.T_c1_c2").mat()
        np.testing.assert_allclose(rig.cameras[0].T_imu_cam @ T_left_right, rig.cameras[1].T_imu_cam, atol=1e-5)
    assert files["times.txt"].read_text().split() == [str(t) for t in TIMES_NS.tolist()]


@pytest.mark.parametrize("name", RIGS)
def test_basalt(tmp_path: Path, name: str) -> None:
    rig = rig_named(name)
    calibration = json.loads(files_of("basalt", rig, tmp_path)["calib.json"].read_text())["value0"]
    assert {len(calibration["calib_accel_bias"]), len(calibration["calib_gyro_bias"])} == {9, 12}
    assert calibration["gyro_noise_std"] == [rig.imu.gyro_noise_density] * 3
    assert calibration["accel_bias_std"] == [rig.imu.accel_random_walk] * 3
    cameras = zip(rig.cameras, calibration["T_imu_cam"], calibration["intrinsics"], strict=True)
    for camera, pose, intrinsics in cameras:
        quat_wxyz = np.array([pose[key] for key in ("qw", "qx", "qy", "qz")])
        T = pose_matrix(matrix_from_quat_wxyz(quat_wxyz), np.array([pose[key] for key in ("px", "py", "pz")]))
        np.testing.assert_allclose(T, camera.T_imu_cam, atol=1e-6)
        n = intrinsics["intrinsics"]
        expected = {"equidistant": "kb4", "radtan": "pinhole-radtan8" if any(camera.model.distortion) else "pinhole"}
        assert intrinsics["camera_type"] == expected[camera.model.lens]
        names = ("k1", "k2", "k3", "k4") if camera.model.lens == "equidistant" else ("k1", "k2", "p1", "p2")
        assert_is(camera.model, [n[key] for key in ("fx", "fy", "cx", "cy")], [n.get(key, 0.0) for key in names])


def test_kimera(tmp_path: Path) -> None:
    rig = rig_named("euroc-stereo")
    files = files_of("kimera", rig, tmp_path)
    for camera, side in zip(rig.cameras, ("Left", "Right"), strict=True):
        params = opened(files[f"{side}CameraParams.yaml"])
        assert params.getNode("camera_id").string() == f"{side.lower()}_cam"
        data = numbers(params.getNode("T_BS").getNode("data")).reshape(4, 4)
        np.testing.assert_array_equal(data, camera.T_imu_cam)
        k = numbers(params.getNode("distortion_coefficients"))
        assert_is(camera.model, numbers(params.getNode("intrinsics")), k)
        assert numbers(params.getNode("resolution")).tolist() == [752, 480]
    imu = opened(files["ImuParams.yaml"])
    assert imu.getNode("accelerometer_noise_density").real() == rig.imu.accel_noise_density
    assert numbers(imu.getNode("n_gravity")).tolist() == [0.0, 0.0, -9.81]
    assert imu.getNode("imu_preintegration_type").real() == 1 and imu.getNode("rate_hz").real() == 200.0


def test_time_offsets_have_the_right_sign(tmp_path: Path) -> None:
    """All programs define t_imu = t_cam + shift."""
    rig = replace(rig_named("euroc"), time_offset_s=0.00125)
    vins = opened(files_of("vins", rig, tmp_path)["mono_imu_config.yaml"])
    assert vins.getNode("td").real() == 0.00125
    kimera = opened(files_of("kimera", rig, tmp_path)["ImuParams.yaml"])
    assert kimera.getNode("imu_time_shift").real() == 0.00125
    openvins = opened(files_of("openvins", rig, tmp_path)["kalibr_imucam_chain.yaml"])
    assert openvins.getNode("cam0").getNode("timeshift_cam_imu").real() == 0.00125
    basalt = json.loads(files_of("basalt", rig, tmp_path)["calib.json"].read_text())
    assert basalt["value0"]["cam_time_offset_ns"] == 1_250_000


@pytest.mark.parametrize("program", ["vins", "orbslam3", "kimera"])
def test_too_many_cameras_are_refused(program: str) -> None:
    two = rig_named("euroc-stereo").cameras
    with pytest.raises(ConfigError, match="one or two"):
        CONFIGURATIONS[program](Rig((*two, *two)), TIMES_NS, AT_REST)


def test_orbslam3_refuses_different_lens_models() -> None:
    cameras = (rig_named("euroc").cameras[0], rig_named("fisheye").cameras[0])
    with pytest.raises(ConfigError, match="different lens models"):
        CONFIGURATIONS["orbslam3"](Rig(cameras), TIMES_NS, AT_REST)
