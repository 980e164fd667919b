"""A flight as a rerun recording: what the drone saw and felt, where it was, and where estimators thought it was.

`RerunLog` writes to a file or to a viewer that runs (`dronevio.eval.rerun.sink`), all at once or piece by piece while
the flight goes on: `run_file` opens the file of a run that is to come, `dronevio.eval.rerun.live.watched` shows it in a
viewer. `write_rrd` makes the file of a run that is over, `write_estimates` that of several estimators side by side.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
import rerun as rr

from dronevio.eval import colours
from dronevio.eval.metrics import IDENTITY, Alignment, ScoredTrajectory, interpolate
from dronevio.eval.rerun import entities as at
from dronevio.eval.rerun.blueprint import Shown, flight_blueprint
from dronevio.eval.rerun.compare import NamedEstimate, summary_table
from dronevio.eval.rerun.estimate import FLOWN_RADIUS, WHOLE_RADIUS, EstimateLog, Gauge
from dronevio.eval.rerun.images import ImageLog, VideoLog
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import NOTHING_KNOWN, Surroundings
from dronevio.eval.rerun.video import VideoSettings
from dronevio.eval.run import EstimatorRun
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, Trajectory

Array = npt.NDArray[np.float64]
Cameras = Callable[[Sink, str, float], ImageLog]
"""Makes the log of a camera's images from sink, entity and frame rate [Hz]."""

ESTIMATE = "estimate"
"""What the estimator of a run is called in its file."""
_IMAGE_PLANE = 0.06  # how far before the camera its image hangs in the 3D view, as a share of what is seen there
_IMAGE_PLANE_M = (0.1, 10.0)  # and at least and at most [m]
_AXIS = 0.6  # length of the estimated IMU's axes, as a share of that
_TRUTH_AMONG_MANY = "#f2f2f2"  # the estimators have all colours
_DRAWN_POINTS = 1500  # of a whole path: the truth comes at 200 Hz, more than the eye needs


