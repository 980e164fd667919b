"""Exports have every key that the parser of their program demands, and none that it no longer reads.

The keys below were read from the sources of the programs. A parser demands a key if its absence ends the program or
leaves a variable without a value.

- OpenVINS, master after v2.7: ``StateOptions.h``, ``VioManagerOptions.h``, ``InertialInitializerOptions.h``, and the
  example ``config/euroc_mav`` at commit 93adc24.
- Kimera-VIO: ``CameraParams.cpp`` at commit 0657301, ``ImuFrontendParams.cpp`` at commit db6748d; the bias and the time
  alignment are those of ``ImuParams`` in ``CrossCorrTimeAligner.cpp`` of later versions.
- VINS-Fusion, commit 3d6cfb6: ``estimator/parameters.cpp``; ``PinholeCamera.cc`` of camodocal.
- ORB-SLAM3, commit 1464d8f (v1.0): ``Settings.cc``.
- Basalt, headers at commit 2ae558c: ``headers_serialization.h``.
- Kalibr, commit 0b8b9e8: ``ConfigReader.py``.
"""

import json
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from dronevio.models.errors import InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.calibration.euroc import calibration_files, read_euroc_rig
from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
from dronevio.models.recordings.calibration.yaml_document import parse_yaml
from dronevio.models.rig_presets import rig_named

Keys = dict[str, frozenset[str]]
"""Keys by the name of a file; nested keys are joined by dots."""

OPENVINS_ESTIMATOR = """
    use_fej integration calib_cam_extrinsics calib_cam_intrinsics calib_cam_timeoffset calib_imu_intrinsics
    calib_imu_g_sensitivity max_clones max_slam max_slam_in_update max_msckf_in_update num_aruco max_cameras
    feat_rep_msckf feat_rep_slam feat_rep_aruco dt_slam_delay try_zupt zupt_max_velocity zupt_noise_multiplier
    zupt_max_disparity zupt_only_at_beginning record_timing_information record_timing_filepath
    up_msckf_sigma_px up_msckf_chi2_multipler up_slam_sigma_px up_slam_chi2_multipler up_aruco_sigma_px
    up_aruco_chi2_multipler zupt_chi2_multipler gravity_mag use_mask use_stereo use_klt use_aruco
    downsize_aruco downsample_cameras num_opencv_threads num_pts fast_threshold grid_x grid_y min_px_dist
    histogram_method knn_ratio track_frequency init_window_time init_imu_thresh init_max_disparity
    init_max_features init_dyn_use init_dyn_mle_opt_calib init_dyn_mle_max_iter init_dyn_mle_max_threads
    init_dyn_mle_max_time init_dyn_num_pose init_dyn_min_deg init_dyn_inflation_ori init_dyn_inflation_vel
    init_dyn_inflation_bg init_dyn_inflation_ba init_dyn_min_rec_cond init_dyn_bias_g init_dyn_bias_a
    relative_config_imu relative_config_imucam verbosity save_total_state filepath_est filepath_std
    filepath_gt
"""
OPENVINS_IMU = """
    gyroscope_noise_density gyroscope_random_walk accelerometer_noise_density accelerometer_random_walk model
    Tw Ta R_IMUtoACC R_IMUtoGYRO Tg rostopic
"""
OPENVINS_CAMERA = "distortion_model intrinsics distortion_coeffs resolution T_imu_cam timeshift_cam_imu rostopic"
KIMERA_CAMERA = """
    camera_id camera_model distortion_model distortion_coefficients intrinsics resolution rate_hz T_BS.rows
    T_BS.cols T_BS.data
"""
KIMERA_IMU = """
    imu_preintegration_type T_BS.data rate_hz gyroscope_noise_density accelerometer_noise_density
    gyroscope_random_walk accelerometer_random_walk imu_integration_sigma imu_time_shift n_gravity
    imu_bias_init_sigma do_imu_rate_time_alignment time_alignment_window_size_s
    time_alignment_variance_threshold_scaling
"""
VINS = """
    image0_topic image1_topic max_cnt min_dist F_threshold show_track flow_back multiple_thread imu imu_topic
    acc_n acc_w gyr_n gyr_w g_norm max_solver_time max_num_iterations keyframe_parallax output_path
    estimate_extrinsic body_T_cam0 num_of_cam cam0_calib cam1_calib body_T_cam1 td estimate_td image_height
    image_width
"""
VINS_CAMERA = """
    model_type camera_name image_width image_height distortion_parameters.k1 distortion_parameters.k2
    distortion_parameters.p1 distortion_parameters.p2 projection_parameters.fx projection_parameters.fy
    projection_parameters.cx projection_parameters.cy
"""
ORBSLAM3 = """
    File.version Camera.type Camera1.fx Camera1.fy Camera1.cx Camera1.cy Camera1.k1 Camera1.k2 Camera1.p1
    Camera1.p2 Camera2.fx Camera2.fy Camera2.cx Camera2.cy Camera2.k1 Camera2.k2 Camera2.p1 Camera2.p2
    Stereo.T_c1_c2 Stereo.ThDepth Camera.height Camera.width Camera.fps Camera.RGB IMU.NoiseGyro IMU.NoiseAcc
    IMU.GyroWalk IMU.AccWalk IMU.Frequency IMU.T_b_c1 ORBextractor.nFeatures ORBextractor.scaleFactor
    ORBextractor.nLevels ORBextractor.iniThFAST ORBextractor.minThFAST Viewer.KeyFrameSize
    Viewer.KeyFrameLineWidth Viewer.GraphLineWidth Viewer.PointSize Viewer.CameraSize Viewer.CameraLineWidth
    Viewer.ViewpointX Viewer.ViewpointY Viewer.ViewpointZ Viewer.ViewpointF
"""
BASALT = """
    T_imu_cam intrinsics resolution calib_accel_bias calib_gyro_bias imu_update_rate accel_noise_std
    gyro_noise_std accel_bias_std gyro_bias_std cam_time_offset_ns vignette T_mocap_world T_imu_marker
    mocap_time_offset_ns mocap_to_imu_offset_ns
"""
KALIBR_CAMERA = """
    rostopic camera_model intrinsics distortion_model distortion_coeffs resolution T_cam_imu timeshift_cam_imu
    cam_overlaps
"""
KALIBR_IMU = """
    rostopic update_rate accelerometer_noise_density accelerometer_random_walk gyroscope_noise_density
    gyroscope_random_walk
"""


