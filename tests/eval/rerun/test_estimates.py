"""Several estimators in one recording, and what is drawn of each."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest

from dronevio.eval.metrics import score_trajectory
from dronevio.eval.rerun import entities
from dronevio.eval.rerun.blueprint import RecordingContents, flight_blueprint
from dronevio.eval.rerun.compare import NamedEstimate, align_estimates
from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.rerun.estimate import EstimateLog, anchored_to, ellipsoids
from dronevio.eval.rerun.files import write_estimates
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import MovingBox, Surroundings
from dronevio.models.errors import EvaluationError
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera
from dronevio.models.rotation import exp_so3
from dronevio.models.state import CameraFrame, Health, Trajectory
from dronevio.sim.world import build_world
from dronevio.surroundings import surroundings_of

BLUEPRINT = flight_blueprint(RecordingContents(("x",), 1), np.zeros((0, 3)))
GOOD, BAD = "ours", "theirs / 2"


class Stereo:
    """A recording whose second camera sees the first one's images upside down."""

    def __init__(self, recording):
        self._recording = recording
        T = EUROC_T_IMU_CAM0.copy()
        T[:3, 3] += 0.11 * T[:3, 0]
        main = recording.rig.cameras[0]
        self.rig = Rig((main, RigCamera(main.model, T)))

    def __getattr__(self, name):
        return getattr(self._recording, name)

    def frame(self, index):
        image = self._recording.frame(index).images[0]
        return CameraFrame(int(self.frame_times_ns[index]), (image, image[::-1].copy()))


def times_ns(columns):
    return np.array(columns["time"].cast(pa.int64()))


@pytest.fixture(scope="module")
def estimates(flight):
    truth, ours = flight.recording.ground_truth, flight.run.trajectory
    scored = score_trajectory(truth, ours, flight.recording.frame_times_ns)
    theirs = Trajectory(ours.t_ns, 1.1 * ours.p_world_imu, ours.quat_wxyz)
    [other] = align_estimates([BAD], [theirs], truth, flight.recording.frame_times_ns)
    return [NamedEstimate(GOOD, ours, scored.alignment, scored, flight.run), other]


@pytest.fixture(scope="module")
def rrd(flight, estimates, tmp_path_factory):
    path = tmp_path_factory.mktemp("rerun") / "both.rrd"
    lift = np.tile(np.eye(4), (len(flight.recording.frame_times_ns), 1, 1))

    def poses(times_s):
        lift[:, 2, 3] = times_s
        return lift

    around = Surroundings(flight.outline, (MovingBox("a lift", np.zeros(3), np.array([1.0, 1.0, 2.0]), poses),))
    recording = Stereo(flight.recording)
    write_estimates(path, recording, recording.ground_truth, estimates, surroundings=around)
    return path


@pytest.fixture(scope="module")
def columns(rrd, read_rrd):
    return read_rrd(rrd)


def test_the_file_verifies(rrd, verify_rrd):
    verify_rrd(rrd)


def test_each_has_its_path_its_colour_and_its_errors(columns, estimates):
    colours = set()
    for estimate in estimates:
        where = EstimateEntities(estimate.name)
        strip = np.array(columns[where.path]["strips"][0].as_py()[0])
        assert np.allclose(strip, estimate.scored.alignment.positions(estimate.trajectory.p_world_imu), atol=1e-5)
        errors = np.array(columns[where.position_error.aligned]["scalars"].to_pylist())[:, 0]
        assert np.allclose(errors, estimate.scored.translation_error_m)
        assert columns[where.position_error.aligned]["names"].to_pylist()[0] == [estimate.name]
        colours.add(columns[where.position_error.aligned]["colors"].to_pylist()[0][0])
    assert len(colours) == 2
    summary = columns[entities.SUMMARY]["text"][0].as_py()[0]
    assert f"| {GOOD} | {estimates[0].scored.scores.ate_m.rmse:.3f} m |" in summary
    assert f"| {BAD} | {estimates[1].scored.scores.ate_m.rmse:.3f} m |" in summary


def test_only_who_answered_has_tracks_costs_and_health(columns):
    ours, theirs = EstimateEntities(GOOD), EstimateEntities(BAD)
    for name in ("tracks", "cost", "health", "landmarks", "keyframes"):
        values = columns.get(getattr(theirs, name), {})
        assert len(times_ns(columns[getattr(ours, name)])) > 0
        assert "time" not in values


def test_both_cameras_see_all_frames_from_their_places(columns, flight):
    for index in (0, 1):
        assert len(columns[entities.image(index)]["sample"]) == len(flight.recording.frame_times_ns)
    apart = np.subtract(*(columns[entities.camera(i)]["translation"][0].as_py()[0] for i in (1, 0)))
    assert np.allclose(apart, 0.11 * EUROC_T_IMU_CAM0[:3, 0], atol=1e-6)


def test_what_moves_is_where_it_is_at_each_frame(columns, flight):
    lift = columns[f"{entities.MOVING_OBJECTS}/a\\ lift"]
    seconds = (flight.recording.frame_times_ns - flight.recording.frame_times_ns[0]) * 1e-9
    assert np.allclose([row[0][2] for row in lift["translation"].to_pylist()], seconds, atol=1e-5)
    assert np.allclose(lift["half_sizes"][0].as_py()[0], [0.5, 0.5, 1.0])


