"""Recordings with several estimates: paths, errors, covariances, events and alignment of each."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest

from dronevio.eval.metrics import ScoredTrajectory, score_trajectory
from dronevio.eval.rerun import entities
from dronevio.eval.rerun.blueprint import RecordingContents, flight_blueprint
from dronevio.eval.rerun.compare import NamedEstimate, align_estimates
from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.rerun.estimate import AlignmentRule, EstimateLog, anchored_to, ellipsoids
from dronevio.eval.rerun.files import write_estimates
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import MovingBox, Surroundings
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Health, Trajectory
from dronevio.recording.surroundings import surroundings_of

if TYPE_CHECKING:
    from tests.eval.conftest import EntityColumns, ReadRrd, SyntheticFlight, VerifyRrd

BLUEPRINT = flight_blueprint(RecordingContents(("x",), 1), np.zeros((0, 3)))
OURS, OTHER = "ours", "other / 2"


class StereoRecording:
    """A recording with a second camera, whose images are those of the first upside down."""

    def __init__(self, recording: Recording) -> None:
        T_imu_cam1 = EUROC_T_IMU_CAM0.copy()
        T_imu_cam1[:3, 3] += 0.11 * T_imu_cam1[:3, 0]
        left = recording.rig.cameras[0]
        self.name: str = recording.name
        self.rig: Rig = Rig((left, RigCamera(left.model, T_imu_cam1)))
        self.imu: ImuSamples = recording.imu
        self.frame_times_ns: Times = recording.frame_times_ns
        self.ground_truth: Trajectory | None = recording.ground_truth
        self._recording = recording

    def frame(self, index: int) -> CameraFrame:
        """Return a frame with two images."""
        image = self._recording.frame(index).images[0]
        return CameraFrame(int(self.frame_times_ns[index]), (image, image[::-1].copy()))


def times_ns(columns: dict[str, pa.Array]) -> npt.NDArray[np.int64]:
    """Return the times of the rows of an entity since the start of the recording [ns]."""
    return np.array(columns["time"].cast(pa.int64()))


@pytest.fixture(scope="module")
def scored(flight: "SyntheticFlight") -> ScoredTrajectory:
    """Return the errors of the estimate of the flight."""
    return score_trajectory(flight.truth, flight.run.trajectory, flight.recording.frame_times_ns)


@pytest.fixture(scope="module")
def estimates(flight: "SyntheticFlight", scored: ScoredTrajectory) -> list[NamedEstimate]:
    """Return the estimate of the flight with its run, and the same trajectory at another scale without a run."""
    ours = flight.run.trajectory
    rescaled = Trajectory(ours.t_ns, 1.1 * ours.p_world_imu, ours.quat_wxyz)
    [other] = align_estimates([OTHER], [rescaled], flight.truth, flight.recording.frame_times_ns)
    return [NamedEstimate(OURS, ours, scored.alignment, scored, flight.run), other]


@pytest.fixture(scope="module")
def rrd(flight: "SyntheticFlight", estimates: list[NamedEstimate], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file with both estimates, two cameras and a moving object."""
    path = tmp_path_factory.mktemp("rerun") / "both.rrd"
    Ts_world_lift = np.tile(np.eye(4), (len(flight.recording.frame_times_ns), 1, 1))

    def poses(times_s: Array) -> Array:
        Ts_world_lift[:, 2, 3] = times_s
        return Ts_world_lift

    lift = MovingBox("a lift", np.zeros(3), np.array([1.0, 1.0, 2.0]), poses)
    surroundings = Surroundings(flight.outline, (lift,))
    write_estimates(path, StereoRecording(flight.recording), flight.truth, estimates, surroundings=surroundings)
    return path


@pytest.fixture(scope="module")
def columns(rrd: Path, read_rrd: "ReadRrd") -> "EntityColumns":
    """Return the content of the file."""
    return read_rrd(rrd)


def test_the_file_is_valid(rrd: Path, verify_rrd: "VerifyRrd") -> None:
    verify_rrd(rrd)


