"""The odometry on pictures: drawn ones of a wall, by way of a folder and the command line, and real ones at rest."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dronevio.cli import main
from dronevio.driver import estimate_recording
from dronevio.estimator.book.eqvio import read_feature_recording
from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.eval.run import EstimatorRun
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.euroc import EurocRecording, read_euroc_frame_times, write_euroc
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import pose_matrix
from dronevio.models.state import CameraFrame, Health, Trajectory

CAMERA = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
T_WALL_WORLD = pose_matrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))  # z ahead
HOVER = {
    "positions_m": np.array([[0.25, 0.08], [0.45, 0.1], [0.25, 0.06]]),
    "position_rates": np.array([[1.1, 2.9], [1.3, 2.7], [1.2, 3.1]]),
    "angles_rad": np.array([[0.15, 0.05], [0.05, 0.03], [0.06, 0.03]]),
}


@dataclass(frozen=True)
class Drawn:
    """A folder with a drawn flight, and the truth about it."""

    folder: Path
    truth: Trajectory


@pytest.fixture(scope="module")
def drawn(make_flight: Callable, see_wall: Callable, tmp_path_factory: pytest.TempPathFactory) -> Drawn:
    flight = make_flight(5, rest_s=1.2, duration_s=5.0, motion=HOVER)
    rig = replace(flight.rig, cameras=(replace(flight.rig.cameras[0], model=CAMERA),))
    folder = tmp_path_factory.mktemp("drawn") / "wall-5"
    truth, times = flight.truth_at(flight.imu.t_ns), flight.frame_times_ns
    write_euroc(folder, rig, flight.imu, truth, times)
    noise = np.random.default_rng(0)
    for t_ns, T_world_cam in zip(times.tolist(), flight.Ts_world_cam(times), strict=True):
        picture = see_wall(CAMERA, T_WALL_WORLD @ T_world_cam) + noise.normal(0.0, 2.0, (CAMERA.height, CAMERA.width))
        cv2.imwrite(str(folder / "mav0/cam0/data" / f"{t_ns}.png"), np.clip(picture, 0, 255).astype(np.uint8))
    return Drawn(folder, truth)


@pytest.fixture(scope="module")
def estimated(drawn: Drawn, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return what the command printed for machines, and the trajectory that it wrote."""
    out = tmp_path_factory.mktemp("estimated") / "estimate.tum"
    lines: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout.write", lines.append)
        assert main(["estimate", str(drawn.folder), "--out", str(out), "--json"]) == 0
    return "".join(lines), out


def test_command_tells_machines_what_it_wrote(drawn: Drawn, estimated: tuple[str, Path]) -> None:
    summary, trajectory = json.loads(estimated[0]), read_tum(estimated[1])
    assert summary["recording"] == str(drawn.folder) and summary["estimate"] == str(estimated[1])
    assert summary["frames"] == 101 and summary["poses"] == len(trajectory)
    assert 0.7 < summary["first_pose_s"] < 1.2
    assert summary["path_m"] == pytest.approx(trajectory.length_m, abs=1e-6)
    assert summary["cpu_ms_per_frame"] > 0.0
    assert summary["real_time_factor"] == pytest.approx(5.0 / (101 * summary["cpu_ms_per_frame"] * 1e-3), rel=0.01)


def test_estimate_is_the_flight(drawn: Drawn, estimated: tuple[str, Path]) -> None:
    found = read_tum(estimated[1])
    times = read_euroc_frame_times(drawn.folder)
    np.testing.assert_array_equal(found.t_ns, times[-len(found) :])  # one a frame since the start
    truth = drawn.truth[np.searchsorted(drawn.truth.t_ns, found.t_ns)]
    fit = align(truth.p_world_imu, found.p_world_imu, "yaw")
    away = np.linalg.norm(fit.positions(found.p_world_imu) - truth.p_world_imu, axis=1)
    assert truth.length_m > 1.5
    assert np.sqrt(np.mean(away**2)) < 0.02
    tilt = np.linalg.norm(np.cross(found.rotations[:, 2], truth.rotations[:, 2]), axis=1)
    assert tilt.max() < np.radians(2.0)  # z is up


def test_same_recording_same_bytes(drawn: Drawn, estimated: tuple[str, Path], tmp_path: Path) -> None:
    again = tmp_path / "again.tum"
    assert main(["estimate", str(drawn.folder / "mav0"), "--out", str(again), "--json"]) == 0
    assert again.read_bytes() == estimated[1].read_bytes()


def test_truth_does_not_leak(drawn: Drawn, estimated: tuple[str, Path], tmp_path: Path) -> None:
    """Without the truth in the folder, the estimate is the same to the byte."""
    blind = tmp_path / "blind"
    (blind / "mav0").mkdir(parents=True)
    for name in ("cam0", "imu0", "body.yaml"):
        if (drawn.folder / "mav0" / name).exists():
            (blind / "mav0" / name).symlink_to(drawn.folder / "mav0" / name)
    assert EurocRecording.open(blind).ground_truth is None
    out = tmp_path / "blind.tum"
    assert main(["estimate", str(blind), "--out", str(out), "--json"]) == 0
    assert out.read_bytes() == estimated[1].read_bytes()


