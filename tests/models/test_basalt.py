"""Basalt's calibration: values of a file like that of TUM-VI, round trip, and refused files."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.recordings.calibration.basalt import basalt_json
from dronevio.models.recordings.calibration.calibration import Calibration
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.calibration.reading import read_calibration
from dronevio.models.recordings.open import read_rig
from dronevio.models.rig import EUROC_CAM0, Rig
from dronevio.models.rig_presets import rig_named


def tumvi() -> dict[str, Any]:
    """Return a document with the structure of TUM-VI's: a quarter turn about z, two lenses, a vignette."""
    half = np.sqrt(0.5)
    pose = {"px": 0.05, "py": -0.07, "pz": 0.1, "qx": 0.0, "qy": 0.0, "qz": half, "qw": half}
    pinhole = {"fx": 158.0, "fy": 159.0, "cx": 254.5, "cy": 256.5}
    return {
        "T_imu_cam": [pose, pose | {"px": -0.05}],
        "intrinsics": [
            {"camera_type": "ds", "intrinsics": pinhole | {"xi": -0.17, "alpha": 0.59}},
            {"camera_type": "ucm", "intrinsics": pinhole | {"alpha": 0.5}},
        ],
        "resolution": [[512, 512], [512, 480]],
        "vignette": [{"value0": 0, "value1": 10000000000, "value2": [[0.98], [0.99]]}],
        "calib_accel_bias": [-0.001] + 8 * [0.0],
        "calib_gyro_bias": [-0.001] + 11 * [0.0],
        "imu_update_rate": 200.0,
        "accel_noise_std": [0.016, 0.015, 0.014],
        "gyro_noise_std": [0.000282, 0.000282, 0.000282],
        "accel_bias_std": [0.001, 0.001, 0.001],
        "gyro_bias_std": 0.0001,
        "mocap_time_offset_ns": 0,
        "cam_time_offset_ns": -2000000,
    }


def read(path: Path, document: dict[str, Any]) -> Calibration:
    path.write_text(json.dumps({"value0": document}, indent=4))
    return read_calibration([path], rate_hz=30.0)


def test_a_file_like_that_of_tum_vi_is_read(tmp_path: Path) -> None:
    calibration = read(tmp_path / "calibration.json", tumvi())
    rig = calibration.rig()
    first, second = rig.cameras
    assert first.model == CameraModel(512, 512, 158.0, 159.0, 254.5, 256.5, (-0.17, 0.59), "ds")
    assert second.model == CameraModel(512, 480, 158.0, 159.0, 254.5, 256.5, (0.5, 1.0), "eucm")
    turn = [[0.0, -1.0, 0.0, 0.05], [1.0, 0.0, 0.0, -0.07], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]]
    np.testing.assert_allclose(first.T_imu_cam, turn, atol=1e-15)
    assert second.T_imu_cam[0, 3] == -0.05 and first.rate_hz == 30.0
    assert rig.time_offset_s == -0.002 and calibration.topics == ("", "")
    assert (rig.imu.rate_hz, rig.imu.gyro_noise_density, rig.imu.gyro_random_walk) == (200.0, 0.000282, 0.0001)
    assert (rig.imu.accel_noise_density, rig.imu.accel_random_walk) == (0.016, 0.001)


COEFFICIENTS = (-0.28, 0.07, 2e-4, 2e-5, 0.01, 0.02, -0.03, 0.004)