def keys(text: str, prefix: str = "") -> frozenset[str]:
    return frozenset(prefix + key for key in text.split())


DEMANDED: dict[str, Keys] = {
    "openvins": {
        "estimator_config.yaml": keys(OPENVINS_ESTIMATOR),
        "kalibr_imu_chain.yaml": keys(OPENVINS_IMU, "imu0."),
        "kalibr_imucam_chain.yaml": keys(OPENVINS_CAMERA, "cam0.") | keys(OPENVINS_CAMERA, "cam1."),
    },
    "kimera": {
        "ImuParams.yaml": keys(KIMERA_IMU),
        "LeftCameraParams.yaml": keys(KIMERA_CAMERA),
        "RightCameraParams.yaml": keys(KIMERA_CAMERA),
    },
    "vins": {"stereo_imu_config.yaml": keys(VINS), "cam0.yaml": keys(VINS_CAMERA), "cam1.yaml": keys(VINS_CAMERA)},
    "orbslam3": {"settings.yaml": keys(ORBSLAM3)},
    "basalt": {"calib.json": keys(BASALT, "value0.")},
    "kalibr": {
        "camchain.yaml": keys(KALIBR_CAMERA, "cam0.") | keys(KALIBR_CAMERA + "T_cn_cnm1", "cam1."),
        "imu.yaml": keys(KALIBR_IMU),
    },
}
UNREAD = {
    "openvins": keys("use_imuavg use_rk4int imu0.use_imuavg"),
    "kimera": keys(""),
    "vins": keys(""),
    "orbslam3": keys("Camera.bf ThDepth"),
    "basalt": keys(""),
    "kalibr": keys(""),
}
"""Keys that earlier versions read, and that present ones ignore."""
BY_OPENCV = ("openvins", "kimera", "vins", "orbslam3")
"""Programs whose reader, OpenCV's, refuses YAML files without the first line ``%YAML:1.0``."""


def written_keys(name: str, text: str) -> frozenset[str]:
    """Return the keys of a file by an independent parser, those of its outer maps joined by dots."""
    if name.endswith(".json"):
        return frozenset(f"value0.{key}" for key in json.loads(text)["value0"])
    text = text.removeprefix("%YAML:1.0").lstrip().removeprefix("---")
    yaml = YAML(typ="safe", pure=True)
    yaml.constructor.add_constructor("tag:yaml.org,2002:opencv-matrix", lambda loader, node: "matrix")
    found: set[str] = set()

    def collect(node: object, prefix: str) -> None:
        for key, value in node.items() if isinstance(node, dict) else ():
            found.add(prefix + key)
            collect(value, f"{prefix}{key}.")

    collect(yaml.load(text), "")
    return frozenset(found)


@pytest.mark.parametrize("program", CONFIGURATIONS)
def test_exports_have_the_keys_that_the_program_demands(program: str) -> None:
    files = CONFIGURATIONS[program](rig_named("euroc-stereo"), ImuSamples.empty().t_ns, ImuSamples.empty())
    assert set(DEMANDED[program]) == {name for name in files if not name.endswith(".txt")}
    for name, demanded in DEMANDED[program].items():
        written = written_keys(name, files[name])
        assert demanded <= written, f"{name}: {sorted(demanded - written)}"
        assert not UNREAD[program] & written, name


def test_openvins_has_no_key_that_it_does_not_read() -> None:
    files = CONFIGURATIONS["openvins"](rig_named("euroc-stereo"), ImuSamples.empty().t_ns, ImuSamples.empty())
    written = written_keys("estimator_config.yaml", files["estimator_config.yaml"])
    assert written == DEMANDED["openvins"]["estimator_config.yaml"]


@pytest.mark.parametrize("program", CONFIGURATIONS)
def test_only_files_for_opencv_begin_with_its_header(program: str) -> None:
    files = CONFIGURATIONS[program](rig_named("euroc-stereo"), ImuSamples.empty().t_ns, ImuSamples.empty())
    for name, text in files.items():
        if name.endswith(".yaml"):
            assert text.startswith("%YAML:1.0\n") == (program in BY_OPENCV), name


def test_sensor_files_are_yaml_and_read_with_and_without_header(tmp_path: Path) -> None:
    rig = rig_named("euroc-stereo")
    for header in ("", "%YAML:1.0\n", "%YAML:1.0\n---\n"):
        for name, text in calibration_files(rig).items():
            assert YAML(typ="safe", pure=True).load(text), name  # the files of the data set are plain YAML, too
            path = tmp_path / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(header + text)
            assert parse_yaml(path, header + text).values
        back = read_euroc_rig(tmp_path, (0, 1))
        assert back.imu == rig.imu and back.cameras[1].model == rig.cameras[1].model
    (tmp_path / "imu0" / "sensor.yaml").write_text("%YAML:1.0")
    with pytest.raises(InputError, match="no field rate_hz"):
        read_euroc_rig(tmp_path, (0, 1))
