"""The odometry on images: rendered ones of a wall, through a folder and the command line, and real stationary ones."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.cli import main
from dronevio.estimator.book.eqvio import read_feature_recording
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.metrics.alignment import align
from dronevio.eval.run import EstimatorRun
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.euroc import EurocRecording, read_euroc_segment_times, write_euroc
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import pose_matrix
from dronevio.models.state import CameraFrame, Health, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]
RenderWall = Callable[[CameraModel, npt.NDArray[np.float64]], npt.NDArray[np.uint8]]

CAMERA = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0, (-0.28, 0.07, 2e-4, 2e-5))
T_WALL_WORLD = pose_matrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))  # z forward
HOVER = {
    "positions_m": np.array([[0.25, 0.08], [0.45, 0.1], [0.25, 0.06]]),
    "position_rates": np.array([[1.1, 2.9], [1.3, 2.7], [1.2, 3.1]]),
    "angles_rad": np.array([[0.15, 0.05], [0.05, 0.03], [0.06, 0.03]]),
}


@dataclass(frozen=True)
class RenderedFlight:
    """A synthetic flight with rendered images, as a recording in the format of EuRoC."""

    folder: Path
    """The folder of the recording."""
    truth: Trajectory
    """The true states at the times of the IMU samples."""


@pytest.fixture(scope="module")
def rendered(
    make_flight: MakeFlight, render_wall: RenderWall, tmp_path_factory: pytest.TempPathFactory
) -> RenderedFlight:
    """Return the recording of a flight in front of a textured wall."""
    flight = make_flight(5, rest_s=1.2, duration_s=5.0, motion=HOVER)
    rig = replace(flight.rig, cameras=(replace(flight.rig.cameras[0], model=CAMERA),))
    folder = tmp_path_factory.mktemp("rendered") / "wall-5"
    truth, times = flight.truth_at(flight.imu.t_ns), flight.frame_times_ns
    write_euroc(folder, rig, flight.imu, truth, times)
    noise = np.random.default_rng(0)
    for t_ns, T_world_cam in zip(times.tolist(), flight.Ts_world_cam(times), strict=True):
        image = render_wall(CAMERA, T_WALL_WORLD @ T_world_cam) + noise.normal(0.0, 2.0, (CAMERA.height, CAMERA.width))
        cv2.imwrite(str(folder / "mav0/cam0/data" / f"{t_ns}.png"), np.clip(image, 0, 255).astype(np.uint8))
    return RenderedFlight(folder, truth)


@pytest.fixture(scope="module")
def estimated(rendered: RenderedFlight, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return the JSON text that ``dronevio estimate`` printed, and the file with the trajectory that it wrote."""
    out = tmp_path_factory.mktemp("estimated") / "estimate.tum"
    lines: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout.write", lines.append)
        assert main(["estimate", str(rendered.folder), "--out", str(out), "--json"]) == 0
    return "".join(lines), out


def test_json_summary_describes_the_trajectory(rendered: RenderedFlight, estimated: tuple[str, Path]) -> None:
    summary, trajectory = json.loads(estimated[0]), read_tum(estimated[1])
    assert summary["recording"] == str(rendered.folder) and summary["estimate"] == str(estimated[1])
    assert summary["frames"] == 101 and summary["poses"] == len(trajectory)
    assert 0.7 < summary["first_pose_s"] < 1.2
    assert summary["path_m"] == pytest.approx(trajectory.length_m, abs=1e-6)
    assert summary["cpu_ms_per_frame"] > 0.0
    assert summary["real_time_factor"] == pytest.approx(5.0 / (101 * summary["cpu_ms_per_frame"] * 1e-3), rel=0.01)