def test_command_tells_people(drawn: Drawn, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "estimate.tum"
    assert main(["estimate", str(drawn.folder), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    for text in ("Estimate of wall-5", "frames", "101", "first pose after", "ms", f"wrote {out}", "dronevio evaluate"):
        assert text in printed


def refused(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """Run a command that must fail for its input; return its one line."""
    assert main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("dronevio: ") and err.count("\n") == 1
    return err


def test_recording_that_never_starts_is_bad_input(
    drawn: Drawn, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """All frames are dark."""
    dark = tmp_path / "dark"
    recording = EurocRecording.open(drawn.folder)
    write_euroc(dark, recording.rig, recording.imu, drawn.truth, recording.frame_times_ns)
    for t_ns in recording.frame_times_ns.tolist():
        black = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
        cv2.imwrite(str(dark / "mav0/cam0/data" / f"{t_ns}.png"), black)
    out = tmp_path / "estimate.tum"
    message = refused(["estimate", str(dark), "--out", str(out), "--json"], capfd)
    assert "dark: no pose after 101 frames (not observable yet: " in message
    assert not out.exists()


def test_image_that_breaks_in_mid_flight_leaves_nothing_behind(
    drawn: Drawn, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken"
    (broken / "mav0" / "cam0" / "data").mkdir(parents=True)
    for name in ("imu0", "body.yaml", "cam0/data.csv", "cam0/sensor.yaml"):
        if (drawn.folder / "mav0" / name).exists():
            (broken / "mav0" / name).symlink_to(drawn.folder / "mav0" / name)
    images = sorted((drawn.folder / "mav0" / "cam0" / "data").iterdir())
    for image in images:
        (broken / "mav0" / "cam0" / "data" / image.name).symlink_to(image)
    victim = broken / "mav0" / "cam0" / "data" / images[60].name
    victim.unlink()
    victim.write_bytes(images[60].read_bytes()[:1000])
    out = tmp_path / "estimate.tum"
    message = refused(["estimate", str(broken), "--out", str(out), "--json"], capfd)
    assert str(victim) in message and "truncated" in message
    assert not out.exists()


def test_nowhere_to_write_is_bad_input(drawn: Drawn, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("in the way")
    message = refused(["estimate", str(drawn.folder), "--out", str(tmp_path / "file" / "e.tum"), "--json"], capfd)
    assert str(tmp_path / "file") in message
    assert "a folder" in refused(["estimate", str(drawn.folder), "--out", str(tmp_path), "--json"], capfd)


@pytest.mark.parametrize("images", [0, 1], ids=["no image", "one image"])
def test_rig_of_two_cameras_wants_two_images(drawn: Drawn, images: int) -> None:
    recording = EurocRecording.open(drawn.folder)
    second = RigCamera(CAMERA, np.eye(4))
    odometry = VisualInertialOdometry(replace(recording.rig, cameras=(*recording.rig.cameras, second)))
    frame = recording.frame(0)
    with pytest.raises(ConfigError, match=f"image {images} is NoneType; expected uint8"):
        odometry.add_frame(replace(frame, images=frame.images[:images]))


@dataclass(frozen=True, eq=False)
class RealFrames:
    """Real frames of EuRoC's V1_01, with the IMU of the same seconds, which the gtsam package has."""

    folder: Path
    rig: Rig
    imu: ImuSamples
    frame_times_ns: np.ndarray
    name: str = "V1_01 on the ground"
    ground_truth: Trajectory | None = None

    def frame(self, index: int) -> CameraFrame:
        t_ns = int(self.frame_times_ns[index])
        image = cv2.imread(str(self.folder / "cam0" / "data" / f"{t_ns}.png"), cv2.IMREAD_GRAYSCALE)
        return CameraFrame(t_ns, (image,))


@pytest.fixture(scope="module")
def on_the_ground(data_folder: Path) -> tuple[EstimatorRun, RealFrames]:
    """Return what is estimated from 95 frames, 4.7 s, of a drone that stands on the ground and moves by 3 mm."""
    folder, flight = data_folder / "euroc" / "V1_01_on_the_ground", read_feature_recording()
    assert "458.654" in (folder / "cam0" / "sensor.yaml").read_text(encoding="utf-8")  # the camera of that rig
    times = read_euroc_frame_times(folder)
    recording = RealFrames(folder, flight.rig, flight.imu.up_to(int(times[-1]) + 10_000_000), times)
    return estimate_recording(recording, VisualInertialOdometry(recording.rig)), recording


def test_real_frames_at_rest_start_the_estimate(on_the_ground: tuple[EstimatorRun, RealFrames]) -> None:
    run, recording = on_the_ground
    found = run.trajectory
    assert (found.t_ns[0] - recording.frame_times_ns[0]) * 1e-9 < 2.5  # it is shaken until 1.6 s
    assert len(found) > 45
    assert found.rotations[-1][2, 0] > 0.9  # the IMU's x axis points up, as it is mounted
    assert np.linalg.norm(found.rotations[:, 2] - found.rotations[0, 2], axis=1).max() < np.radians(1.0)
    assert np.linalg.norm(found.gyro_bias_rad_s[-1]) == pytest.approx(0.08, abs=0.01)
    assert all(e.health == Health.TRACKING for e in run.estimates if e.state is not None)


def test_real_frames_at_rest_stay_within_five_millimetres(on_the_ground: tuple[EstimatorRun, RealFrames]) -> None:
    found = on_the_ground[0].trajectory
    assert np.linalg.norm(found.p_world_imu - found.p_world_imu[0], axis=1).max() < 0.005
