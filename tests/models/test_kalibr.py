"""Kalibr's files: round trip, the examples of Kalibr and OpenVINS, and refused files."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import yaml as independent
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuModel
from dronevio.models.lenses.lens import LensName
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.calibration.reading import calibration_of, read_calibrated_rig, read_calibration
from dronevio.models.recordings.calibration.yaml_document import parse_yaml
from dronevio.models.recordings.calibration.yaml_text import indented
from dronevio.models.rig import EUROC_CAM0, EUROC_T_IMU_CAM0, Rig, RigCamera
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

# The example of Kalibr's wiki ("yaml formats"), with the poses of the second camera completed to rigid ones.
WIKI_CAMCHAIN = """\
cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  T_cam_imu:
  - [0.01779318, 0.99967549,-0.01822936, 0.07008565]
  - [-0.9998017, 0.01795239, 0.00860714,-0.01771023]
  - [0.00893160, 0.01807260, 0.99979678, 0.00399246]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: -8.121e-05
  rostopic: /cam0/image_raw
  resolution: [752, 480]
cam1:
  camera_model: pinhole
  intrinsics: [450.0, 449.0, 373.850, 253.749]
  distortion_model: equidistant
  distortion_coeffs: [-0.01, 0.05,
    -0.04, 0.01]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  rostopic: /cam1/image_raw
  resolution: [752, 480]
"""
KALIBR_IMU = """\
#Accelerometers
accelerometer_noise_density: 1.86e-03   #Noise density (continuous-time)
accelerometer_random_walk:   4.33e-04   #Bias random walk

#Gyroscopes
gyroscope_noise_density:     1.87e-04   #Noise density (continuous-time)
gyroscope_random_walk:       2.66e-05   #Bias random walk

rostopic:                    /imu0      #the IMU ROS topic
update_rate:                 500.0      #Hz (for discretization of the values above)
"""


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kalibr")


def written(folder: Path, *texts: str) -> list[Path]:
    paths = [folder / f"{number}.yaml" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return paths


def assert_same_rig(ours: Rig, theirs: Rig) -> None:
    assert ours.imu == theirs.imu and ours.time_offset_s == theirs.time_offset_s
    np.testing.assert_array_equal(ours.T_vehicle_imu, theirs.T_vehicle_imu)
    for a, b in zip(ours.cameras, theirs.cameras, strict=True):
        assert (a.model, a.rate_hz, a.readout_s) == (b.model, b.rate_hz, b.readout_s)
        np.testing.assert_array_equal(a.T_imu_cam, b.T_imu_cam)


@pytest.mark.parametrize("name", RIGS)
def test_round_trip_of_every_rig_is_exact(scratch: Path, name: str) -> None:
    rig = replace(rig_named(name), time_offset_s=-1e-5 / 3)
    two = read_calibration(written(scratch, camchain_yaml(rig), imu_yaml(rig)))
    assert_same_rig(two.rig(), rig)
    assert two.topics == tuple(f"/cam{i}/image_raw" for i in range(len(rig.cameras)))
    one = read_calibration(written(scratch, f"{camchain_yaml(rig)}imu0:\n{indented(imu_yaml(rig, 'increment'))}"))
    assert_same_rig(one.rig(), rig)
    assert (two.sampling, one.sampling) == ("point", "increment")


LENSES_BY_NAME: tuple[LensName, ...] = ("radtan", "equidistant")
finite = st.floats(-1e6, 1e6)
positive = st.floats(1e-12, 1e6)


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    def pose() -> npt.NDArray[np.float64]:
        phi, p = (draw(hnp.arrays(np.float64, 3, elements=st.floats(-3, 3))) for _ in range(2))
        return pose_matrix(exp_so3(phi), p)

    def camera() -> RigCamera:
        lens = draw(st.sampled_from(LENSES_BY_NAME))
        coefficient = st.floats(-1e3, 1e3)
        distortion = draw(st.tuples(coefficient, coefficient, coefficient, coefficient))
        width, height = (draw(st.integers(1, 10_000)) for _ in range(2))
        focal_px = st.floats(1e-3, 1e6)
        fx, fy, cx, cy = draw(st.tuples(focal_px, focal_px, finite, finite))
        model = CameraModel(width, height, fx, fy, cx, cy, distortion, lens)
        return RigCamera(model, pose(), 20.0, draw(st.floats(0, 0.05)))

    numbers = [draw(positive) for _ in fields(ImuModel)[1:]]
    cameras = tuple(camera() for _ in range(draw(st.integers(1, 3))))
    return Rig(cameras, ImuModel(draw(st.text(max_size=6)), *numbers), pose(), draw(st.floats(-1, 1)))


@settings(max_examples=60, deadline=None)
@given(rigs())
def test_round_trip_of_arbitrary_rigs_is_exact(scratch: Path, rig: Rig) -> None:
    assert_same_rig(read_calibration(written(scratch, camchain_yaml(rig), imu_yaml(rig))).rig(), rig)


def test_an_independent_parser_finds_kalibrs_definitions() -> None:
    """PyYAML, the parser of Kalibr, on a stereo rig: numbers are numbers, and poses have Kalibr's direction."""
    rig = replace(rig_named("euroc-stereo"), time_offset_s=3e-5)
    chain, imu = independent.safe_load(camchain_yaml(rig)), independent.safe_load(imu_yaml(rig))
    assert list(chain) == ["cam0", "cam1"]  # Kalibr uses the number of keys
    p_imu = np.array([0.3, -0.2, 1.5, 1.0])
    for i, cam in enumerate(chain.values()):
        p_cam = np.array(cam["T_cam_imu"]) @ p_imu  # maps points of the IMU frame into the camera frame
        np.testing.assert_allclose(rig.cameras[i].T_imu_cam @ p_cam, p_imu, atol=1e-12)
        assert cam["timeshift_cam_imu"] == 3e-5  # t_imu = t_cam + shift
        assert cam["cam_overlaps"] == [1 - i] and cam["resolution"] == [752, 480]
    T_c0_imu, T_c1_imu = (np.array(cam["T_cam_imu"]) for cam in chain.values())
    np.testing.assert_allclose(np.array(chain["cam1"]["T_cn_cnm1"]) @ T_c0_imu, T_c1_imu, atol=1e-9)
    assert imu["gyroscope_noise_density"] == rig.imu.gyro_noise_density
    assert imu["accelerometer_random_walk"] == rig.imu.accel_random_walk
    assert imu["update_rate"] == 200.0


