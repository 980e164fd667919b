"""Logging while an estimator runs: to a file, to a viewer, until somebody kills it; and what it costs."""

import signal
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from dronevio.eval import colours
from dronevio.eval.rerun import entities
from dronevio.eval.rerun.blueprint import RecordingContents, flight_blueprint
from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.rerun.estimate import anchored_to
from dronevio.eval.rerun.images import JpegLog, VideoLog
from dronevio.eval.rerun.live import LiveLog, viewer_log
from dronevio.eval.rerun.log import RerunLog
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.video import VideoSettings
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements

RERUN = str(Path(find_spec("rerun_cli").origin).with_name("rerun"))
ESTIMATE = EstimateEntities("estimate")
NO_POINTS = np.zeros((0, 3))
BLUEPRINT = flight_blueprint(RecordingContents(("estimate",), 1), NO_POINTS)


def video(sink, entity, rate_hz):
    return VideoLog(sink, entity, rate_hz, VideoSettings())


def jpegs(sink, entity, rate_hz):
    return JpegLog(sink, entity, batch=20)


class Silent:
    """A camera's log that logs nothing."""

    def add(self, t_ns, image):
        pass

    def close(self):
        pass


def play(flight, live, frame_done=lambda index: None):
    """Tell a watcher what happened in a flight, in order."""
    index = 0
    for measurement in measurements(flight.recording):
        if isinstance(measurement, ImuSamples):
            live.imu(measurement)
            continue
        live.frame(measurement, flight.run.estimates[index], float(flight.run.cpu_ms[index]))
        frame_done(index)
        index += 1


def log_live(path, flight, cameras, frame_done=lambda index: None):
    """Log a flight to a file as if it happened now."""
    truth = flight.recording.ground_truth
    with (
        Sink.to_file(path, "live", BLUEPRINT, int(flight.recording.imu.t_ns[0])) as sink,
        RerunLog(sink, flight.recording.rig, cameras, NO_POINTS) as log,
    ):
        live = LiveLog(log, log.estimator("estimate", colours.ESTIMATE, anchored_to(truth)), truth)
        play(flight, live, frame_done)
        live.flush()


def times_ns(columns):
    return np.array(columns["time"].cast(pa.int64()))


def test_all_that_was_heard_is_in_the_file(flight, tmp_path, read_rrd, verify_rrd):
    path = tmp_path / "live.rrd"
    log_live(path, flight, jpegs)
    verify_rrd(path)
    columns = read_rrd(path)
    assert np.allclose(np.array(columns[entities.GYRO]["scalars"].to_pylist()), flight.recording.imu.gyro_rad_s)
    assert times_ns(columns[entities.image(0)]).tolist() == flight.recording.frame_times_ns.tolist()
    assert times_ns(columns[ESTIMATE.imu]).tolist() == flight.run.trajectory.t_ns.tolist()
    assert times_ns(columns[ESTIMATE.tracks]).tolist() == flight.run.t_ns.tolist()
    assert np.array(columns[ESTIMATE.cost]["scalars"].to_pylist())[:, 0].tolist() == flight.run.cpu_ms.tolist()


def test_the_first_pose_is_aligned_and_errors_are_logged(flight, tmp_path, read_rrd):
    log_live(tmp_path / "live.rrd", flight, jpegs)
    error = read_rrd(tmp_path / "live.rrd")[ESTIMATE.position_error.anchored]
    values = np.array(error["scalars"].to_pylist())[:, 0]
    assert times_ns(error).tolist() == flight.run.trajectory.t_ns.tolist()
    assert values[0] == pytest.approx(0.0, abs=1e-9)
    assert 0.01 < values.max() < 0.08  # it was turned by 1.1 rad and shifted by 2 m, and drifts by some cm


