"""Recordings of a flight: images, measurements, ground truth and an estimate, as they are read back from the file."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from dronevio.eval import colours
from dronevio.eval.metrics import score_trajectory
from dronevio.eval.rerun import entities
from dronevio.eval.rerun.drone_body import DroneBody
from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.rerun.files import run_file, write_rrd
from dronevio.eval.rerun.surroundings import Surroundings
from dronevio.eval.run import EstimatorRun, tracks_of
from dronevio.eval.scene import VIEW_ASPECT, VIEWER_FIELD_OF_VIEW_RAD, fit_view
from dronevio.models.errors import EvaluationError, InputError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.models.scenery import TexturedMesh
from dronevio.models.state import CameraFrame, Health, Trajectory

if TYPE_CHECKING:
    from tests.eval.conftest import DecodeAv1, EntityColumns, ReadRrd, SyntheticFlight, VerifyRrd

FRAMES = 121
ESTIMATE = EstimateEntities("estimate")


def times_ns(columns: dict[str, pa.Array]) -> npt.NDArray[np.int64]:
    """Return the times of the rows of an entity since the start of the recording [ns]."""
    return np.array(columns["time"].cast(pa.int64()))


@pytest.fixture(scope="module")
def rrd(flight: "SyntheticFlight", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file with the flight and the aligned estimate."""
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    calls: list[tuple[int, int]] = []
    scored = score_trajectory(flight.truth, flight.run.trajectory)
    write_rrd(
        path,
        flight.recording,
        flight.run,
        scored,
        surroundings=Surroundings(flight.outline),
        progress=lambda done, total: calls.append((done, total)),
    )
    assert calls[-1] == (FRAMES, FRAMES)
    return path


@pytest.fixture(scope="module")
def columns(rrd: Path, read_rrd: "ReadRrd") -> "EntityColumns":
    """Return the content of the file."""
    return read_rrd(rrd)


def test_the_file_is_valid(rrd: Path, verify_rrd: "VerifyRrd") -> None:
    verify_rrd(rrd)


def test_every_frame_is_in_the_video(
    flight: "SyntheticFlight", columns: "EntityColumns", decode_av1: "DecodeAv1"
) -> None:
    image = columns[entities.image(0)]
    assert times_ns(image).tolist() == (flight.recording.frame_times_ns - flight.recording.imu.t_ns[0]).tolist()
    frames = decode_av1(bytes(sample[0].values.to_numpy()) for sample in image["sample"])
    assert len(frames) == FRAMES
    for index in (0, 60, FRAMES - 1):
        original = flight.recording.frame(index).images[0]
        assert frames[index].shape == original.shape
        assert np.mean(np.abs(frames[index].astype(float) - original)) < 4.0


def test_the_file_takes_less_than_50_kb_per_frame(rrd: Path, flight: "SyntheticFlight") -> None:
    pixels = flight.recording.rig.cameras[0].model.width * flight.recording.rig.cameras[0].model.height
    assert rrd.stat().st_size / FRAMES < 50_000 * pixels / (752 * 480)  # 30 MB for 600 frames of 752 × 480


def test_tracks_are_drawn_at_their_pixels(flight: "SyntheticFlight", columns: "EntityColumns") -> None:
    tracks = columns[ESTIMATE.tracks]
    assert times_ns(tracks).tolist() == flight.run.t_ns.tolist()
    for index in (0, 50, FRAMES - 1):
        expected = tracks_of(flight.run.estimates[index]).pixels + 0.5
        assert np.allclose(np.array(tracks["positions"][index].as_py()), expected, atol=1e-3)
        assert len(tracks["colors"][index]) == len(expected)


def test_paths_are_complete_and_aligned(flight: "SyntheticFlight", columns: "EntityColumns") -> None:
    truth = np.array(columns[entities.TRUE_PATH]["strips"][0].as_py()[0])
    estimate = np.array(columns[ESTIMATE.path]["strips"][0].as_py()[0])
    assert np.allclose(truth[0], flight.truth.p_world_imu[0], atol=1e-5)
    assert len(estimate) == len(flight.run.trajectory)
    expected = flight.truth.p_world_imu[::10][10:]
    assert np.linalg.norm(estimate - expected, axis=1).max() < 0.05  # its odometry frame is rotated by 1.1 rad
    path_so_far = columns[ESTIMATE.path_so_far]
    assert times_ns(path_so_far).tolist() == flight.run.trajectory.t_ns[1:].tolist()