def test_the_examples_of_kalibr_are_read(scratch: Path) -> None:
    calibration = read_calibration(written(scratch, KALIBR_IMU, WIKI_CAMCHAIN), rate_hz=30.0)
    rig = calibration.rig()
    assert rig.imu.gyro_noise_density == 1.87e-4 and rig.imu.accel_random_walk == 4.33e-4 and rig.imu.rate_hz == 500.0
    assert rig.time_offset_s == -8.121e-5
    assert [camera.model.lens for camera in rig.cameras] == ["radtan", "equidistant"]
    assert [camera.rate_hz for camera in rig.cameras] == [30.0, 30.0]
    T_cam0_cam1 = inverse_pose(rig.cameras[0].T_imu_cam) @ rig.cameras[1].T_imu_cam
    np.testing.assert_allclose(T_cam0_cam1[:3, 3], [0.11, 0.0, 0.0], atol=1e-5)  # the second camera is on the right


def test_the_files_of_openvins_are_read(scratch: Path) -> None:
    """OpenVINS writes ``%YAML:1.0``, ``imu0`` as a map, and ``T_imu_cam`` instead of its inverse."""
    rows = "".join(f"    - {row}\n" for row in EUROC_T_IMU_CAM0.tolist())
    chain = (
        "%YAML:1.0\n\ncam0:\n  T_imu_cam: #rotation from camera to IMU R_CtoI, position of camera in IMU p_CinI\n"
        f"{rows}  cam_overlaps: [1]\n  camera_model: pinhole\n"
        "  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]\n  distortion_model: radtan\n"
        "  intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv\n  resolution: [752, 480]\n"
    )
    imu = f"%YAML:1.0\n---\nimu0:\n{indented(KALIBR_IMU)}"
    rig = read_calibration(written(scratch, chain, imu)).rig()
    assert rig.cameras[0].model == EUROC_CAM0
    np.testing.assert_array_equal(rig.cameras[0].T_imu_cam, EUROC_T_IMU_CAM0)


def test_the_imu_file_is_found_in_the_same_folder(tmp_path: Path) -> None:
    rig = rig_named("euroc-stereo")
    (tmp_path / "camchain.yaml").write_text(camchain_yaml(rig))
    with pytest.raises(InputError, match=r"Kalibr's imu\.yaml as well"):
        read_calibrated_rig(tmp_path / "camchain.yaml")
    (tmp_path / "elsewhere.yaml").write_text(imu_yaml(rig))
    assert_same_rig(read_calibrated_rig(tmp_path / "camchain.yaml", tmp_path / "elsewhere.yaml"), rig)
    (tmp_path / "imu.yaml").write_text(imu_yaml(rig))
    for path in (tmp_path, tmp_path / "camchain.yaml"):
        assert_same_rig(read_calibrated_rig(path), rig)


CHAIN, IMU = camchain_yaml(rig_named("euroc-stereo")), imu_yaml(rig_named("euroc-stereo"))


