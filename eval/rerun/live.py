"""Display of a flight in a viewer while an estimator runs, one second at a time.

The best alignment is not known before the end, so the estimate is anchored to the truth at its first pose.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce

import numpy as np

from dronevio.eval import colours
from dronevio.eval.rerun.blueprint import RecordingContents, flight_blueprint
from dronevio.eval.rerun.estimate import EstimateLog, anchored_to
from dronevio.eval.rerun.images import JpegLog
from dronevio.eval.rerun.log import RerunLog, first_time_ns, scene_points
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import NO_SURROUNDINGS, Surroundings
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.state import CameraFrame, Estimate, Trajectory

CHUNK_S = 1.0
"""Duration that is logged at a time [s], which takes ten calls of rerun instead of thousands."""


class LiveLog:
    """Logs the measurements and the estimates of a running estimator."""

    def __init__(
        self, log: RerunLog, estimate_log: EstimateLog, truth: Trajectory | None, chunk_s: float = CHUNK_S
    ) -> None:
        """Take the outputs.

        Args:
            log: Logs the measurements.
            estimate_log: Logs the estimates.
            truth: The true trajectory; None if it is not known.
            chunk_s: Duration that is logged at a time [s].
        """
        self._log = log
        self._estimate_log = estimate_log
        self._truth = truth
        self._chunk_ns = round(chunk_s * 1e9)
        self._imu: list[ImuSamples] = []
        self._estimates: list[Estimate] = []
        self._cpu_ms: list[float] = []

    def imu(self, samples: ImuSamples) -> None:
        """Receive IMU samples."""
        self._imu.append(samples)

    def frame(self, frame: CameraFrame, estimate: Estimate, cpu_ms: float) -> None:
        """Receive a frame, its estimate, and the processor time of the estimate [ms]."""
        self._log.frame(frame)
        self._estimates.append(estimate)
        self._cpu_ms.append(cpu_ms)
        if estimate.t_ns - self._estimates[0].t_ns >= self._chunk_ns:
            self.flush()

    def flush(self) -> None:
        """Log everything that has been received."""
        if self._imu:
            self._log.imu(reduce(ImuSamples.extended, self._imu))
        aligned = self._estimate_log.estimates(self._estimates, np.array(self._cpu_ms))
        if self._truth is None:
            self._log.rig_poses(aligned)  # the images need a pose
        else:
            self._estimate_log.anchored_errors(self._truth, aligned)
        self._imu, self._estimates, self._cpu_ms = [], [], []


@contextmanager
def viewer_log(
    url: str,
    recording: Recording,
    surroundings: Surroundings = NO_SURROUNDINGS,
    name: str = "estimate",
    has_map: bool = False,
) -> Iterator[LiveLog]:
    """Show a flight in a viewer while an estimator runs.

    Args:
        url: Address of the viewer, such as ``rerun+http://127.0.0.1:9876/proxy``.
        recording: The recording that is being estimated.
        surroundings: Outline of the surroundings.
        name: Name of the estimator.
        has_map: Whether the estimator has a map, which the layout then shows.
    """
    truth = recording.ground_truth
    contents = RecordingContents((name,), len(recording.rig.cameras), truth is not None, has_map=has_map)
    points = scene_points(surroundings, [] if truth is None else [truth])
    blueprint = flight_blueprint(contents, points)
    batch = max(1, round(CHUNK_S * recording.rig.cameras[0].rate_hz))
    with (
        Sink.to_viewer(url, recording.name, blueprint, first_time_ns(recording)) as sink,
        RerunLog(sink, recording.rig, lambda sink, entity, _: JpegLog(sink, entity, batch), points) as log,
    ):
        log.surroundings(surroundings, recording.frame_times_ns)
        if truth is not None:
            log.truth(truth, recording.frame_times_ns)
        live = LiveLog(log, log.estimator(name, colours.ESTIMATE, anchored_to(truth)), truth)
        try:
            yield live
        finally:
            live.flush()
