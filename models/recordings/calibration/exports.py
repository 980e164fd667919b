"""Configuration files with which other estimators run on a recording.

Images and IMU samples are read from the recording itself: an EuRoC folder for ORB-SLAM3, Basalt and Kimera, a bag for
OpenVINS and VINS-Fusion. Each file has the fields and the settings of the EuRoC example of its program, except that
calibration is not estimated, because that of the rig is regarded as exact.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples, Times
from dronevio.models.lenses.lens import LENSES, LensName
from dronevio.models.recordings.calibration.basalt import basalt_json
from dronevio.models.recordings.calibration.euroc import calibration_files
from dronevio.models.recordings.calibration.kalibr import (
    CAMCHAIN_FILE,
    CAMERA_TOPIC,
    IMU_FILE,
    IMU_TOPIC,
    camchain_yaml,
    imu_yaml,
)
from dronevio.models.recordings.calibration.yaml_text import indented, rows_yaml, yaml_text
from dronevio.models.rig import Rig
from dronevio.models.rotation import inverse_pose

_OPENCV = "%YAML:1.0\n"


def kalibr_files(rig: Rig, frame_times_ns: Times, imu: ImuSamples) -> dict[str, str]:
    """Return the calibration files of Kalibr: ``camchain.yaml`` and ``imu.yaml``.

    Raises:
        ConfigError: Kalibr has no such lens.
    """
    _require_lens(rig, "Kalibr", *LENSES)
    return {CAMCHAIN_FILE: camchain_yaml(rig), IMU_FILE: imu_yaml(rig)}


def openvins_files(rig: Rig, frame_times_ns: Times, imu: ImuSamples) -> dict[str, str]:
    """Return the configuration of OpenVINS (Geneva et al., ICRA 2020), as in ``config/euroc_mav`` of its sources.

    OpenVINS initializes when a second at rest is followed by a second in which the accelerations deviate from their
    mean by more than a threshold. The value of the example, 1.5 m/s², is that of a fast take-off: in a gentle one it is
    exceeded a second too late or never, and the second taken for rest contains the beginning of the take-off. The
    threshold is therefore twice the deviation in the first second of the recording, between 0.2 and 1.5 m/s². Where
    there was no rest, OpenVINS initializes in motion (``init_dyn_use``).

    Raises:
        ConfigError: OpenVINS has no such lens.
    """
    _require_lens(rig, "OpenVINS", "radtan", "equidistant")
    eye3, eye4, zero3 = np.eye(3), np.eye(4), np.zeros((3, 3))
    imu_chain = rows_yaml("T_i_b", eye4) + imu_yaml(rig) + 'time_offset: 0.0\nmodel: "kalibr"\n'
    for key, matrix in {"Tw": eye3, "R_IMUtoGYRO": eye3, "Ta": eye3, "R_IMUtoACC": eye3, "Tg": zero3}.items():
        imu_chain += rows_yaml(key, matrix)
    settings = _OPENVINS_SETTINGS | {
        "use_stereo": len(rig.cameras) > 1,
        "max_cameras": len(rig.cameras),
        "gravity_mag": GRAVITY_M_S2,
        "track_frequency": rig.cameras[0].rate_hz + 1.0,
        "init_imu_thresh": _openvins_jerk_m_s2(imu),
    }
    return {
        "estimator_config.yaml": _OPENCV + "".join(f"{key}: {json.dumps(value)}\n" for key, value in settings.items()),
        "kalibr_imu_chain.yaml": f"{_OPENCV}\nimu0:\n{indented(imu_chain)}",
        "kalibr_imucam_chain.yaml": f"{_OPENCV}\n{camchain_yaml(rig)}",
    }


def vins_files(rig: Rig, frame_times_ns: Times, imu: ImuSamples) -> dict[str, str]:
    """Return the configuration of VINS-Fusion (Qin et al., 2019), as in ``config/euroc`` of its sources.

    Raises:
        ConfigError: The rig has more than two cameras, cameras with images of different sizes or with different time
            offsets, or VINS-Fusion has no such lens.
    """
    _require_at_most_two(rig, "VINS-Fusion")
    _require_one_size(rig, "VINS-Fusion")
    offset_s = _common_offset_s(rig, "VINS-Fusion")
    _require_lens(rig, "VINS-Fusion", "radtan", "equidistant", "omni", counts=(4, 5, 8))
    model, rate = rig.cameras[0].model, np.sqrt(rig.imu.rate_hz)
    text = f'{_OPENCV}imu: 1\nnum_of_cam: {len(rig.cameras)}\nimu_topic: "{IMU_TOPIC}"\n'
    for i, camera in enumerate(rig.cameras):
        text += f'image{i}_topic: "{CAMERA_TOPIC.format(i)}"\ncam{i}_calib: "cam{i}.yaml"\n'
        text += _opencv_matrix(f"body_T_cam{i}", camera.T_imu_cam, "d")
    text += (
        f"image_width: {model.width}\nimage_height: {model.height}\n"
        'output_path: "/tmp/"\nestimate_extrinsic: 0\nmultiple_thread: 1\n'
        "max_cnt: 150\nmin_dist: 30\nfreq: 10\nF_threshold: 1.0\nshow_track: 0\nflow_back: 1\n"
        "max_solver_time: 0.04\nmax_num_iterations: 8\nkeyframe_parallax: 10.0\n"
        "# noise of one sample: density times the square root of the rate; the example has 0.1, 0.01, 0.001, 0.0001\n"
        f"acc_n: {yaml_text(float(rig.imu.accel_noise_density * rate))}\n"
        f"gyr_n: {yaml_text(float(rig.imu.gyro_noise_density * rate))}\n"
        f"acc_w: {yaml_text(float(rig.imu.accel_random_walk * rate))}\n"
        f"gyr_w: {yaml_text(float(rig.imu.gyro_random_walk * rate))}\n"
        f"g_norm: {GRAVITY_M_S2}\n"
        f"estimate_td: 0\ntd: {yaml_text(float(offset_s))}  # t_imu = t_cam + td\n"
        'load_previous_pose_graph: 0\npose_graph_save_path: "/tmp/"\nsave_image: 0\n'
    )
    kind = "stereo" if len(rig.cameras) > 1 else "mono"
    cameras = {f"cam{i}.yaml": _camodocal_yaml(camera.model) for i, camera in enumerate(rig.cameras)}
    return {f"{kind}_imu_config.yaml": text, **cameras}


def orbslam3_files(rig: Rig, frame_times_ns: Times, imu: ImuSamples) -> dict[str, str]:
    """Return the settings of ORB-SLAM3 (Campos et al., T-RO 2021) and its list of time stamps.

    ORB-SLAM3 has no setting for a time offset between camera and IMU.

    Raises:
        ConfigError: The rig has more than two cameras, cameras with different lens models, time offsets or images of
            different sizes, or a lens that ORB-SLAM3 does not have.
    """
    _require_at_most_two(rig, "ORB-SLAM3")
    _require_lens(rig, "ORB-SLAM3", "radtan", "equidistant", counts=(4, 5))
    first = rig.cameras[0]
    if any(camera.model.lens != first.model.lens for camera in rig.cameras):
        raise ConfigError("cameras with different lens models; expected the same for ORB-SLAM3")
    _require_one_size(rig, "ORB-SLAM3")
    _common_offset_s(rig, "ORB-SLAM3")
    fisheye = first.model.lens == "equidistant"
    text = f'{_OPENCV}File.version: "1.0"\nCamera.type: "{"KannalaBrandt8" if fisheye else "PinHole"}"\n'
    for i, camera in enumerate(rig.cameras, 1):
        m = camera.model
        terms = zip(LENSES[m.lens].COEFFICIENTS, m.distortion, strict=False)
        numbers = {"fx": m.fx, "fy": m.fy, "cx": m.cx, "cy": m.cy, **dict(terms)}
        text += "".join(f"Camera{i}.{name}: {yaml_text(float(value))}\n" for name, value in numbers.items())
        if fisheye:
            text += f"Camera{i}.overlappingBegin: 0\nCamera{i}.overlappingEnd: {m.width - 1}\n"
    text += f"Camera.width: {first.model.width}\nCamera.height: {first.model.height}\n"
    text += f"Camera.fps: {round(first.rate_hz)}\nCamera.RGB: 1\n"
    if len(rig.cameras) > 1:
        T_cam0_cam1 = inverse_pose(first.T_imu_cam) @ rig.cameras[1].T_imu_cam
        text += _opencv_matrix("Stereo.T_c1_c2", T_cam0_cam1, "f") + "Stereo.ThDepth: 40.0\n"
    text += (
        f"{_opencv_matrix('IMU.T_b_c1', first.T_imu_cam, 'f')}"
        f"IMU.NoiseGyro: {yaml_text(float(rig.imu.gyro_noise_density))}\n"
        f"IMU.NoiseAcc: {yaml_text(float(rig.imu.accel_noise_density))}\n"
        f"IMU.GyroWalk: {yaml_text(float(rig.imu.gyro_random_walk))}\n"
        f"IMU.AccWalk: {yaml_text(float(rig.imu.accel_random_walk))}\n"
        f"IMU.Frequency: {yaml_text(float(rig.imu.rate_hz))}\n"
        "ORBextractor.nFeatures: 1200\nORBextractor.scaleFactor: 1.2\nORBextractor.nLevels: 8\n"
        "ORBextractor.iniThFAST: 20\nORBextractor.minThFAST: 7\n"
        "Viewer.KeyFrameSize: 0.05\nViewer.KeyFrameLineWidth: 1.0\nViewer.GraphLineWidth: 0.9\n"
        "Viewer.PointSize: 2.0\nViewer.CameraSize: 0.08\nViewer.CameraLineWidth: 3.0\n"
        "Viewer.ViewpointX: 0.0\nViewer.ViewpointY: -0.7\nViewer.ViewpointZ: -3.5\nViewer.ViewpointF: 500.0\n"
    )
    return {"settings.yaml": text, "times.txt": "".join(f"{t_ns}\n" for t_ns in frame_times_ns.tolist())}


def basalt_files(rig: Rig, frame_times_ns: Times, imu: ImuSamples) -> dict[str, str]:
    """Return the calibration of Basalt (Usenko et al., RA-L 2020), as in ``data/*_calib.json`` of its sources.

    Raises:
        ConfigError: The time offsets of the cameras differ, or Basalt has no such lens.
    """
    offset_s = _common_offset_s(rig, "Basalt")
    return {"calib.json": basalt_json(replace(rig, time_offset_s=offset_s))}


def kimera_files(rig: Rig, frame_times_ns: Times, imu: ImuSamples) -> dict[str, str]:
    """Return the calibration of Kimera-VIO (Rosinol et al., ICRA 2020), which replaces files of its ``params/Euroc``.

    Raises:
        ConfigError: The rig has more than two cameras, or cameras with different time offsets, or Kimera has no such
            lens.
    """
    _require_at_most_two(rig, "Kimera-VIO")
    offset_s = _common_offset_s(rig, "Kimera-VIO")
    _require_lens(rig, "Kimera-VIO", "radtan", "equidistant")
    texts = calibration_files(rig)
    files = {"ImuParams.yaml": _kimera_imu(texts["imu0/sensor.yaml"], offset_s)}
    for i, side in zip(range(len(rig.cameras)), ("left", "right"), strict=False):
        files[f"{side.title()}CameraParams.yaml"] = f"{_OPENCV}camera_id: {side}_cam\n{texts[f'cam{i}/sensor.yaml']}"
    return files


CONFIGURATIONS: Mapping[str, Callable[[Rig, Times, ImuSamples], dict[str, str]]] = MappingProxyType(
    {
        "kalibr": kalibr_files,
        "openvins": openvins_files,
        "vins": vins_files,
        "orbslam3": orbslam3_files,
        "basalt": basalt_files,
        "kimera": kimera_files,
    }
)
"""Functions that write the configuration of each program: they receive a rig, the time stamps of the frames [ns]
and the IMU samples of a recording, and return the texts of the files by name."""

_OPENVINS_JERK_M_S2 = (0.2, 1.5)  # the noise at rest is 0.05 in simulation, 0.3 to 0.4 on EuRoC's vehicle
_OPENVINS_SETTINGS: dict[str, object] = {
    "verbosity": "INFO",
    "use_fej": True,
    "integration": "rk4",
    "calib_cam_extrinsics": False,
    "calib_cam_intrinsics": False,
    "calib_cam_timeoffset": False,
    "calib_imu_intrinsics": False,
    "calib_imu_g_sensitivity": False,
    "max_clones": 11,
    "max_slam": 50,
    "max_slam_in_update": 25,
    "max_msckf_in_update": 40,
    "dt_slam_delay": 1,
    "feat_rep_msckf": "GLOBAL_3D",
    "feat_rep_slam": "ANCHORED_MSCKF_INVERSE_DEPTH",
    "feat_rep_aruco": "ANCHORED_MSCKF_INVERSE_DEPTH",
    "try_zupt": False,
    "zupt_chi2_multipler": 0,
    "zupt_max_velocity": 0.1,
    "zupt_noise_multiplier": 10,
    "zupt_max_disparity": 0.5,
    "zupt_only_at_beginning": False,
    "init_window_time": 2.0,
    "init_max_disparity": 10.0,
    "init_max_features": 50,
    "init_dyn_use": True,
    "init_dyn_mle_opt_calib": False,
    "init_dyn_mle_max_iter": 50,
    "init_dyn_mle_max_time": 0.05,
    "init_dyn_mle_max_threads": 6,
    "init_dyn_num_pose": 6,
    "init_dyn_min_deg": 10.0,
    "init_dyn_inflation_ori": 10,
    "init_dyn_inflation_vel": 100,
    "init_dyn_inflation_bg": 10,
    "init_dyn_inflation_ba": 100,
    "init_dyn_min_rec_cond": 1.0e-12,
    "init_dyn_bias_g": [0.0, 0.0, 0.0],
    "init_dyn_bias_a": [0.0, 0.0, 0.0],
    "record_timing_information": False,
    "record_timing_filepath": "/tmp/openvins_timing.txt",
    "save_total_state": False,
    "filepath_est": "/tmp/openvins_estimate.txt",
    "filepath_std": "/tmp/openvins_estimate_std.txt",
    "filepath_gt": "/tmp/openvins_groundtruth.txt",
    "use_klt": True,
    "num_pts": 200,
    "fast_threshold": 20,
    "grid_x": 5,
    "grid_y": 5,
    "min_px_dist": 10,
    "knn_ratio": 0.70,
    "downsample_cameras": False,
    "num_opencv_threads": 4,
    "histogram_method": "HISTOGRAM",
    "use_aruco": False,
    "num_aruco": 1024,
    "downsize_aruco": True,
    "up_msckf_sigma_px": 1,
    "up_msckf_chi2_multipler": 1,
    "up_slam_sigma_px": 1,
    "up_slam_chi2_multipler": 1,
    "up_aruco_sigma_px": 1,
    "up_aruco_chi2_multipler": 1,
    "use_mask": False,
    "relative_config_imu": "kalibr_imu_chain.yaml",
    "relative_config_imucam": "kalibr_imucam_chain.yaml",
}


def _openvins_jerk_m_s2(imu: ImuSamples) -> float:
    """Return the deviation of accelerations from their mean over a second, at which OpenVINS detects the take-off."""
    smallest, largest = _OPENVINS_JERK_M_S2
    first = imu.accel_m_s2[imu.t_ns < imu.t_ns[:1] + 10**9]
    if len(first) < 2:
        return smallest
    rest = float(np.sqrt(np.sum(np.var(first, axis=0, ddof=1))))
    return round(min(max(2.0 * rest, smallest), largest), 3)


def _require_at_most_two(rig: Rig, program: str) -> None:
    """Raise ConfigError unless a rig has one camera or two."""
    if len(rig.cameras) > 2:
        raise ConfigError(f"{len(rig.cameras)} cameras; expected one or two for {program}")


def _require_one_size(rig: Rig, program: str) -> None:
    """Raise ConfigError unless the images of all cameras have one size."""
    sizes = list(dict.fromkeys((camera.model.width, camera.model.height) for camera in rig.cameras))
    if len(sizes) > 1:
        listed = " and ".join(f"{width} × {height}" for width, height in sizes)
        raise ConfigError(f"cameras with images of {listed} px; expected one size for {program}")


def _common_offset_s(rig: Rig, program: str) -> float:
    """Return the time offset of all cameras [s], or raise ConfigError if they differ."""
    offsets = list(dict.fromkeys(rig.time_offset_s + camera.time_offset_s for camera in rig.cameras))
    if len(offsets) > 1:
        listed = " and ".join(f"{offset_s:g}" for offset_s in offsets)
        raise ConfigError(f"cameras with time offsets of {listed} s; expected one for {program}")
    return offsets[0] if offsets else rig.time_offset_s


def _require_lens(rig: Rig, program: str, *lenses: LensName, counts: tuple[int, ...] = (4,)) -> None:
    """Raise ConfigError unless a program has the lenses of a rig, ``radtan`` with one of the counts of coefficients."""
    for camera in rig.cameras:
        lens, count = camera.model.lens, len(camera.model.distortion)
        if lens not in lenses:
            raise ConfigError(f"camera lens {lens}; expected one of {', '.join(lenses)} for {program}")
        if lens == "radtan" and count not in counts:
            expected = " or ".join(map(str, counts))
            raise ConfigError(f"camera lens radtan with {count} coefficients; expected {expected} for {program}")


def _opencv_matrix(key: str, matrix: Array, kind: str) -> str:
    """Return the lines of a matrix in OpenCV's format, of doubles (``d``) or floats (``f``)."""
    rows, cols = matrix.shape
    data = ",\n         ".join(", ".join(map(yaml_text, row)) for row in matrix.tolist())
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: {kind}\n   data: [{data}]\n"


def _camodocal_yaml(m: CameraModel) -> str:
    """Return the text of a camera in the format of camodocal, which VINS-Fusion uses."""
    names = tuple(LENSES[m.lens].COEFFICIENTS)[: len(m.distortion)]
    distortion: dict[str, float] = {}
    projection: dict[str, float] = {}
    mirror: dict[str, float] = {}
    if m.lens == "equidistant":  # its k2 to k5 are k1 to k4 elsewhere
        kind = "KANNALA_BRANDT"
        projection = dict(zip(("k2", "k3", "k4", "k5"), m.distortion, strict=True))
        projection |= {"mu": m.fx, "mv": m.fy, "u0": m.cx, "v0": m.cy}
    elif m.lens == "omni":
        kind, mirror, distortion = "MEI", {"xi": m.distortion[0]}, dict(zip(names[1:], m.distortion[1:], strict=True))
        projection = {"gamma1": m.fx, "gamma2": m.fy, "u0": m.cx, "v0": m.cy}
    else:
        kind, distortion = "PINHOLE", dict(zip(names, m.distortion, strict=True))
        if len(names) > 4:
            kind, distortion = "PINHOLE_FULL", dict.fromkeys(LENSES[m.lens].COEFFICIENTS, 0.0) | distortion
        projection = {"fx": m.fx, "fy": m.fy, "cx": m.cx, "cy": m.cy}
    text = f"{_OPENCV}---\nmodel_type: {kind}\ncamera_name: camera\nimage_width: {m.width}\nimage_height: {m.height}\n"
    for name, numbers in (
        ("mirror_parameters", mirror),
        ("distortion_parameters", distortion),
        ("projection_parameters", projection),
    ):
        lines = "".join(f"   {key}: {yaml_text(float(value))}\n" for key, value in numbers.items())
        text += f"{name}:\n{lines}" if lines else ""
    return text


def _kimera_imu(sensor_yaml: str, time_offset_s: float) -> str:
    """Return the text of the IMU parameters, which extends the ``sensor.yaml`` of an EuRoC folder."""
    return (
        f"{_OPENCV}{sensor_yaml}imu_preintegration_type: 1\nimu_integration_sigma: 1.0e-8\n"
        "imu_bias_init_sigma: 1.0e-3\n"
        "do_imu_rate_time_alignment: 1\ntime_alignment_window_size_s: 10.0\n"
        "time_alignment_variance_threshold_scaling: 30.0\n"
        f"imu_time_shift: {yaml_text(float(time_offset_s))}  # t_imu = t_cam + shift\n"
        f"n_gravity: [0.0, 0.0, {-GRAVITY_M_S2}]\n"
    )
