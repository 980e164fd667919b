"""Videos with telemetry: a small MP4 that the test makes, and a real one where it is found."""

import os
import struct
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from dronevio.models.defects import DefectKind
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets import open_images
from dronevio.models.imu_presets import BMI088
from dronevio.models.recordings.calibration.kalibr import imu_yaml
from dronevio.models.recordings.gopro import imu_rotation_named, read_telemetry
from dronevio.models.recordings.gpmf import axes_matrix, read_payload
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig_presets import rig_named

FRAMES, RATE_HZ = 30, 15
GYRO_HZ, ACCEL_HZ = 400, 200
CAMERA = """cam0:
  camera_model: pinhole
  intrinsics: [60.0, 61.0, 31.5, 23.5]
  distortion_model: radtan
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  resolution: [64, 48]
"""


# --- GPMF


def klv(key: str, kind: str, size: int, content: bytes, nested: bool = False) -> bytes:
    padding = b"\0" * (-len(content) % 4)
    return (
        struct.pack(">4sBBH", key.encode(), 0 if nested else ord(kind), size, len(content) // size) + content + padding
    )


def stream(key: str, values: Any, scale: int, *properties: bytes) -> bytes:
    numbers = np.asarray(np.round(np.asarray(values) * scale), dtype=">i2")
    parts = [klv("STNM", "c", 1, key.encode()), *properties, klv("SCAL", "s", 2, struct.pack(">h", scale))]
    return klv("STRM", "", 4, b"".join(parts) + klv(key, "s", 6, numbers.tobytes()), nested=True)


def payload(gyro: Any, accel: Any, stamp_us: int | None = None, *properties: bytes) -> bytes:
    stamps = () if stamp_us is None else (klv("STMP", "J", 8, struct.pack(">Q", stamp_us)),)
    streams = stream("ACCL", accel, 418, *stamps, *properties) + stream("GYRO", gyro, 3755, *stamps, *properties)
    other = klv("STRM", "", 4, klv("GPSU", "U", 16, b"170417192757.000"), nested=True)
    return klv("DEVC", "", 4, klv("DVNM", "c", 1, b"Hero5 Black") + other + streams, nested=True)


def test_samples_of_a_payload_are_scaled() -> None:
    gyro, accel = np.array([[0.1, -0.2, 0.3], [1.0, 2.0, -3.0]]), np.array([[9.8, 0.0, -1.0]])
    found = read_payload(payload(gyro, accel, 123))
    np.testing.assert_allclose(found["GYRO"].values, gyro, atol=0.5 / 3755)
    np.testing.assert_allclose(found["ACCL"].values, accel, atol=0.5 / 418)
    assert found["ACCL"].stamp_us == 123
    assert read_payload(payload(gyro, accel))["GYRO"].stamp_us is None


def test_the_axes_that_a_payload_states_are_turned() -> None:
    """Channels along y, −x and z, for the order z, x, y: of (1, 2, 3), z is 3, x is −2 and y is 1."""
    axes = klv("ORIN", "c", 1, b"YxZ"), klv("ORIO", "c", 1, b"ZXY")
    found = read_payload(payload([[1.0, 2.0, 3.0]], [[4.0, 5.0, 6.0]], None, *axes))
    np.testing.assert_allclose(found["GYRO"].values, [[3.0, -2.0, 1.0]], atol=1e-3)
    np.testing.assert_allclose(found["ACCL"].values, [[6.0, -5.0, 4.0]], atol=1e-2)
    matrix = klv("MTRX", "f", 36, struct.pack(">9f", 0, 0, 1, 0, -1, 0, 1, 0, 0))
    again = read_payload(payload([[1.0, 2.0, 3.0]], [[4.0, 5.0, 6.0]], None, matrix))
    np.testing.assert_allclose(again["GYRO"].values, [[3.0, -2.0, 1.0]], atol=1e-3)
    np.testing.assert_array_equal(axes_matrix("YxZ", "ZXY"), [[0, 0, 1], [0, -1, 0], [1, 0, 0]])
    with pytest.raises(ValueError, match="axes 'XXY'"):
        axes_matrix("XYZ", "XXY")


def test_damaged_payloads_are_refused_or_read() -> None:
    whole = payload(np.ones((20, 3)), np.ones((10, 3)), 5)
    for end in range(8, len(whole), 7):
        with pytest.raises(ValueError, match="an entry"):
            read_payload(whole[:end])
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(whole)
        at = int(rng.integers(0, len(whole)))
        damaged[at : at + 2] = rng.bytes(2)
        try:
            for found in read_payload(bytes(damaged)).values():
                assert found.values.ndim == 2
        except ValueError:
            pass
    deep = b""
    for _ in range(20):
        deep = klv("DEVC", "", 4, deep, nested=True)
    with pytest.raises(ValueError, match="nested too deep"):
        read_payload(klv("DEVC", "", 4, deep, nested=True))


# --- MP4


def box(name: str, content: bytes) -> bytes:
    return struct.pack(">I4s", len(content) + 8, name.encode()) + content


def with_telemetry(path: Path, payloads: list[bytes], duration_ms: int = 1000) -> Path:
    """Add a track of telemetry to an MP4 file whose index is at its end (ISO/IEC 14496-12)."""
    data, at = path.read_bytes(), 0
    while data[at + 4 : at + 8] != b"moov":
        at += int.from_bytes(data[at : at + 4], "big")
    moov = data[at + 8 : at + int.from_bytes(data[at : at + 4], "big")]
    sizes, total = struct.pack(f">{len(payloads)}I", *map(len, payloads)), duration_ms * len(payloads)
    start = at + 8
    offsets = [start + sum(map(len, payloads[:k])) for k in range(len(payloads))]
    entry = box("gpmd", struct.pack(">6xHI", 1, 0))
    stbl = box("stsd", struct.pack(">II", 0, 1) + entry)
    stbl += box("stts", struct.pack(">IIII", 0, 1, len(payloads), duration_ms))
    stbl += box("stsc", struct.pack(">IIIII", 0, 1, 1, 1, 1)) + box(
        "stsz", struct.pack(">III", 0, 0, len(payloads)) + sizes
    )
    stbl += box("stco", struct.pack(f">II{len(payloads)}I", 0, len(payloads), *offsets))
    dinf = box("dinf", box("dref", struct.pack(">II", 0, 1) + box("url ", struct.pack(">I", 1))))
    minf = box("minf", box("gmhd", box("gmin", bytes(16))) + dinf + box("stbl", stbl))
    mdhd = box("mdhd", struct.pack(">IIIIIHH", 0, 0, 0, 1000, total, 0, 0))
    hdlr = box("hdlr", struct.pack(">II4s12x", 0, 0, b"meta") + b"GoPro MET\0")
    tkhd = box("tkhd", struct.pack(">IIIII", 7, 0, 0, 9, 0) + struct.pack(">I", total) + bytes(60))
    track = box("trak", tkhd + box("mdia", mdhd + hdlr + minf))
    path.write_bytes(data[:at] + box("mdat", b"".join(payloads)) + box("moov", moov + track))
    return path


def motion(t_s: Any) -> tuple[Any, Any]:
    """Return angular velocity and specific force (N, 3) at some times, both linear in time."""
    return np.multiply.outer(t_s, [0.1, -0.05, 0.2]), np.multiply.outer(t_s, [0.5, 1.0, -2.0]) + [9.8, 0.1, 0.2]


def film(path: Path, stamped: bool = False, seconds: int = 2, size: tuple[int, int] = (64, 48)) -> Path:
    """Write a video with a frame each 1/15 s, whose brightness is its number, and payloads of a second each."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("mpeg4", rate=RATE_HZ)
        video.width, video.height, video.pix_fmt = *size, "yuv420p"
        for k in range(seconds * RATE_HZ):
            pixels = np.full((size[1], size[0]), 16 + 5 * k, np.uint8)
            container.mux(video.encode(av.VideoFrame.from_ndarray(pixels, format="gray")))
        container.mux(video.encode())
    gyro_s, accel_s = np.arange(seconds * GYRO_HZ) / GYRO_HZ, np.arange(seconds * ACCEL_HZ) / ACCEL_HZ
    gyro, accel = motion(gyro_s)[0], motion(accel_s)[1]
    payloads = []
    for k in range(seconds):
        stamp = round(7e6 + 1e6 * k) if stamped else None
        payloads.append(payload(gyro[GYRO_HZ * k : GYRO_HZ * (k + 1)], accel[ACCEL_HZ * k : ACCEL_HZ * (k + 1)], stamp))
    return with_telemetry(path, payloads)


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    (tmp_path / "cam.yaml").write_text(CAMERA)
    return tmp_path / "cam.yaml"


@pytest.mark.parametrize("stamped", [False, True])
def test_videos_with_telemetry_are_recordings(tmp_path: Path, camera: Path, stamped: bool) -> None:
    path = film(tmp_path / "flight.mp4", stamped)
    recording = open_recording(path, calibration=[camera], imu=BMI088, repair=True)
    assert recording.name == "flight" and len(recording.rig.cameras) == 1
    np.testing.assert_allclose(recording.frame_times_ns, np.arange(FRAMES) / RATE_HZ * 1e9, atol=1e5)
    seconds = recording.imu.t_ns * 1e-9
    assert recording.rig.imu.rate_hz == pytest.approx(GYRO_HZ, rel=1e-6)
    rates, forces = motion(seconds)
    np.testing.assert_allclose(recording.imu.gyro_rad_s, rates, atol=1e-3)
    np.testing.assert_allclose(recording.imu.accel_m_s2, forces, atol=5e-3)  # interpolated to the gyroscope's times
    for index in (3, 20, 0, 29):
        image = recording.frame(index).images[0]
        assert image.shape == (48, 64) and image.dtype == np.uint8
        assert abs(float(image.mean()) - (16 + 5 * index)) < 3.0
    # x, y and z of the camera are −y, −x and −z of the IMU: left, up and back
    np.testing.assert_array_equal(recording.rig.cameras[0].T_imu_cam[:3, :3], [[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    assert open_images(path).inertial is None  # structure from motion of a video needs no calibration


def test_the_rotation_of_the_imu_is_named_or_calibrated(tmp_path: Path, camera: Path) -> None:
    path = film(tmp_path / "flight.mp4")
    named = open_recording(path, calibration=[camera], imu=BMI088, imu_rotation="XYZ")
    np.testing.assert_array_equal(named.rig.cameras[0].T_imu_cam, np.eye(4))
    pose = "  T_cam_imu:\n  - [0, 0, 1, 0.1]\n  - [1, 0, 0, 0.2]\n  - [0, 1, 0, 0.3]\n  - [0, 0, 0, 1]\n"
    camera.write_text(CAMERA + pose + "  timeshift_cam_imu: -0.02\n")
    (tmp_path / "imu.yaml").write_text(imu_yaml(rig_named("euroc")))
    calibrated = open_recording(path, calibration=[camera, tmp_path / "imu.yaml"])
    np.testing.assert_array_equal(calibrated.rig.cameras[0].T_imu_cam[:3, 3], [-0.2, -0.3, -0.1])
    assert calibrated.rig.time_offset_s == -0.02
    replaced = open_recording(path, calibration=[camera], imu=BMI088, imu_rotation="ZXY")
    np.testing.assert_array_equal(replaced.rig.cameras[0].T_imu_cam[:3, :3], imu_rotation_named("ZXY"))


def test_names_of_rotations() -> None:
    """Column k is the axis of the camera in the IMU frame."""
    np.testing.assert_array_equal(imu_rotation_named("yxz"), [[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    np.testing.assert_array_equal(imu_rotation_named("ZXY")[:, 0], [0, 0, 1])
    for name in ("xyz", "XYY", "XY", "north", ""):
        with pytest.raises(ConfigError, match="rotation of the IMU"):
            imu_rotation_named(name)


def test_what_a_video_lacks_is_named(tmp_path: Path, camera: Path) -> None:
    path = film(tmp_path / "flight.mp4")
    with pytest.raises(InputError, match=r"no calibration of the camera; expected one of Kalibr or Basalt \(--calib"):
        open_recording(path)
    with pytest.raises(InputError, match="no noise densities of the IMU"):
        open_recording(path, calibration=[camera])
    with pytest.raises(InputError, match=r"frames of 32 × 48 px; expected 64 × 48 px as calibrated"):
        open_recording(film(tmp_path / "small.mp4", size=(32, 48)), calibration=[camera], imu=BMI088)
    with pytest.raises(ConfigError, match="a rotation of the IMU is for videos"):
        open_recording(tmp_path, imu_rotation="XYZ")
    plain = tmp_path / "plain.mp4"
    plain.write_bytes(path.read_bytes().replace(b"gpmd", b"free", 1).replace(b"DEVC", b"XXXX"))
    with pytest.raises(InputError, match="no track with gyroscope and accelerometer; expected a video of a GoPro"):
        read_telemetry(plain)
    damaged = tmp_path / "damaged.mp4"
    damaged.write_bytes(path.read_bytes().replace(b"ACCLs\x06", b"ACCLs\x05"))
    with pytest.raises(InputError, match="damaged telemetry"):
        read_telemetry(damaged)
    (tmp_path / "words.mp4").write_text("no video")
    with pytest.raises(InputError, match="cannot be read"):
        read_telemetry(tmp_path / "words.mp4")


def test_the_jitter_of_payloads_is_smoothed(tmp_path: Path, camera: Path) -> None:
    """Payloads hold some samples more or less than a second has; the times of samples stay regular."""
    path = tmp_path / "flight.mp4"
    film(path)
    seconds, rng = 8, np.random.default_rng(1)
    cuts = np.concatenate([[0], np.arange(1, seconds) * GYRO_HZ + 2 * rng.integers(-4, 5, seconds - 1)])
    ends = np.append(cuts[1:], seconds * GYRO_HZ)
    gyro, accel = motion(np.arange(seconds * GYRO_HZ) / GYRO_HZ)[0], motion(np.arange(seconds * ACCEL_HZ) / ACCEL_HZ)[1]
    path = tmp_path / "long.mp4"
    with av.open(str(path), "w") as container:
        video = container.add_stream("mpeg4", rate=RATE_HZ)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        container.mux(video.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64), np.uint8), format="gray")))
        container.mux(video.encode())
    with_telemetry(path, [payload(gyro[a:b], accel[a // 2 : b // 2]) for a, b in zip(cuts, ends, strict=True)])
    imu = read_telemetry(path)
    intervals_ms = np.diff(imu.t_ns) * 1e-6
    assert np.ptp(intervals_ms) < 1e-3 and intervals_ms[0] == pytest.approx(2.5, rel=5e-3)
    np.testing.assert_allclose(imu.gyro_rad_s, motion(imu.t_ns * 1e-9)[0], atol=3e-3)


def test_damaged_frames_are_defects(tmp_path: Path, camera: Path) -> None:
    path = film(tmp_path / "flight.mp4")
    recording = open_recording(path, calibration=[camera], imu=BMI088, repair=True)
    path.write_bytes(b"")  # as if a disk failed
    (defect,) = recording.frame(3).defects
    assert defect.kind is DefectKind.DAMAGED_IMAGE
    strict = open_recording(film(tmp_path / "other.mp4"), calibration=[camera], imu=BMI088)
    (tmp_path / "other.mp4").write_bytes(b"")
    with pytest.raises(InputError, match="cannot be decoded"):
        strict.frame(3)


@pytest.mark.skipif("DRONEVIO_DATA" not in os.environ, reason="DRONEVIO_DATA, the folder of real data, is not set")
def test_a_real_video_has_its_gravity_upwards() -> None:
    imu = read_telemetry(Path(os.environ["DRONEVIO_DATA"]) / "gopro" / "karma.mp4")
    assert len(imu) == pytest.approx(4795, abs=5)
    np.testing.assert_allclose(imu.accel_m_s2.mean(axis=0), [9.7, 0.0, 0.0], atol=0.4)
    assert 1e9 / float(np.median(np.diff(imu.t_ns))) == pytest.approx(397.2, abs=0.5)