def test_without_truth_the_rig_goes_where_the_estimate_is(flight_without_truth, tmp_path, read_rrd):
    log_live(tmp_path / "live.rrd", flight_without_truth, jpegs)
    columns = read_rrd(tmp_path / "live.rrd")
    places = np.array(columns[entities.RIG]["translation"].to_pylist())[:, 0]
    assert np.allclose(places, flight_without_truth.run.trajectory.p_world_imu, atol=1e-5)
    assert not any(entity.startswith("error") for entity in columns)


def test_rows_go_in_by_the_second(flight, tmp_path):
    log_live(tmp_path / "live.rrd", flight, jpegs)
    from rerun.chunk import RrdReader

    chunks = [chunk.to_record_batch().num_rows for chunk in RrdReader(tmp_path / "live.rrd").stream()]
    assert max(chunks) >= 200  # a second of IMU
    assert len(chunks) < 300  # of 3000 rows


KILLED = """
import sys
from pathlib import Path
sys.path[:0] = [{folder!r}, {above!r}]
import conftest, test_live as here

def frame_done(index):
    if index == 90:
        print("there", flush=True)
        while True: pass

here.log_live(Path(sys.argv[1]), conftest.make_flight(), here.video, frame_done)
"""


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_file_whose_writer_was_killed_can_be_read(tmp_path, read_rrd, verify_rrd):
    path = tmp_path / "run.rrd"
    code = KILLED.format(folder=str(Path(__file__).parent), above=str(Path(__file__).parents[1]))
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"there\n"
        time.sleep(1.0)  # it is written five times a second
        writer.send_signal(signal.SIGKILL)
        assert writer.wait(10) == -signal.SIGKILL
    columns = read_rrd(path)
    assert len(columns[entities.image(0)]["sample"]) == 80  # two keyframe intervals
    assert len(times_ns(columns[ESTIMATE.imu])) >= 70
    assert len(columns[entities.GYRO]["scalars"]) >= 800


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_viewer_hears_all_of_it(flight, tmp_path, read_rrd):
    """Rerun's own server in the viewer's place: it saves what it hears, and listens to this machine only."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    heard = tmp_path / "heard.rrd"
    command = [RERUN, "--bind", "127.0.0.1", "--port", str(port), "--save", str(heard)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        try:
            wait_for(port)
            with viewer_log(f"rerun+http://127.0.0.1:{port}/proxy", flight.recording) as live:
                play(flight, live)
            time.sleep(1.0)
        finally:
            server.terminate()  # not Ctrl-C: who is started in the background does not hear that
            try:
                server.wait(20)
            finally:
                server.kill()
    columns = read_rrd(heard)
    assert len(columns[entities.image(0)]["blob"]) == len(flight.recording.frame_times_ns)
    assert times_ns(columns[ESTIMATE.imu]).tolist() == flight.run.trajectory.t_ns.tolist()
    assert len(columns[entities.TRUE_PATH_SO_FAR]["strips"]) > 100


def wait_for(port):
    for _ in range(200):
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=1.0):
                return
        except OSError:
            time.sleep(0.05)
    raise AssertionError(f"nobody listens at {port}")


def test_what_logging_costs(flight, tmp_path, capsys):
    """A frame of a mission takes 60 ms or more of processor time, drawn and estimated; 5 % of that are 3 ms."""
    costs = {}
    for name, cameras in (("no images", lambda *_: Silent()), ("JPEG", jpegs), ("video", video)):
        log_live(tmp_path / "warm.rrd", flight, lambda *_: Silent())
        started = time.process_time()
        log_live(tmp_path / f"{name}.rrd", flight, cameras)
        costs[name] = (time.process_time() - started) / len(flight.run.estimates) * 1e3
    with capsys.disabled():
        print("\nlogging, CPU-ms a frame of 376 × 240:", {name: round(cost, 2) for name, cost in costs.items()})
    assert costs["no images"] < 3.0
    assert costs["JPEG"] < 6.0
    assert costs["video"] < 12.0