@pytest.mark.parametrize(
    "model",
    [
        EUROC_CAM0,
        replace(EUROC_CAM0, distortion=(0.0, 0.0, 0.0, 0.0)),
        replace(EUROC_CAM0, distortion=COEFFICIENTS[:5]),
        replace(EUROC_CAM0, distortion=COEFFICIENTS),
        replace(EUROC_CAM0, distortion=(0.01, -0.02, 0.003, 0.004), lens="equidistant"),
        replace(EUROC_CAM0, distortion=(-0.2, 0.6), lens="ds"),
        replace(EUROC_CAM0, distortion=(0.6, 1.1), lens="eucm"),
    ],
)
def test_round_trip(tmp_path: Path, model: CameraModel) -> None:
    rig = rig_named("euroc-stereo")
    rig = replace(rig, time_offset_s=-0.0031, cameras=tuple(replace(camera, model=model) for camera in rig.cameras))
    path = tmp_path / "calibration.json"
    path.write_text(basalt_json(rig))
    back = read_rig(path)
    for ours, theirs in zip(rig.cameras, back.cameras, strict=True):
        np.testing.assert_allclose(theirs.T_imu_cam, ours.T_imu_cam, atol=1e-8)  # EuRoC's rotations have 9 digits
        count = len(ours.model.distortion)
        assert theirs.model.distortion[:count] == ours.model.distortion and not any(theirs.model.distortion[count:])
        assert replace(theirs.model, distortion=ours.model.distortion) == ours.model
    names = ("rate_hz", "gyro_noise_density", "gyro_random_walk", "accel_noise_density", "accel_random_walk")
    assert [getattr(back.imu, name) for name in names] == [getattr(rig.imu, name) for name in names]
    assert back.time_offset_s == rig.time_offset_s


@pytest.mark.parametrize(("lens", "distortion"), [("fov", (0.9,)), ("omni", (1.0, 0.0, 0.0, 0.0, 0.0))])
def test_lenses_that_basalt_does_not_have_are_refused(lens: Any, distortion: tuple[float, ...]) -> None:
    rig: Rig = rig_named("euroc")
    camera = replace(rig.cameras[0], model=replace(EUROC_CAM0, lens=lens, distortion=distortion))
    with pytest.raises(ConfigError, match=f"camera lens {lens}; expected one of .* for Basalt"):
        basalt_json(replace(rig, cameras=(camera,)))


def removed(key: str) -> Callable[[dict[str, Any]], Any]:
    return lambda document: document.pop(key)


def changed(*keys: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            changed("intrinsics", 0, "camera_type", value="ftheta"),
            ":25: value0.intrinsics.0.camera_type: ftheta; expected",
        ),
        (changed("intrinsics", 0, "intrinsics", "xi", value=3.0), "camera xi = 3.0; expected a number, more than -1"),
        (changed("intrinsics", 1, "intrinsics", "alpha", value="x"), "value0.intrinsics.1.intrinsics.alpha: x"),
        (changed("intrinsics", value=[]), "value0.intrinsics"),
        (removed("resolution"), "value0.resolution: width and height"),
        (changed("resolution", value=[[512, 512]]), "value0.resolution"),
        (changed("resolution", value=[[512, 512], [512.5, 3]]), "whole pixels"),
        (removed("T_imu_cam"), "no field value0.T_imu_cam.0.px"),
        (changed("T_imu_cam", 1, "qw", value=0.2), "unit quaternion"),
        (removed("imu_update_rate"), "no field value0.imu_update_rate"),
        (changed("gyro_noise_std", value=[0.0, 0.0, 0.0]), "value0.gyro_noise_std.* positive numbers"),
        (changed("gyro_noise_std", value=[1.0]), "a list of 3 numbers"),
    ],
)
def test_errors_name_file_and_field(tmp_path: Path, change: Callable[[dict[str, Any]], Any], words: str) -> None:
    document = tumvi()
    change(document)
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path / "calibration.json", document)
    assert str(caught.value).startswith(str(tmp_path / "calibration.json"))


def test_files_of_both_programs_are_combined(tmp_path: Path) -> None:
    rig = rig_named("euroc")
    json_file, chain, imu = (tmp_path / name for name in ("calibration.json", "camchain.yaml", "imu.yaml"))
    json_file.write_text(basalt_json(rig))
    chain.write_text(camchain_yaml(rig))
    imu.write_text(imu_yaml(rig))
    with pytest.raises(InputError, match=r"cameras, which .*calibration\.json has as well"):
        read_calibration([json_file, chain])
    with pytest.raises(InputError, match=r"an IMU, which .*calibration\.json has as well"):
        read_calibration([json_file, imu])