def test_the_rig_is_at_the_true_pose(flight: "SyntheticFlight", columns: "EntityColumns") -> None:
    rig, camera = columns[entities.RIG], columns[entities.camera(0)]
    index = 80
    expected = flight.truth[::10].Ts_world_imu[index]
    x, y, z, w = rig["quaternion"][index].as_py()[0]
    assert np.allclose(rig["translation"][index].as_py()[0], expected[:3, 3], atol=1e-5)
    assert np.allclose(matrix_from_quat_wxyz(np.array([w, x, y, z])), expected[:3, :3], atol=1e-5)
    T_imu_cam = flight.recording.rig.cameras[0].T_imu_cam
    assert np.allclose(camera["translation"][0].as_py()[0], T_imu_cam[:3, 3], atol=1e-6)
    assert np.allclose(
        np.reshape(camera["mat3x3"][0].as_py()[0], (3, 3)).T, T_imu_cam[:3, :3], atol=1e-6
    )  # column-major


def test_landmarks_are_aligned_with_the_trajectory(columns: "EntityColumns") -> None:
    points = np.array(columns[ESTIMATE.visible_landmarks]["positions"][-1].as_py())
    assert len(points) > 20
    low, high = points.min(axis=0), points.max(axis=0)
    assert np.all(low > np.array([-3.0, -2.5, 0.0]) - 0.2)
    assert np.all(high < np.array([6.0, 2.5, 3.0]) + 0.2)


def test_imu_biases_errors_and_events_are_logged(flight: "SyntheticFlight", columns: "EntityColumns") -> None:
    gyro = columns[entities.GYRO]
    assert np.allclose(np.array(gyro["scalars"].to_pylist()), flight.recording.imu.gyro_rad_s)
    assert np.array(columns[ESTIMATE.accel_bias]["scalars"].to_pylist()).shape == (FRAMES - 10, 3)
    error = np.array(columns[ESTIMATE.position_error.anchored]["scalars"].to_pylist())
    band = np.array(columns[ESTIMATE.position_error.three_sigma]["scalars"].to_pylist())
    assert error.shape == band.shape == (FRAMES - 11, 1)  # of all poses but the first
    sigma_m = 5e-3 + 8e-3 * 0.05 * np.arange(1, FRAMES - 10)
    assert np.allclose(band[:, 0], 3.0 * np.sqrt(3.0) * sigma_m)
    texts = [row[0].as_py() for row in columns[ESTIMATE.events]["text"]]
    assert texts == ["health: initializing", "initialized", "health: tracking"]


def test_bad_health_is_logged_as_a_warning(flight: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd") -> None:
    estimates = list(flight.run.estimates)
    estimates[50:60] = [replace(e, health=Health.INERTIAL_ONLY) for e in estimates[50:60]]
    write_rrd(tmp_path / "run.rrd", flight.recording, replace(flight.run, estimates=tuple(estimates)), None)
    events = read_rrd(tmp_path / "run.rrd")[ESTIMATE.events]
    rows = [(text[0].as_py(), level[0].as_py()) for text, level in zip(events["text"], events["level"], strict=True)]
    assert rows[-2:] == [("health: inertial-only", "WARN"), ("health: tracking", "INFO")]
    assert times_ns(events)[-2:].tolist() == [50 * 50_000_000, 60 * 50_000_000]


def test_the_file_contains_its_layout(rrd: Path) -> None:
    blueprints = RrdReader(rrd).blueprints()
    assert len(blueprints) >= 1
    paths = {chunk.entity_path for chunk in RrdReader(rrd).stream(store=blueprints[0])}
    assert sum("ViewContents" in path for path in paths) >= 11


def test_without_truth_the_estimate_is_not_aligned(
    flight_without_truth: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd"
) -> None:
    write_rrd(tmp_path / "run.rrd", flight_without_truth.recording, flight_without_truth.run, None)
    columns = read_rrd(tmp_path / "run.rrd")
    strip = np.array(columns[ESTIMATE.path]["strips"][0].as_py()[0])
    assert np.allclose(strip, flight_without_truth.run.trajectory.p_world_imu, atol=1e-5)
    assert entities.SURROUNDINGS not in columns
    assert not any(entity.startswith("error") for entity in columns)


def test_surfaces_replace_the_outline(
    flight: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd", verify_rrd: "VerifyRrd"
) -> None:
    vertices = np.array([(-3, -3, 0), (3, -3, 0), (3, 3, 0), (-3, 3, 0)], np.float32)
    texture = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
    on_texture = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32)
    floor = TexturedMesh(vertices, on_texture, np.array([(0, 1, 2), (0, 2, 3)], np.uint32), texture)
    surroundings = Surroundings(flight.outline, meshes=(floor,))
    write_rrd(tmp_path / "run.rrd", flight.recording, flight.run, None, surroundings=surroundings)
    verify_rrd(tmp_path / "run.rrd")
    columns = read_rrd(tmp_path / "run.rrd")
    assert entities.SURROUNDINGS not in columns  # no outline
    surface = columns[f"{entities.SURROUNDINGS}/surface0"]
    assert np.allclose(surface["vertex_positions"][0].as_py(), vertices)
    assert np.array(surface["triangle_indices"][0].as_py()).tolist() == floor.triangles.tolist()
    assert np.allclose(surface["vertex_texcoords"][0].as_py(), on_texture)
    assert bytes(surface["albedo_texture_buffer"][0].as_py()[0]) == texture.tobytes()
    assert surface["face_rendering"][0].as_py() == [int(rr.components.MeshFaceRendering.Front.value)]


