"""Every lens in the files of this package, of Kalibr and of ROS, and the programs that have it or not."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml as independent
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.lenses.lens import LENSES, LensName
from dronevio.models.recordings.bag.messages import camera_info, camera_model
from dronevio.models.recordings.calibration.euroc import calibration_files, read_euroc_rig
from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.calibration.reading import read_calibration
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named

COEFFICIENTS: dict[str, tuple[LensName, tuple[float, ...]]] = {
    "radtan": ("radtan", (-0.28, 0.07, 2e-4, 2e-5)),
    "radtan5": ("radtan", (-0.28, 0.07, 2e-4, 2e-5, -0.01)),
    "radtan8": ("radtan", (0.4, 0.05, 5e-4, -5e-4, 0.001, 0.5, 0.1, 0.002)),
    "equidistant": ("equidistant", (-0.01, 0.004, -0.002, 0.0002)),
    "fov": ("fov", (0.93,)),
    "ds": ("ds", (-0.172, 0.593)),
    "eucm": ("eucm", (0.63, 1.04)),
    "omni": ("omni", (1.6, -0.2, 0.1, 1e-3, -1e-3)),
}
MODELS = {
    name: CameraModel(640, 480, 310.0, 312.0, 318.5, 242.5, coefficients, lens)
    for name, (lens, coefficients) in COEFFICIENTS.items()
}
TIMES_NS = np.array([1403715273262142976, 1403715273312142976])
PATH = Path("bag")


def rig_of(model: CameraModel) -> Rig:
    """Return EuRoC's stereo rig with another camera model."""
    rig = rig_named("euroc-stereo")
    return replace(rig, cameras=tuple(replace(camera, model=model) for camera in rig.cameras))


def test_all_lenses_are_here() -> None:
    assert {model.lens for model in MODELS.values()} == set(LENSES)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("flow", [None, True, False])
def test_kalibrs_files_return_the_lens(tmp_path: Path, name: str, flow: bool | None) -> None:
    """As written here, and as PyYAML writes them again in another style."""
    rig = rig_of(MODELS[name])
    paths = [tmp_path / "camchain.yaml", tmp_path / "imu.yaml"]
    for path, text in zip(paths, (camchain_yaml(rig), imu_yaml(rig)), strict=True):
        path.write_text(
            text if flow is None else independent.dump(independent.safe_load(text), default_flow_style=flow)
        )
    assert [camera.model for camera in read_calibration(paths).cameras] == [MODELS[name]] * 2


@pytest.mark.parametrize("name", MODELS)
def test_folders_return_the_lens(tmp_path: Path, name: str) -> None:
    for file, text in calibration_files(rig_of(MODELS[name])).items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    assert [camera.model for camera in read_euroc_rig(tmp_path, (0, 1)).cameras] == [MODELS[name]] * 2


def test_kalibr_has_its_own_order_of_the_intrinsics() -> None:
    """Kalibr's "supported models": the coefficients of the camera model precede fu, fv, pu, pv."""
    pinhole = [310.0, 312.0, 318.5, 242.5]
    for name, model, intrinsics, distortion, coefficients in (
        ("ds", "ds", [-0.172, 0.593, *pinhole], "none", []),
        ("eucm", "eucm", [0.63, 1.04, *pinhole], "none", []),
        ("omni", "omni", [1.6, *pinhole], "radtan", [-0.2, 0.1, 1e-3, -1e-3]),
        ("fov", "pinhole", pinhole, "fov", [0.93]),
        ("radtan8", "pinhole", pinhole, "rational_polynomial", list(COEFFICIENTS["radtan8"][1])),
    ):
        cam0 = independent.safe_load(camchain_yaml(rig_of(MODELS[name])))["cam0"]
        assert (cam0["camera_model"], cam0["intrinsics"]) == (model, intrinsics)
        assert (cam0["distortion_model"], cam0["distortion_coeffs"]) == (distortion, coefficients)


CHAIN = camchain_yaml(rig_of(MODELS["radtan"])).partition("cam1:")[0]