def test_movers_of_a_world_have_the_size_of_what_is_seen():
    around = surroundings_of(build_world("moving", 0))
    assert len(around.moving_boxes) > 3
    for mover in around.moving_boxes:
        assert np.all(mover.high > mover.low)
        assert np.all(mover.high - mover.low < 10.0)
        assert mover.poses(np.array([0.0, 1.0])).shape == (2, 4, 4)


def test_ellipsoids_have_the_spread_of_what_they_describe():
    rng = np.random.default_rng(0)
    R = exp_so3(rng.normal(size=(20, 3)))
    sigma = rng.uniform(0.01, 1.0, (20, 3))
    half, axes = ellipsoids(R @ (np.eye(3) * sigma[:, None] ** 2) @ np.swapaxes(R, 1, 2))
    assert np.allclose(half, np.sort(sigma, axis=1))
    assert np.allclose(np.linalg.det(axes), 1.0)
    rebuilt = axes @ (np.eye(3) * half[:, None] ** 2) @ np.swapaxes(axes, 1, 2)
    assert np.allclose(rebuilt, R @ (np.eye(3) * sigma[:, None] ** 2) @ np.swapaxes(R, 1, 2))


def test_the_ellipsoid_goes_along_and_grows(columns, estimates):
    where = EstimateEntities(GOOD)
    half = np.array(columns[where.covariance]["half_sizes"].to_pylist())[:, 0]
    stated = np.sqrt(estimates[0].trajectory.covariance[:, 3, 3])
    assert np.allclose(half, 3.0 * stated[:, None], rtol=1e-5)
    centres = np.array(columns[where.covariance]["centers"].to_pylist())[:, 0]
    assert np.allclose(centres, estimates[0].scored.alignment.positions(estimates[0].trajectory.p_world_imu), atol=1e-5)


def log_pieces(path, run, pieces, gauge):
    """Log answers in so many pieces."""
    ends = np.linspace(0, len(run.estimates), pieces + 1).astype(int)
    with Sink.to_file(path, "pieces", BLUEPRINT, int(run.t_ns[0])) as sink:
        log = EstimateLog(sink, "x", "#d55e00", gauge)
        for start, end in pairwise(ends):
            log.estimates(run.estimates[start:end], run.cpu_ms[start:end])
    return path


def test_pieces_say_the_same_as_the_whole(flight, tmp_path, read_rrd):
    gauge = anchored_to(flight.recording.ground_truth)
    estimates = list(flight.run.estimates)
    estimates[60] = replace(estimates[60], health=Health.LOST, events=("lost",))
    loop = f"loop closed with {estimates[20].t_ns}"
    estimates[90] = replace(estimates[90], events=(loop, "keyframe"))
    run = replace(flight.run, estimates=tuple(estimates))
    whole, pieces = (read_rrd(log_pieces(tmp_path / f"{n}.rrd", run, n, gauge)) for n in (1, 7))
    del whole["__properties"], pieces["__properties"]  # when the file was made
    assert whole.keys() == pieces.keys()
    for entity, expected in whole.items():
        assert expected.keys() == pieces[entity].keys()
        for name, values in expected.items():
            assert pieces[entity][name].to_pylist() == values.to_pylist(), (entity, name)


def test_events_are_marked_where_they_happened(flight, tmp_path, read_rrd):
    estimates = list(flight.run.estimates)
    estimates[60] = replace(estimates[60], health=Health.LOST, state=None)
    estimates[90] = replace(estimates[90], events=(f"loop closed with {estimates[20].t_ns}",))
    run = replace(flight.run, estimates=tuple(estimates))
    columns = read_rrd(log_pieces(tmp_path / "x.rrd", run, 3, anchored_to(None)))
    where, p = EstimateEntities("x"), np.array([e.state.T_world_imu[:3, 3] for e in flight.run.estimates[10:]])
    markers = columns[where.event_markers]
    labels = [row[0] for row in markers["labels"].to_pylist()]
    assert labels == ["initialized, health: tracking", "health: lost", "health: tracking", estimates[90].events[0]]
    at_frames = [10, 59, 61, 90]  # what is lost is shown where it last was
    assert np.allclose([row[0] for row in markers["positions"].to_pylist()], p[np.array(at_frames) - 10], atol=1e-5)
    [loop] = columns[where.loops]["strips"].to_pylist()[-1:]
    assert np.allclose(loop[0], p[[80, 10]], atol=1e-5)
    assert [row[0] for row in columns[where.health]["state"].to_pylist()] == [
        "initializing",
        "tracking",
        "lost",
        "tracking",
    ]
    keyframes = times_ns(columns[where.keyframes])
    assert keyframes.tolist() == [e.t_ns for e in estimates if "keyframe" in e.events]


def test_without_a_truth_all_are_laid_on_the_first(flight):
    ours = flight.run.trajectory
    turned = Trajectory(ours.t_ns, ours.p_world_imu @ exp_so3(np.array([0.0, 0.0, 1.0])).T + 3.0, ours.quat_wxyz)
    laid = align_estimates(["a", "b"], [ours, turned], None, flight.recording.frame_times_ns)
    assert [estimate.scored for estimate in laid] == [None, None]
    assert np.allclose(laid[1].alignment.positions(turned.p_world_imu), ours.p_world_imu, atol=1e-9)


def test_who_shares_no_time_with_the_truth_is_named(flight):
    ours = flight.run.trajectory
    late = replace(ours, t_ns=ours.t_ns + 10**12)
    with pytest.raises(EvaluationError, match=r"^b: "):
        align_estimates(["a", "b"], [ours, late], flight.recording.ground_truth, flight.recording.frame_times_ns)