def test_each_estimate_has_its_path_colour_and_errors(columns: "EntityColumns", estimates: list[NamedEstimate]) -> None:
    colours = set()
    summary = columns[entities.SUMMARY]["text"][0].as_py()[0]
    for estimate in estimates:
        assert estimate.scored is not None
        of_estimate = EstimateEntities(estimate.name)
        strip = np.array(columns[of_estimate.path]["strips"][0].as_py()[0])
        assert np.allclose(strip, estimate.scored.alignment.positions(estimate.trajectory.p_world_imu), atol=1e-5)
        errors = columns[of_estimate.position_error.aligned]
        assert np.allclose(np.array(errors["scalars"].to_pylist())[:, 0], estimate.scored.translation_error_m)
        assert errors["names"].to_pylist()[0] == [estimate.name]
        colours.add(errors["colors"].to_pylist()[0][0])
        assert f"| {estimate.name} | {estimate.scored.scores.ate_m.rmse:.4f} m |" in summary
    assert len(colours) == 2


def test_a_trajectory_without_a_run_has_only_paths_and_errors(columns: "EntityColumns") -> None:
    ours, other = EstimateEntities(OURS), EstimateEntities(OTHER)
    for name in ("tracks", "cost", "health", "landmarks", "keyframes"):
        assert len(times_ns(columns[getattr(ours, name)])) > 0
        assert "time" not in columns.get(getattr(other, name), {})


def test_both_cameras_have_all_frames_and_their_positions(columns: "EntityColumns", flight: "SyntheticFlight") -> None:
    for index in (0, 1):
        assert len(columns[entities.image(index)]["sample"]) == len(flight.recording.frame_times_ns)
    left, right = (np.array(columns[entities.camera(i)]["translation"][0].as_py()[0]) for i in (0, 1))
    assert np.allclose(right - left, 0.11 * EUROC_T_IMU_CAM0[:3, 0], atol=1e-6)


def test_moving_objects_are_posed_at_each_frame(columns: "EntityColumns", flight: "SyntheticFlight") -> None:
    lift = columns[f"{entities.MOVING_OBJECTS}/a\\ lift"]
    seconds = (flight.recording.frame_times_ns - flight.recording.frame_times_ns[0]) * 1e-9
    assert np.allclose([row[0][2] for row in lift["translation"].to_pylist()], seconds, atol=1e-5)
    assert np.allclose(lift["half_sizes"][0].as_py()[0], [0.5, 0.5, 1.0])


def test_moving_objects_of_a_world_have_bounding_boxes() -> None:
    surroundings = surroundings_of("moving", 0)
    assert len(surroundings.moving_boxes) > 3
    for box in surroundings.moving_boxes:
        assert np.all(box.high > box.low)
        assert np.all(box.high - box.low < 10.0)
        assert box.poses(np.array([0.0, 1.0])).shape == (2, 4, 4)


def test_ellipsoids_have_the_axes_of_their_covariances() -> None:
    rng = np.random.default_rng(0)
    R = exp_so3(rng.normal(size=(20, 3)))
    sigma = rng.uniform(0.01, 1.0, (20, 3))
    half, axes = ellipsoids(R @ (np.eye(3) * sigma[:, None] ** 2) @ np.swapaxes(R, 1, 2))
    assert np.allclose(half, np.sort(sigma, axis=1))
    assert np.allclose(np.linalg.det(axes), 1.0)
    rebuilt = axes @ (np.eye(3) * half[:, None] ** 2) @ np.swapaxes(axes, 1, 2)
    assert np.allclose(rebuilt, R @ (np.eye(3) * sigma[:, None] ** 2) @ np.swapaxes(R, 1, 2))


def test_ellipsoids_follow_the_estimate_with_its_three_sigma(
    columns: "EntityColumns", flight: "SyntheticFlight", scored: ScoredTrajectory
) -> None:
    ellipsoid, trajectory = columns[EstimateEntities(OURS).covariance], flight.run.trajectory
    assert trajectory.covariance is not None
    half = np.array(ellipsoid["half_sizes"].to_pylist())[:, 0]
    sigma_m = np.sqrt(trajectory.covariance[:, 3, 3])
    assert np.allclose(half, 3.0 * sigma_m[:, None], rtol=1e-5)
    centres = np.array(ellipsoid["centers"].to_pylist())[:, 0]
    assert np.allclose(centres, scored.alignment.positions(trajectory.p_world_imu), atol=1e-5)


