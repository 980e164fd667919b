"""A flight as a rerun recording: what the drone saw and felt, where it was, and where estimators thought it was.

`RerunLog` writes to a file or to a viewer that runs (`dronevio.eval.rerun_sink`), all at once or piece by piece while
the flight goes on (`dronevio.eval.rerun_live`). `write_rrd` makes the file of a run, `write_estimates` that of several
estimators beside each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
import rerun as rr

from dronevio.eval import palette
from dronevio.eval import rerun_entities as at
from dronevio.eval.metrics import IDENTITY, Alignment, ScoredTrajectory, interpolate
from dronevio.eval.rerun_blueprint import Shown, flight_blueprint
from dronevio.eval.rerun_compare import NamedEstimate, summary_table
from dronevio.eval.rerun_estimate import EstimateLog, Gauge
from dronevio.eval.rerun_images import ImageLog, VideoLog
from dronevio.eval.rerun_sink import Sink
from dronevio.eval.runs import EstimatorRun
from dronevio.eval.video import VideoSettings
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Trajectory

Array = npt.NDArray[np.float64]
Cameras = Callable[[Sink, str, float], ImageLog]
"""Makes the log of a camera's images from sink, entity and frame rate [Hz]."""

IMAGE_PLANE_M = 0.6  # how far before the camera its image hangs in the 3D view
_DRAWN_POINTS = 1500  # of a whole path: the truth comes at 200 Hz, more than the eye needs


@dataclass(frozen=True, eq=False)
class MovingBox:
    """Something that moves by itself, as large as a box."""

    name: str
    """What it is called."""
    low: Array
    """(3,) Least corner in its own frame [m]."""
    high: Array
    """(3,) Greatest corner in its own frame [m]."""
    poses: Callable[[Array], Array]
    """Maps times (M,) since the start of the flight [s] to poses (M, 4, 4) in the world."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stands and moves around the drone."""

    outline: Array
    """(L, 2, 3) Line segments [m], in the truth's world."""
    movers: tuple[MovingBox, ...] = ()
    """What moves."""


NOTHING_KNOWN = Surroundings(np.zeros((0, 2, 3)))
"""The surroundings of a flight of which nobody wrote them down."""


class RerunLog:
    """Writes a flight to a sink; leaving its context hands over what is not yet written."""

    def __init__(self, sink: Sink, rig: Rig, cameras: Cameras) -> None:
        """Take where to write, what the drone carries, and how images are encoded."""
        self._sink = sink
        self._images = [cameras(sink, at.image(i), camera.rate_hz) for i, camera in enumerate(rig.cameras)]
        sink.static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for entity, label in ((at.GYRO, "rad/s"), (at.ACCEL, "m/s²")):
            sink.lines(entity, [f"{axis} [{label}]" for axis in "xyz"], palette.AXES)
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
            colour = [*palette.rgb(palette.ROOM), 150]
            strips = surroundings.outline.astype(np.float32)
            self._sink.static(at.ROOM, rr.LineStrips3D(strips, colors=colour, radii=0.006))
        for mover in surroundings.movers:
            entity = f"{at.MOVERS}/{rr.escape_entity_path_part(mover.name)}"
            box = rr.Boxes3D(mins=[mover.low], sizes=[mover.high - mover.low], colors=palette.rgb(palette.ROOM))
            self._sink.static(entity, box)
            self._sink.poses(entity, times_ns, mover.poses(np.asarray((times_ns - times_ns[:1]) * 1e-9)))

    def truth(self, truth: Trajectory, frame_times_ns: Times) -> None:
        """Log the true path, faintly as a whole and brightly as far as it has been flown, speed and biases.

        The rig is shown where it truly was at the frames' times (M,) [ns].
        """
        drawn = truth[:: max(1, len(truth) // _DRAWN_POINTS)]
        t_ns, p, colour = drawn.t_ns, drawn.p_world_imu, palette.rgb(palette.TRUTH)
        if len(p) > 1:
            whole = rr.LineStrips3D([p.astype(np.float32)], colors=[*colour, 150], radii=0.010)
            self._sink.static(at.TRUE_WHOLE, whole)
            self._sink.static(at.TRUE_FLOWN, rr.LineStrips3D.from_fields(colors=colour, radii=0.022))
            self._sink.segments(at.TRUE_FLOWN, t_ns[1:], p[:-1], p[1:])
        self.rig_poses(interpolate(truth, frame_times_ns)[0])
        if truth.velocity_m_s is not None:
            self._sink.lines(f"{at.SPEED}/true", ["true"], [palette.TRUTH])
            self._sink.values(f"{at.SPEED}/true", truth.t_ns, np.linalg.norm(truth.velocity_m_s, axis=1))
        for entity, bias in ((at.GYRO_BIAS, truth.gyro_bias_rad_s), (at.ACCEL_BIAS, truth.accel_bias_m_s2)):
            if bias is not None:
                self._sink.lines(f"{entity}/true", [f"{axis} true" for axis in "xyz"], palette.AXES_PALE)
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
        return EstimateLog(self._sink, name, colour, gauge, alone)

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
                    image_plane_distance=IMAGE_PLANE_M,
                    color=palette.rgb(palette.TRUTH),
                    line_width=0.008,
                ),
            )