def test_trajectory_agrees_with_the_truth(rendered: RenderedFlight, estimated: tuple[str, Path]) -> None:
    trajectory = read_tum(estimated[1])
    times = read_euroc_segment_times(rendered.folder)[0]
    np.testing.assert_array_equal(trajectory.t_ns, times[-len(trajectory) :])  # every frame since the initialization
    truth = rendered.truth[np.searchsorted(rendered.truth.t_ns, trajectory.t_ns)]
    fit = align(truth.p_world_imu, trajectory.p_world_imu, "yaw")
    errors_m = np.linalg.norm(fit.positions(trajectory.p_world_imu) - truth.p_world_imu, axis=1)
    assert truth.length_m > 1.5
    assert np.sqrt(np.mean(errors_m**2)) < 0.02
    tilt = np.linalg.norm(np.cross(trajectory.rotations[:, 2], truth.rotations[:, 2]), axis=1)
    assert tilt.max() < np.radians(2.0)  # z is up


def test_same_recording_same_bytes(rendered: RenderedFlight, estimated: tuple[str, Path], tmp_path: Path) -> None:
    again = tmp_path / "again.tum"
    assert main(["estimate", str(rendered.folder / "mav0"), "--out", str(again), "--json"]) == 0
    assert again.read_bytes() == estimated[1].read_bytes()


def test_truth_does_not_leak(rendered: RenderedFlight, estimated: tuple[str, Path], tmp_path: Path) -> None:
    """Without the ground truth in the folder, the estimate is the same to the byte."""
    folder = tmp_path / "without-truth"
    (folder / "mav0").mkdir(parents=True)
    for name in ("cam0", "imu0", "body.yaml"):
        if (rendered.folder / "mav0" / name).exists():
            (folder / "mav0" / name).symlink_to(rendered.folder / "mav0" / name)
    assert EurocRecording.open(folder).ground_truth is None
    out = tmp_path / "estimate.tum"
    assert main(["estimate", str(folder), "--out", str(out), "--json"]) == 0
    assert out.read_bytes() == estimated[1].read_bytes()