@pytest.mark.parametrize(
    ("changes", "model"),
    [
        (
            {"camera_model: pinhole": "camera_model: omni", "[310.0": "[1.2, 310.0", "model: radtan": "model: none"},
            replace(MODELS["omni"], distortion=(1.2, 0.0, 0.0, 0.0, 0.0)),
        ),
        (
            {
                "camera_model: pinhole": "camera_model: ds",
                "[310.0": "[-.2, .6, 310.0",
                "  distortion_model: radtan\n": "",
            },
            replace(MODELS["ds"], distortion=(-0.2, 0.6)),
        ),
        ({"distortion_model: radtan": "distortion_model: none"}, replace(MODELS["radtan"], distortion=(0.0,) * 4)),
    ],
)
def test_cameras_without_distortion_are_read(tmp_path: Path, changes: dict[str, str], model: CameraModel) -> None:
    text = CHAIN
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "camchain.yaml").write_text(text)
    assert read_calibration([tmp_path / "camchain.yaml"]).cameras[0].model == model


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_model: pinhole": "camera_model: ds"}, "cam0.distortion_model: radtan; expected none, for the camera"),
        (
            {"camera_model: pinhole": "camera_model: omni", "model: radtan": "model: fov"},
            "cam0.distortion_model: fov; expected one of none, radtan",
        ),
        ({"camera_model: pinhole": "camera_model: omni"}, "cam0.intrinsics: .*; expected a list of 5 numbers"),
        (
            {"distortion_model: radtan": "distortion_model: fov"},
            "cam0.distortion_coeffs: .*expected a list of 1 numbers",
        ),
        ({"2.0e-05]": "2.0e-05, 0.1, 0.2]"}, "cam0.distortion_coeffs: .*expected a list of 4 or 5 or 8 numbers"),
        ({"distortion_model: radtan": "distortion_model: {a: 1}"}, "cam0.distortion_model: a map"),
    ],
)
def test_wrong_lenses_are_refused(tmp_path: Path, changes: dict[str, str], words: str) -> None:
    text = CHAIN
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "camchain.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        read_calibration([tmp_path / "camchain.yaml"])


@pytest.mark.parametrize(
    ("name", "ros_name", "count"),
    [
        ("radtan", "plumb_bob", 5),
        ("radtan5", "plumb_bob", 5),
        ("radtan8", "rational_polynomial", 8),
        ("equidistant", "equidistant", 4),
        ("fov", "fov", 1),
        ("ds", "ds", 2),
        ("eucm", "eucm", 2),
        ("omni", "omni", 5),
    ],
)
def test_camera_info_returns_the_lens(name: str, ros_name: str, count: int) -> None:
    info = camera_info(MODELS[name], 0, "cam0")
    assert (info.distortion_model, len(info.d)) == (ros_name, count)
    assert info.k[[0, 4, 2, 5]].tolist() == [310.0, 312.0, 318.5, 242.5]
    assert camera_model(PATH, "/info", info) == MODELS[name]


@pytest.mark.parametrize(
    ("name", "d", "expected"),
    [
        ("plumb_bob", (), (0.0, 0.0, 0.0, 0.0)),
        ("", (0.1, 0.2, 0.3, 0.4, 0.0), (0.1, 0.2, 0.3, 0.4)),
        ("rational_polynomial", (0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0), (0.1, 0.2, 0.3, 0.4, 0.5)),
        ("rational_polynomial", (0.1, 0.2, 0.3, 0.4, 0.0, 0.0, 0.0, 0.1), (0.1, 0.2, 0.3, 0.4, 0.0, 0.0, 0.0, 0.1)),
        ("rational_polynomial", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), "4 or 5 or 8, possibly followed by zeros"),
        ("plumb_bob", (0.1, 0.2, 0.3), "4 or 5 or 8, possibly followed by zeros"),
        ("equidistant", (0.1, 0.2, 0.3, 0.4, 0.5), "4, possibly followed by zeros"),
        ("thin_prism", (0.1, 0.2, 0.3, 0.4), "plumb_bob, rational_polynomial or equidistant"),
    ],
)
def test_camera_infos_of_others(name: str, d: tuple[float, ...], expected: Any) -> None:
    info = camera_info(MODELS["radtan"], 0, "cam0")
    info = ros.sensor_msgs__msg__CameraInfo(**{**info.__dict__, "distortion_model": name, "d": np.array(d)})
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            camera_model(PATH, "/info", info)
    else:
        assert camera_model(PATH, "/info", info).distortion == expected