def write_rrd(
    path: Path,
    recording: Recording,
    run: EstimatorRun,
    scored: ScoredTrajectory | None,
    *,
    name: str | None = None,
    outline: Array | None = None,
    movers: tuple[MovingBox, ...] = (),
    progress: Progress = silent,
    video: VideoSettings | None = None,
) -> None:
    """Write a flight and what an estimator made of it to a rerun file, with a blueprint that lays it out.

    Args:
        path: File to write; ``.rrd``.
        recording: What was measured.
        run: What the estimator made of it.
        scored: The run's trajectory beside the truth; None where there is no truth. The estimated path and map are
            shown in the truth's world, by the alignment that was scored.
        name: What the viewer shall call it; the recording's name by default.
        outline: (L, 2, 3) Line segments of the surroundings [m], in the truth's world.
        movers: What moves by itself.
        progress: Told how many frames are encoded.
        video: Size and quality of the video.

    Raises:
        EvaluationError: The run does not belong to the recording.
        InputError: An image cannot be read.
    """
    run.check_belongs_to(recording)
    alignment = IDENTITY if scored is None else scored.alignment
    estimate = NamedEstimate("estimate", run.trajectory, alignment, scored, run)
    around = Surroundings(np.zeros((0, 2, 3)) if outline is None else outline, movers)
    write_estimates(
        path,
        recording,
        recording.ground_truth,
        [estimate],
        name=name,
        surroundings=around,
        progress=progress,
        video=video,
    )


def write_estimates(
    path: Path,
    recording: Recording,
    truth: Trajectory | None,
    estimates: Sequence[NamedEstimate],
    *,
    name: str | None = None,
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
        name: What the viewer shall call it; the recording's name by default.
        surroundings: What stands and moves around.
        progress: Told how many frames are encoded.
        video: Size and quality of the video.

    Raises:
        InputError: An image cannot be read; what was written up to then can be.
    """
    settings, frame_times_ns = video or VideoSettings(), recording.frame_times_ns
    aligned = [estimate.alignment.apply(estimate.trajectory) for estimate in estimates]
    alone = len(estimates) == 1
    shown = Shown(
        names=tuple(estimate.name for estimate in estimates),
        n_cameras=len(recording.rig.cameras),
        truth_is_known=truth is not None,
        answers=any(estimate.run is not None for estimate in estimates),
    )
    places = [surroundings.outline.reshape(-1, 3), *(t.p_world_imu for t in [*aligned, *([truth] if truth else [])])]
    blueprint = flight_blueprint(shown, np.concatenate(places))
    with (
        Sink.to_file(path, name or recording.name, blueprint, first_ns(recording)) as sink,
        RerunLog(sink, recording.rig, lambda sink, entity, rate_hz: VideoLog(sink, entity, rate_hz, settings)) as log,
    ):
        log.surroundings(surroundings, frame_times_ns)
        if truth is not None:
            log.truth(truth, frame_times_ns)
        elif aligned:
            log.rig_poses(interpolate(aligned[0], frame_times_ns)[0])
        log.imu(recording.imu)
        for index, estimate in enumerate(estimates):
            colour = palette.ESTIMATE if alone else palette.ESTIMATORS[index % len(palette.ESTIMATORS)]
            _log_estimate(log.estimator(estimate.name, colour, _fixed(estimate.alignment), alone), estimate)
        if not alone:
            log.summary(summary_table(estimates))
        for index in range(len(frame_times_ns)):
            log.frame(recording.frame(index))
            progress(index + 1, len(frame_times_ns))


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


def first_ns(recording: Recording) -> int:
    """Return the time stamp of a recording's first measurement [ns]."""
    return min(int(recording.frame_times_ns[0]), *(int(t) for t in recording.imu.t_ns[:1]))