def test_true_and_estimated_body_move_with_their_poses(columns: "EntityColumns", flight: "SyntheticFlight") -> None:
    """The bodies are static below the poses that the other tests check: a solid one, and edges in another colour."""
    solid, edges = columns[entities.TRUE_BODY], columns[ESTIMATE.body]
    assert entities.TRUE_BODY.startswith(f"{entities.RIG}/") and ESTIMATE.body.startswith(f"{ESTIMATE.imu}/")
    assert "translation" in columns[entities.RIG] and "translation" in columns[ESTIMATE.imu]
    body = DroneBody.of(flight.recording.rig)
    assert np.allclose(solid["vertex_positions"][0].as_py(), body.triangles.reshape(-1, 3), atol=1e-6)
    assert len(edges["strips"][0].as_py()) == len(body.edges)
    assert edges["colors"][0].as_py() == [int.from_bytes((*colours.rgb(colours.ESTIMATE), 255), "big")]


def test_a_run_without_poses_has_images_but_no_path(
    flight: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd"
) -> None:
    estimates = tuple(replace(e, state=None, landmarks_odom=None, tracks=None) for e in flight.run.estimates)
    run = EstimatorRun(estimates, flight.run.cpu_ms, flight.run.wall_ms)
    write_rrd(tmp_path / "run.rrd", flight.recording, run, None)
    columns = read_rrd(tmp_path / "run.rrd")
    assert len(columns[entities.image(0)]["sample"]) == FRAMES
    assert ESTIMATE.path not in columns


def test_a_run_of_another_recording_is_refused(flight: "SyntheticFlight", tmp_path: Path) -> None:
    other = replace(flight.recording, frame_times_ns=flight.recording.frame_times_ns + 1)
    with pytest.raises(EvaluationError):
        write_rrd(tmp_path / "run.rrd", other, flight.run, None)
    assert not (tmp_path / "run.rrd").exists()


class DamagedRecording:
    """A recording whose images cannot be read from some frame on."""

    def __init__(self, recording: Recording, first_unreadable: int) -> None:
        self.name: str = recording.name
        self.rig: Rig = recording.rig
        self.imu: ImuSamples = recording.imu
        self.frame_times_ns: Times = recording.frame_times_ns
        self.ground_truth: Trajectory | None = recording.ground_truth
        self._recording = recording
        self._first_unreadable = first_unreadable

    def frame(self, index: int) -> CameraFrame:
        """Return a frame if it can be read."""
        if index >= self._first_unreadable:
            raise InputError("frame.png", "nothing", "an image")
        return self._recording.frame(index)


def test_rows_before_an_unreadable_image_are_in_the_file(
    flight: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd"
) -> None:
    path = tmp_path / "run.rrd"
    with pytest.raises(InputError):
        write_rrd(path, DamagedRecording(flight.recording, 70), flight.run, None)
    columns = read_rrd(path)
    assert len(columns[entities.image(0)]["sample"]) == 70
    assert len(columns[entities.GYRO]["scalars"]) == len(flight.recording.imu)


@pytest.mark.parametrize("seed", range(5))
def test_the_initial_view_contains_all_points_and_is_close(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (50, 3)) * [5.0, 3.0, 1.5] + [10.0, -4.0, 1.0]
    position, target = fit_view(points)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    depth = (points - position) @ forward
    tangent = np.tan(0.5 * VIEWER_FIELD_OF_VIEW_RAD)
    horizontal = np.abs((points - position) @ right) / depth / tangent / VIEW_ASPECT
    vertical = np.abs((points - position) @ up) / depth / tangent
    assert np.all(depth > 0.0)
    assert 0.85 < max(horizontal.max(), vertical.max()) <= 1.0


def test_a_live_file_equals_one_written_after_the_run(
    flight: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd", columns: "EntityColumns"
) -> None:
    path = tmp_path / "run.rrd"
    scored = score_trajectory(flight.truth, flight.run.trajectory)
    with run_file(path, flight.recording, surroundings=Surroundings(flight.outline)) as file:
        for index, (estimate, cpu_ms) in enumerate(zip(flight.run.estimates, flight.run.cpu_ms, strict=True)):
            file.frame(flight.recording.frame(index), estimate, float(cpu_ms))
        file.finish(flight.run, scored)
    found = read_rrd(path)
    assert found.keys() == columns.keys()
    for entity in found.keys() - {"__properties"}:  # which contain the time of writing
        for name, values in found[entity].items():
            assert values.to_pylist() == columns[entity][name].to_pylist(), (entity, name)