HAS = {
    "kalibr": {"radtan", "equidistant", "fov", "ds", "eucm", "omni"},
    "openvins": {"radtan", "equidistant"},
    "vins": {"radtan", "radtan5", "radtan8", "equidistant", "omni"},
    "orbslam3": {"radtan", "radtan5", "equidistant"},
    "basalt": {"radtan", "radtan5", "radtan8", "equidistant", "ds", "eucm"},
    "kimera": {"radtan", "equidistant"},
}
"""Lenses of each program."""


@pytest.mark.parametrize("program", CONFIGURATIONS)
@pytest.mark.parametrize("name", MODELS)
def test_programs_without_a_lens_are_named(program: str, name: str) -> None:
    rig = rig_of(MODELS[name])
    if name in HAS[program]:
        assert CONFIGURATIONS[program](rig, TIMES_NS, ImuSamples.empty())
        return
    with pytest.raises(ConfigError, match=f"camera lens {MODELS[name].lens}.*; expected .* for ") as caught:
        CONFIGURATIONS[program](rig, TIMES_NS, ImuSamples.empty())
    assert program[:4] in str(caught.value).lower().replace("-", "")


def opened(folder: Path, program: str, file: str, model: CameraModel) -> Any:
    """Return a file of a program's configuration, as OpenCV reads it."""
    (folder / file).write_text(CONFIGURATIONS[program](rig_of(model), TIMES_NS, ImuSamples.empty())[file])
    storage = cv2.FileStorage(str(folder / file), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    return storage


def test_vins_has_the_parameters_of_mei(tmp_path: Path) -> None:
    """The projection of camodocal's CataCamera: onto the unit sphere, from z = −ξ to the plane, distortion, gammas."""
    file = opened(tmp_path, "vins", "cam0.yaml", MODELS["omni"])
    assert file.getNode("model_type").string() == "MEI"
    xi = file.getNode("mirror_parameters").getNode("xi").real()
    k1, k2, p1, p2 = (file.getNode("distortion_parameters").getNode(n).real() for n in ("k1", "k2", "p1", "p2"))
    g1, g2, u0, v0 = (file.getNode("projection_parameters").getNode(n).real() for n in ("gamma1", "gamma2", "u0", "v0"))
    p = np.array([0.4, -0.7, 0.9])
    x, y = p[:2] / np.linalg.norm(p) / (p[2] / np.linalg.norm(p) + xi)
    r2 = x * x + y * y
    radial = k1 * r2 + k2 * r2 * r2
    x, y = (
        x + x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y + y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    )
    np.testing.assert_allclose(MODELS["omni"].project(p), [g1 * x + u0, g2 * y + v0], atol=1e-9)


@pytest.mark.parametrize("name", ["radtan5", "radtan8"])
def test_vins_has_the_parameters_of_the_full_pinhole(tmp_path: Path, name: str) -> None:
    file = opened(tmp_path, "vins", "cam1.yaml", MODELS[name])
    assert file.getNode("model_type").string() == "PINHOLE_FULL"
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    k = [file.getNode("distortion_parameters").getNode(n).real() for n in order]
    assert k == [*MODELS[name].distortion, *(8 - len(MODELS[name].distortion)) * [0.0]]


def test_orbslam3_has_k3(tmp_path: Path) -> None:
    file = opened(tmp_path, "orbslam3", "settings.yaml", MODELS["radtan5"])
    k = [file.getNode(f"Camera2.{n}").real() for n in ("k1", "k2", "p1", "p2", "k3")]
    assert tuple(k) == MODELS["radtan5"].distortion