class RerunLog:
    """Writes a flight to a sink; leaving its context hands over what is not yet written."""

    def __init__(self, sink: Sink, rig: Rig, cameras: Cameras, points: Array) -> None:
        """Start the recording of a flight.

        Args:
            sink: Where to write.
            rig: What the drone carries.
            cameras: How images are encoded.
            points: (N, 3) Places that the view shall show [m]: the drone is drawn as large as suits them.
        """
        self._sink = sink
        across_m = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
        self._image_plane_m = float(np.clip(_IMAGE_PLANE * across_m, *_IMAGE_PLANE_M))
        self._images = [cameras(sink, at.image(i), camera.rate_hz) for i, camera in enumerate(rig.cameras)]
        sink.static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for entity, label in ((at.GYRO, "rad/s"), (at.ACCEL, "m/s²")):
            sink.lines(entity, [f"{axis} [{label}]" for axis in "xyz"], colours.AXES)
        self._draw_rig(rig)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for images in self._images:
            images.close()

    def surroundings(self, surroundings: Surroundings, times_ns: Times) -> None:
        """Log the outline of the world, and where what moves is at times (N,) [ns] since the first of them."""
        if len(surroundings.outline):
            colour = [*colours.rgb(colours.SURROUNDINGS), 150]
            strips = surroundings.outline.astype(np.float32)
            self._sink.static(at.ROOM, rr.LineStrips3D(strips, colors=colour, radii=rr.Radius.ui_points(0.5)))
        for mover in surroundings.movers:
            entity = f"{at.MOVERS}/{rr.escape_entity_path_part(mover.name)}"
            box = rr.Boxes3D(mins=[mover.low], sizes=[mover.high - mover.low], colors=colours.rgb(colours.SURROUNDINGS))
            self._sink.static(entity, box)
            self._sink.poses(entity, times_ns, mover.poses(np.asarray((times_ns - times_ns[:1]) * 1e-9)))

    def truth(self, truth: Trajectory, frame_times_ns: Times, colour: str = colours.TRUTH) -> None:
        """Log the true path, faintly as a whole and brightly as far as it has been flown, speed and biases.

        The rig is shown where it truly was at the frames' times (M,) [ns].
        """
        drawn = truth[:: max(1, len(truth) // _DRAWN_POINTS)]
        t_ns, p, rgb = drawn.t_ns, drawn.p_world_imu, colours.rgb(colour)
        if len(p) > 1:
            whole = rr.LineStrips3D([p.astype(np.float32)], colors=[*rgb, 150], radii=WHOLE_RADIUS)
            self._sink.static(at.TRUE_WHOLE, whole)
            self._sink.static(at.TRUE_FLOWN, rr.LineStrips3D.from_fields(colors=rgb, radii=FLOWN_RADIUS))
            self._sink.segments(at.TRUE_FLOWN, t_ns[1:], p[:-1], p[1:])
        self.rig_poses(interpolate(truth, frame_times_ns)[0])
        if truth.velocity_m_s is not None:
            self._sink.lines(f"{at.SPEED}/true", ["true"], [colour])
            self._sink.values(f"{at.SPEED}/true", truth.t_ns, np.linalg.norm(truth.velocity_m_s, axis=1))
        for entity, bias in ((at.GYRO_BIAS, truth.gyro_bias_rad_s), (at.ACCEL_BIAS, truth.accel_bias_m_s2)):
            if bias is not None:
                self._sink.lines(f"{entity}/true", [f"{axis} true" for axis in "xyz"], colours.AXES_PALE)
                self._sink.values(f"{entity}/true", truth.t_ns, bias)

    def rig_poses(self, body: Trajectory) -> None:
        """Log where the rig's IMU is, and its cameras with it."""
        self._sink.poses(at.RIG, body.t_ns, body.Ts_world_imu)

    def imu(self, samples: ImuSamples) -> None:
        """Log what the gyroscope [rad/s] and the accelerometer [m/s²] read."""
        self._sink.values(at.GYRO, samples.t_ns, samples.gyro_rad_s)
        self._sink.values(at.ACCEL, samples.t_ns, samples.accel_m_s2)

    def frame(self, frame: CameraFrame) -> None:
        """Log the images of all cameras."""
        for images, image in zip(self._images, frame.images, strict=True):
            images.add(frame.t_ns, image)

    def estimator(self, name: str, colour: str, gauge: Gauge, alone: bool = True) -> EstimateLog:
        """Return the log of an estimator; see `EstimateLog`."""
        return EstimateLog(self._sink, name, colour, gauge, alone=alone, axis_m=_AXIS * self._image_plane_m)

    def summary(self, markdown: str) -> None:
        """Log what is to be said about the whole recording."""
        self._sink.static(at.SUMMARY, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def _draw_rig(self, rig: Rig) -> None:
        """Log where the cameras are on the rig, and their models."""
        for index, camera in enumerate(rig.cameras):
            T = camera.T_imu_cam
            self._sink.static(at.camera(index), rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            self._sink.static(
                at.image(index),
                rr.Pinhole(  # a viewer knows no lens distortion: the image is shown as it came
                    image_from_camera=camera.model.K,
                    resolution=[camera.model.width, camera.model.height],
                    camera_xyz=rr.ViewCoordinates.RDF,
                    image_plane_distance=self._image_plane_m,
                    color=colours.rgb(colours.TRUTH),
                    line_width=-0.8,  # in points of the screen, since it is negative,
                ),
            )


class RunFile:
    """The file of a run, written while the run goes on: first what was seen, in the end what the estimator said."""

    def __init__(self, log: RerunLog, recording: Recording) -> None:
        """Take the log, and what is being estimated."""
        self._log = log
        self._recording = recording

    def imu(self, samples: ImuSamples) -> None:
        """Do nothing: the IMU's samples are known beforehand."""

    def frame(self, frame: CameraFrame, answer: Estimate, cpu_ms: float) -> None:
        """Log the images of a frame; the answer comes with all the others, when they can be laid on the truth."""
        self._log.frame(frame)

    def finish(self, run: EstimatorRun, scored: ScoredTrajectory | None) -> None:
        """Log what the estimator made of the recording.

        Args:
            run: Its answers.
            scored: The run's trajectory beside the truth; None where there is no truth. The estimated path and map are
                shown in the truth's world, by the alignment that was scored.

        Raises:
            EvaluationError: The run does not belong to the recording.
        """
        run.check_belongs_to(self._recording)
        alignment = IDENTITY if scored is None else scored.alignment
        if self._recording.ground_truth is None:
            self._log.rig_poses(run.trajectory)
        log = self._log.estimator(ESTIMATE, colours.ESTIMATE, _fixed(alignment))
        _log_estimate(log, NamedEstimate(ESTIMATE, run.trajectory, alignment, scored, run))


@contextmanager
def run_file(
    path: Path,
    recording: Recording,
    *,
    surroundings: Surroundings = NOTHING_KNOWN,
    video: VideoSettings | None = None,
) -> Iterator[RunFile]:
    """Open the file of a run; what it is told of the run is in it when the context is left.

    Args:
        path: File to write; ``.rrd``.
        recording: What is being estimated.
        surroundings: What stands and moves around.
        video: Size and quality of the video.
    """
    truth = recording.ground_truth
    shown = Shown((ESTIMATE,), len(recording.rig.cameras), truth is not None)
    places = places_of(surroundings, [] if truth is None else [truth])
    with _flight_file(path, recording, truth, shown, places, surroundings, video) as log:
        yield RunFile(log, recording)


def write_rrd(
    path: Path,
    recording: Recording,
    run: EstimatorRun,
    scored: ScoredTrajectory | None,
    *,
    surroundings: Surroundings = NOTHING_KNOWN,
    progress: Progress = silent,
    video: VideoSettings | None = None,
) -> None:
    """Write a flight and what an estimator made of it to a rerun file, when the run is over.

    Args:
        path: File to write; ``.rrd``.
        recording: What was measured.
        run: What the estimator made of it.
        scored: The run's trajectory beside the truth; None where there is no truth.
        surroundings: What stands and moves around.
        progress: Told how many frames are encoded.
        video: Size and quality of the video.

    Raises:
        EvaluationError: The run does not belong to the recording.
        InputError: An image cannot be read; what was written up to then can be.
    """
    run.check_belongs_to(recording)
    with run_file(path, recording, surroundings=surroundings, video=video) as file:
        file.finish(run, scored)
        for index, (answer, cpu_ms) in enumerate(zip(run.estimates, run.cpu_ms, strict=True)):
            file.frame(recording.frame(index), answer, float(cpu_ms))
            progress(index + 1, len(run.estimates))


def write_estimates(
    path: Path,
    recording: Recording,
    truth: Trajectory | None,
    estimates: Sequence[NamedEstimate],
    *,
    surroundings: Surroundings = NOTHING_KNOWN,
    progress: Progress = silent,
    video: VideoSettings | None = None,
) -> None:
    """Write a flight, and what one or several estimators made of it, to a rerun file.

    Args:
        path: File to write; ``.rrd``.
        recording: What was measured.
        truth: The true motion, where it is known; it need not be the recording's own.
        estimates: What is shown side by side, each by its name.
        surroundings: What stands and moves around.
        progress: Told how many frames are encoded.
        video: Size and quality of the video.

    Raises:
        InputError: An image cannot be read; what was written up to then can be.
    """
    aligned = [estimate.alignment.apply(estimate.trajectory) for estimate in estimates]
    shown = Shown(
        names=tuple(estimate.name for estimate in estimates),
        n_cameras=len(recording.rig.cameras),
        truth_is_known=truth is not None,
        answers=any(estimate.run is not None for estimate in estimates),
    )
    places = places_of(surroundings, [*aligned, *([] if truth is None else [truth])])
    with _flight_file(path, recording, truth, shown, places, surroundings, video) as log:
        if truth is None and aligned:
            log.rig_poses(interpolate(aligned[0], recording.frame_times_ns)[0])
        for index, estimate in enumerate(estimates):
            colour = colours.ESTIMATE if shown.alone else colours.ESTIMATORS[index % len(colours.ESTIMATORS)]
            _log_estimate(log.estimator(estimate.name, colour, _fixed(estimate.alignment), shown.alone), estimate)
        if not shown.alone:
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
    shown: Shown,
    places: Array,
    surroundings: Surroundings,
    video: VideoSettings | None,
) -> Iterator[RerunLog]:
    """Open a file and log what is known of a flight before anybody estimates it: the world, the truth and the IMU."""
    settings = video or VideoSettings()

    def camera(sink: Sink, entity: str, rate_hz: float) -> ImageLog:
        return VideoLog(sink, entity, rate_hz, settings)

    with (
        Sink.to_file(path, recording.name, flight_blueprint(shown, places), first_ns(recording)) as sink,
        RerunLog(sink, recording.rig, camera, places) as log,
    ):
        log.surroundings(surroundings, recording.frame_times_ns)
        if truth is not None:
            colour = colours.TRUTH if shown.alone else _TRUTH_AMONG_MANY
            log.truth(truth, recording.frame_times_ns, colour)
        log.imu(recording.imu)
        yield log


def _log_estimate(log: EstimateLog, estimate: NamedEstimate) -> None:
    """Log all that is known of an estimate."""
    log.whole(estimate.trajectory)
    if estimate.run is not None:
        log.answers(estimate.run.estimates, estimate.run.cpu_ms)
    else:
        log.poses(estimate.trajectory)
    if estimate.scored is not None:
        log.errors(estimate.scored)


def _fixed(alignment: Alignment) -> Gauge:
    return lambda _: alignment


def places_of(surroundings: Surroundings, paths: Sequence[Trajectory]) -> Array:
    """Return places (N, 3) between which everything lies [m], with room for the drone around its paths."""
    flown = np.concatenate([np.zeros((0, 3)), *(path.p_world_imu for path in paths)])
    if len(flown):
        reach_m = _IMAGE_PLANE * np.linalg.norm(np.ptp(flown, axis=0))
        around = np.concatenate([np.eye(3), -np.eye(3)]) * reach_m
        flown = (flown[:: max(1, len(flown) // _DRAWN_POINTS), None] + around).reshape(-1, 3)
    return np.concatenate([surroundings.outline.reshape(-1, 3), flown])


def first_ns(recording: Recording) -> int:
    """Return the time stamp of a recording's first measurement [ns]."""
    return min(int(recording.frame_times_ns[0]), *(int(t) for t in recording.imu.t_ns[:1]))