def without(key: str) -> Callable[[str], str]:
    return lambda text: text.replace(f"  {key}:", f"  no_{key}:").replace(f"\n{key}:", f"\nno_{key}:")


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("camera_model: pinhole", "camera_model: fisheye", "cam0.camera_model: fisheye"),
        ("distortion_model: radtan", "distortion_model: magic", "cam0.distortion_model: magic"),
        ("distortion_coeffs: [-0.28340811,", "distortion_coeffs: [", "cam0.distortion_coeffs"),
        ("resolution: [752, 480]", "resolution: [752, 0]", "whole pixels"),
        ("intrinsics: [458.654", "intrinsics: [-1", "positive focal lengths"),
        ("timeshift_cam_imu: 0.0", "timeshift_cam_imu: .nan", 'cam0.timeshift_cam_imu: ".nan"'),
        ("timeshift_cam_imu: 0.0", "timeshift_cam_imu: 5.0", "time_offset_s = -5.0"),
        ("rate_hz: 20.0", "rate_hz: 10.0", "one rate"),
        ("rate_hz: 20.0", "rate_hz: 20.0\n  readout_s: 1.0", "readout_s = 1.0"),
        ("T_imu_cam:\n    - [0.01486", "T_imu_cam:\n    - [0.9", "cam0.T_imu_cam"),
        ("-0.0216401454975]", "0.5]", "a pose that agrees with cam0.T_imu_cam"),
        ("-0.0216401454975]", "word]", "four rows of four numbers"),
        ("gyroscope_noise_density: 0.00016968", "gyroscope_noise_density: 0.0", "a positive number"),
        ("gyroscope_noise_density: 0.00016968", "gyroscope_noise_density: -1.0", "a positive number"),
        ("gyroscope_noise_density: 0.00016968", "gyroscope_noise_density: .nan", "a positive number"),
        ("gyroscope_noise_density: 0.00016968", "gyroscope_noise_density: 1e999", "a positive number"),
        ("accelerometer_random_walk: 0.003", "accelerometer_random_walk: null", "no field accelerometer_random_walk"),
        ("rostopic: /imu0", "rostopic: /imu0\nsampling: often", "point or increment"),
        ("cam1:", "cam0:", "a second"),
        ("cam0:", "cam0: &a", "single"),
        ("rate_hz: 20.0", "rate_hz: !!python/object/apply:os.system ['true']", "python/object"),
        ("rate_hz: 20.0", "rate_hz: *a", "alias"),
        ("rate_hz: 20.0", "rate_hz: [{a: 1}]", "a map in a list"),
        ("rate_hz: 20.0", "? [1, 2]\n  : 3", "a key that is not a word"),
        ("rate_hz: 20.0", "rate_hz: @", "cannot start any token"),
        ("rate_hz: 20.0", "rate_hz: \x07", "special characters"),
    ],
)
def test_errors_name_file_and_cause(scratch: Path, old: str, new: str, found: str) -> None:
    paths = written(scratch, CHAIN.replace(old, new, 1), IMU.replace(old, new, 1))
    if new == "cam0: &a":  # an anchor without an alias is allowed
        assert len(read_calibration(paths).cameras) == 2
        return
    with pytest.raises(InputError) as caught:
        read_calibration(paths).rig()
    assert found in str(caught.value) and "\n" not in str(caught.value)
    assert caught.value.path == paths[0 if old in CHAIN else 1]


@pytest.mark.parametrize(
    ("texts", "missing"),
    [
        ([CHAIN], "Kalibr's imu.yaml as well"),
        ([IMU], "Kalibr's camchain.yaml"),
        ([without("T_imu_cam")(without("T_cam_imu")(CHAIN)), IMU], "no field cam0.T_cam_imu"),
        ([without("resolution")(CHAIN), IMU], "no field cam0.resolution"),
        ([without("intrinsics")(CHAIN), IMU], "no field cam0.intrinsics"),
        ([CHAIN, without("gyroscope_random_walk")(IMU)], "no field gyroscope_random_walk"),
        ([CHAIN, without("update_rate")(IMU)], "no field update_rate"),
        ([CHAIN, CHAIN, IMU], "one file with cameras"),
        ([CHAIN, IMU, IMU], "one file with an IMU"),
        (["a: 1\n"], "neither cam0 nor"),
        ([""], "neither cam0 nor"),
        (["- 1\n"], "not a map"),
        (["a: &x [1.0]\nb: [*x, *x]\n"], "an alias, *x"),
        (["a" * 200_001], "at most"),
        (["[" * 100_000], "nested"),
    ],
)
def test_errors_name_missing_fields(scratch: Path, texts: list[str], missing: str) -> None:
    with pytest.raises(InputError) as caught:
        read_calibration(written(scratch, *texts)).rig()
    assert missing in str(caught.value)


def test_missing_files_are_named(scratch: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_calibration([scratch / "missing.yaml"])


@settings(max_examples=200, deadline=None)
@example(1191, 8, "e")  # a rotation of 1e200
@example(142, 3, "")  # a coefficient of the lens of 7395907
@given(st.integers(0, len(CHAIN + IMU)), st.integers(0, 40), st.text("abT_:[],# \n\t-%\"'&*!{}0.1e", max_size=6))
def test_broken_text_is_refused_or_read(start: int, length: int, inserted: str) -> None:
    """A fuzzed file is refused with file and cause, or yields a valid rig."""
    text = f"{CHAIN}{IMU}"
    path = Path("calibration.yaml")
    try:
        rig = calibration_of([parse_yaml(path, text[:start] + inserted + text[start + length :])]).rig()
    except InputError as error:
        assert str(error).startswith("calibration.yaml") and "\n" not in str(error)
    else:
        assert rig.imu.gyro_noise_density > 0.0 and len(rig.cameras) >= 1