def test_command_prints_a_summary(rendered: RenderedFlight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "estimate.tum"
    assert main(["estimate", str(rendered.folder), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    for text in ("Estimate of wall-5", "frames", "101", "first pose after", "ms", f"wrote {out}", "dronevio evaluate"):
        assert text in printed


def input_error(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """Run a command that must fail because of its input, and return the single line of its message."""
    assert main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("dronevio: ") and err.count("\n") == 1
    return err


def test_recording_without_any_pose_is_bad_input(
    rendered: RenderedFlight, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """All frames are black."""
    dark = tmp_path / "dark"
    recording = EurocRecording.open(rendered.folder)
    write_euroc(dark, recording.rig, recording.imu, rendered.truth, recording.frame_times_ns)
    for t_ns in recording.frame_times_ns.tolist():
        black = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
        cv2.imwrite(str(dark / "mav0/cam0/data" / f"{t_ns}.png"), black)
    out = tmp_path / "estimate.tum"
    message = input_error(["estimate", str(dark), "--out", str(out), "--json"], capfd)
    assert "dark: no pose after 101 frames (not observable yet: " in message
    assert not out.exists()


def test_truncated_image_is_refused_only_if_strict(
    rendered: RenderedFlight, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken"
    (broken / "mav0" / "cam0" / "data").mkdir(parents=True)
    for name in ("imu0", "body.yaml", "cam0/data.csv", "cam0/sensor.yaml"):
        if (rendered.folder / "mav0" / name).exists():
            (broken / "mav0" / name).symlink_to(rendered.folder / "mav0" / name)
    images = sorted((rendered.folder / "mav0" / "cam0" / "data").iterdir())
    for image in images:
        (broken / "mav0" / "cam0" / "data" / image.name).symlink_to(image)
    truncated = broken / "mav0" / "cam0" / "data" / images[60].name
    truncated.unlink()
    truncated.write_bytes(images[60].read_bytes()[:1000])
    out = tmp_path / "estimate.tum"
    message = input_error(["estimate", str(broken), "--out", str(out), "--strict", "--json"], capfd)
    assert str(truncated) in message and "truncated" in message
    assert not out.exists()
    assert main(["estimate", str(broken), "--out", str(out)]) == 0  # by default the odometry goes on without the image
    assert f"{truncated}: a truncated PNG" in capfd.readouterr().err and out.exists()


def test_output_that_cannot_be_written_is_bad_input(
    rendered: RenderedFlight, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("not a folder")
    message = input_error(
        ["estimate", str(rendered.folder), "--out", str(tmp_path / "file" / "e.tum"), "--json"], capfd
    )
    assert str(tmp_path / "file") in message
    assert "a folder" in input_error(["estimate", str(rendered.folder), "--out", str(tmp_path), "--json"], capfd)


@pytest.mark.parametrize("images", [0, 1], ids=["no image", "one image"])
def test_rig_of_two_cameras_requires_two_images(rendered: RenderedFlight, images: int) -> None:
    recording = EurocRecording.open(rendered.folder)
    second = RigCamera(CAMERA, np.eye(4))
    odometry = VisualInertialOdometry(replace(recording.rig, cameras=(*recording.rig.cameras, second)))
    frame = recording.frame(0)
    with pytest.raises(ConfigError, match=f"with {images} images; expected 2"):
        odometry.add_frame(replace(frame, images=frame.images[:images]))


@dataclass(frozen=True, eq=False)
class RealFrames:
    """Real frames of EuRoC's V1_01 with the IMU samples of the same time, which the gtsam package contains."""

    folder: Path
    """The folder of the frames."""
    rig: Rig
    """The calibration of the sensors."""
    imu: ImuSamples
    """All samples of the IMU."""
    frame_times_ns: npt.NDArray[np.int64]
    """(N,) Time stamps of the frames [ns]."""
    name: str = "V1_01 on the ground"
    """Name of the recording."""
    ground_truth: Trajectory | None = None
    """There is no ground truth."""

    def frame(self, index: int) -> CameraFrame:
        """Return a frame by its index."""
        t_ns = int(self.frame_times_ns[index])
        image = cv2.imread(str(self.folder / "cam0" / "data" / f"{t_ns}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        return CameraFrame(t_ns, (image.astype(np.uint8, copy=False),))


@pytest.fixture(scope="module")
def on_the_ground(data_folder: Path) -> tuple[EstimatorRun, RealFrames]:
    """Return the estimates for 95 frames, 4.7 s, of a drone that stands on the ground and moves by 3 mm."""
    folder, flight = data_folder / "euroc" / "V1_01_on_the_ground", read_feature_recording()
    assert "458.654" in (folder / "cam0" / "sensor.yaml").read_text(encoding="utf-8")  # fx of that rig's camera
    times = read_euroc_segment_times(folder)[0]
    recording = RealFrames(folder, flight.rig, flight.imu.up_to(int(times[-1]) + 10_000_000), times)
    return estimate_recording(recording, VisualInertialOdometry(recording.rig)), recording


def test_stationary_real_frames_initialize_the_odometry(on_the_ground: tuple[EstimatorRun, RealFrames]) -> None:
    run, recording = on_the_ground
    trajectory = run.trajectory
    # The drone is shaken until 1.6 s
    assert (trajectory.t_ns[0] - recording.frame_times_ns[0]) * 1e-9 < 2.5
    assert len(trajectory) > 45
    assert trajectory.rotations[-1][2, 0] > 0.9  # the IMU is mounted with its x axis upwards
    assert np.linalg.norm(trajectory.rotations[:, 2] - trajectory.rotations[0, 2], axis=1).max() < np.radians(1.0)
    assert trajectory.gyro_bias_rad_s is not None
    assert np.linalg.norm(trajectory.gyro_bias_rad_s[-1]) == pytest.approx(0.08, abs=0.01)
    assert all(e.health == Health.TRACKING for e in run.estimates if e.state is not None)


def test_position_of_stationary_real_frames_is_constant(on_the_ground: tuple[EstimatorRun, RealFrames]) -> None:
    """The estimated position stays within 5 mm."""
    trajectory = on_the_ground[0].trajectory
    assert np.linalg.norm(trajectory.p_world_imu - trajectory.p_world_imu[0], axis=1).max() < 0.005
