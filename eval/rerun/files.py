"""Rerun files of flights.

`run_file` opens the file of a run that is about to start, `write_rrd` writes that of a finished run, and
`write_estimates` that of several estimates of one flight.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from dronevio.eval import colours
from dronevio.eval.map_results import MapResults
from dronevio.eval.metrics import IDENTITY, Alignment, ScoredTrajectory, interpolate
from dronevio.eval.rerun.blueprint import RecordingContents, flight_blueprint
from dronevio.eval.rerun.compare import NamedEstimate, summary_table
from dronevio.eval.rerun.estimate import AlignmentRule, EstimateLog
from dronevio.eval.rerun.images import ImageLog, VideoLog
from dronevio.eval.rerun.log import RerunLog, first_time_ns, scene_points
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import NO_SURROUNDINGS, Surroundings
from dronevio.eval.rerun.video import VideoSettings
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.state import CameraFrame, Estimate, Trajectory

ESTIMATE = "estimate"
"""Name of the estimator in the file of a run."""
_TRUTH_AMONG_ESTIMATES = "#f2f2f2"  # estimators use all colours


class RunFile:
    """The file of a run: images are written during the run, the estimates at its end."""

    def __init__(self, log: RerunLog, recording: Recording) -> None:
        """Take the log, and the recording that is being estimated."""
        self._log = log
        self._recording = recording

    def imu(self, samples: ImuSamples) -> None:
        """Do nothing: the IMU samples were logged when the file was opened."""

    def frame(self, frame: CameraFrame, estimate: Estimate, cpu_ms: float) -> None:
        """Log the images of a frame; `finish` logs the estimates, which cannot be aligned before."""
        self._log.frame(frame)

    def finish(self, run: EstimatorRun, scored: ScoredTrajectory | None, mapped: MapResults | None = None) -> None:
        """Log the estimates of a run.

        Args:
            run: The estimates of all frames.
            scored: The estimated trajectory with its errors; None without ground truth. Path and landmarks are shown
                with its alignment.
            mapped: The map of the run with the corrected trajectories; None without a map.

        Raises:
            EvaluationError: The run does not belong to the recording.
        """
        run.check_belongs_to(self._recording)
        alignment = IDENTITY if scored is None else scored.alignment
        if self._recording.ground_truth is None:
            self._log.rig_poses(run.trajectory)
        map_alignment = None if mapped is None else mapped.online_alignment
        log = self._log.estimator(ESTIMATE, colours.ESTIMATE, _fixed(alignment), map_alignment=map_alignment)
        _log_estimate(log, NamedEstimate(ESTIMATE, run.trajectory, alignment, scored, run))
        if mapped is not None:
            log.final_map(mapped)


@contextmanager
def run_file(
    path: Path,
    recording: Recording,
    *,
    surroundings: Surroundings = NO_SURROUNDINGS,
    video: VideoSettings | None = None,
    has_map: bool = False,
) -> Iterator[RunFile]:
    """Open the file of a run, which is complete when the context is left.

    Args:
        path: File to write, with the suffix ``.rrd``.
        recording: The recording that is being estimated.
        surroundings: Outline of the surroundings.
        video: Size and quality of the video; None for the default.
        has_map: Whether the estimator has a map, which the layout then shows.
    """
    truth = recording.ground_truth
    contents = RecordingContents((ESTIMATE,), len(recording.rig.cameras), truth is not None, has_map=has_map)
    points = scene_points(surroundings, [] if truth is None else [truth])
    with _flight_file(path, recording, truth, contents, points, surroundings, video) as log:
        yield RunFile(log, recording)


def write_rrd(
    path: Path,
    recording: Recording,
    run: EstimatorRun,
    scored: ScoredTrajectory | None,
    *,
    mapped: MapResults | None = None,
    surroundings: Surroundings = NO_SURROUNDINGS,
    progress: Progress = silent,
    video: VideoSettings | None = None,
) -> None:
    """Write the rerun file of a finished run.

    Args:
        path: File to write, with the suffix ``.rrd``.
        recording: The measurements.
        run: The estimates of all frames.
        scored: The estimated trajectory with its errors; None without ground truth.
        mapped: The map of the run with the corrected trajectories; None without a map.
        surroundings: Outline of the surroundings.
        progress: Called with the number of encoded frames.
        video: Size and quality of the video; None for the default.

    Raises:
        EvaluationError: The run does not belong to the recording.
        InputError: An image cannot be read; the file contains what was written before.
    """
    run.check_belongs_to(recording)
    with run_file(path, recording, surroundings=surroundings, video=video, has_map=mapped is not None) as file:
        file.finish(run, scored, mapped)
        for index, (estimate, cpu_ms) in enumerate(zip(run.estimates, run.cpu_ms, strict=True)):
            file.frame(recording.frame(index), estimate, float(cpu_ms))
            progress(index + 1, len(run.estimates))


def write_estimates(
    path: Path,
    recording: Recording,
    truth: Trajectory | None,
    estimates: Sequence[NamedEstimate],
    *,
    surroundings: Surroundings = NO_SURROUNDINGS,
    progress: Progress = silent,
    video: VideoSettings | None = None,
) -> None:
    """Write a rerun file of a flight with one or several estimates.

    Args:
        path: File to write, with the suffix ``.rrd``.
        recording: The measurements.
        truth: The true trajectory, which may differ from that of the recording; None if it is not known.
        estimates: The estimates with their names.
        surroundings: Outline of the surroundings.
        progress: Called with the number of encoded frames.
        video: Size and quality of the video; None for the default.

    Raises:
        InputError: An image cannot be read; the file contains what was written before.
    """
    aligned = [estimate.alignment.apply(estimate.trajectory) for estimate in estimates]
    contents = RecordingContents(
        names=tuple(estimate.name for estimate in estimates),
        n_cameras=len(recording.rig.cameras),
        has_truth=truth is not None,
        has_frame_estimates=any(estimate.run is not None for estimate in estimates),
    )
    single = contents.is_single
    points = scene_points(surroundings, [*aligned, *([] if truth is None else [truth])])
    with _flight_file(path, recording, truth, contents, points, surroundings, video) as log:
        if truth is None and aligned:
            log.rig_poses(interpolate(aligned[0], recording.frame_times_ns)[0])
        for index, estimate in enumerate(estimates):
            colour = colours.ESTIMATE if single else colours.ESTIMATORS[index % len(colours.ESTIMATORS)]
            _log_estimate(log.estimator(estimate.name, colour, _fixed(estimate.alignment), single), estimate)
        if not single:
            log.summary(summary_table(estimates))
        total = len(recording.frame_times_ns)
        for index in range(total):
            log.frame(recording.frame(index))
            progress(index + 1, total)


@contextmanager
def _flight_file(
    path: Path,
    recording: Recording,
    truth: Trajectory | None,
    contents: RecordingContents,
    points: Array,
    surroundings: Surroundings,
    video: VideoSettings | None,
) -> Iterator[RerunLog]:
    """Open a file and log what does not depend on estimates: surroundings, truth and IMU."""
    settings = video or VideoSettings()

    def make_image_log(sink: Sink, entity: str, rate_hz: float) -> ImageLog:
        return VideoLog(sink, entity, rate_hz, settings)

    with (
        Sink.to_file(path, recording.name, flight_blueprint(contents, points), first_time_ns(recording)) as sink,
        RerunLog(sink, recording.rig, make_image_log, points) as log,
    ):
        log.surroundings(surroundings, recording.frame_times_ns)
        if truth is not None:
            colour = colours.TRUTH if contents.is_single else _TRUTH_AMONG_ESTIMATES
            log.truth(truth, recording.frame_times_ns, colour)
        log.imu(recording.imu)
        yield log


def _log_estimate(log: EstimateLog, estimate: NamedEstimate) -> None:
    """Log path, frame estimates or poses, and errors of an estimate."""
    log.path(estimate.trajectory)
    if estimate.run is not None:
        log.estimates(estimate.run.estimates, estimate.run.cpu_ms)
    else:
        log.poses(estimate.trajectory)
    if estimate.scored is not None:
        log.errors(estimate.scored)


def _fixed(alignment: Alignment) -> AlignmentRule:
    return lambda _: alignment