def log_pieces(path: Path, run: EstimatorRun, pieces: int, alignment: AlignmentRule) -> Path:
    """Log the estimates of a run in a number of pieces."""
    ends = np.linspace(0, len(run.estimates), pieces + 1).astype(int)
    with Sink.to_file(path, "pieces", BLUEPRINT, int(run.t_ns[0])) as sink:
        log = EstimateLog(sink, "x", "#d55e00", alignment)
        for start, end in pairwise(ends):
            log.estimates(run.estimates[start:end], run.cpu_ms[start:end])
    return path


def test_rows_logged_in_pieces_equal_those_logged_at_once(
    flight: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd"
) -> None:
    alignment = anchored_to(flight.truth)
    estimates = list(flight.run.estimates)
    estimates[60] = replace(estimates[60], health=Health.LOST, events=("lost",))
    loop, T = (estimates[20].t_ns, estimates[80].t_ns), pose_matrix(rotation_z(0.01), np.ones(3))
    estimates[90] = replace(estimates[90], events=("loop closed", "keyframe"), closed_loops_ns=(loop,))
    estimates = [replace(e, T_map_odom=T if i > 90 else np.eye(4)) for i, e in enumerate(estimates)]
    run = replace(flight.run, estimates=tuple(estimates))
    whole, pieces = (read_rrd(log_pieces(tmp_path / f"{n}.rrd", run, n, alignment)) for n in (1, 7))
    del whole["__properties"], pieces["__properties"]  # which contain the time of writing
    assert whole.keys() == pieces.keys()
    for entity, expected in whole.items():
        assert expected.keys() == pieces[entity].keys()
        for name, values in expected.items():
            assert pieces[entity][name].to_pylist() == values.to_pylist(), (entity, name)


def test_events_are_marked_at_their_positions(flight: "SyntheticFlight", tmp_path: Path, read_rrd: "ReadRrd") -> None:
    estimates = list(flight.run.estimates)
    estimates[60] = replace(estimates[60], health=Health.LOST, state=None)
    loops = tuple((estimates[i].t_ns, estimates[j].t_ns) for i, j in ((20, 80), (30, 85)))
    estimates[90] = replace(estimates[90], events=("two loops closed",), closed_loops_ns=loops)
    run = replace(flight.run, estimates=tuple(estimates))
    columns = read_rrd(log_pieces(tmp_path / "x.rrd", run, 3, anchored_to(None)))
    logged, p = EstimateEntities("x"), flight.run.trajectory.p_world_imu
    markers = columns[logged.event_markers]
    labels = [row[0] for row in markers["labels"].to_pylist()]
    assert labels == ["initialized, health: tracking", "health: lost", "health: tracking", estimates[90].events[0]]
    frames = np.array([10, 59, 61, 90])  # the loss at frame 60 is marked at the last pose before it
    assert np.allclose([row[0] for row in markers["positions"].to_pylist()], p[frames - 10], atol=1e-5)
    drawn = columns[logged.loops]
    assert times_ns(drawn)[-1] == estimates[90].t_ns  # not before the loops are closed
    assert np.allclose(drawn["strips"].to_pylist()[-1], p[[[70, 10], [75, 20]]], atol=1e-5)
    assert [row[0] for row in columns[logged.health]["state"].to_pylist()] == [
        "initializing",
        "tracking",
        "lost",
        "tracking",
    ]
    keyframes = times_ns(columns[logged.keyframes])
    assert keyframes.tolist() == [e.t_ns for e in estimates if "keyframe" in e.events]


def test_without_truth_all_are_aligned_with_the_first(flight: "SyntheticFlight") -> None:
    ours = flight.run.trajectory
    rotated = Trajectory(ours.t_ns, ours.p_world_imu @ exp_so3(np.array([0.0, 0.0, 1.0])).T + 3.0, ours.quat_wxyz)
    aligned = align_estimates(["a", "b"], [ours, rotated], None, flight.recording.frame_times_ns)
    assert [estimate.scored for estimate in aligned] == [None, None]
    assert np.allclose(aligned[1].alignment.positions(rotated.p_world_imu), ours.p_world_imu, atol=1e-9)


def test_an_estimate_outside_the_times_of_the_truth_is_named(flight: "SyntheticFlight") -> None:
    ours = flight.run.trajectory
    late = replace(ours, t_ns=ours.t_ns + 10**12)
    with pytest.raises(EvaluationError, match=r"^b: "):
        align_estimates(["a", "b"], [ours, late], flight.truth, flight.recording.frame_times_ns)
