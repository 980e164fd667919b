"""A flight as a rerun recording: what the drone saw and felt, where it was, and where an estimator thought it was.

Everything lies on one timeline, ``time``: seconds of flight since the first measurement. Rows go in as columns, because
logging row by row costs a millisecond a call. The video is sent a keyframe interval at a time: when writing stops
half-way, the file can be read up to there.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from dronevio.eval import palette
from dronevio.eval.metrics import IDENTITY, Alignment, ScoredTrajectory, interpolate
from dronevio.eval.rerun_blueprint import Entities, flight_blueprint
from dronevio.eval.runs import EstimatorRun, tracks_of
from dronevio.eval.video import VideoSample, VideoSettings, encode_av1
from dronevio.models.imu import Times
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.rotation import quat_wxyz_from_matrix, quat_xyzw_from_wxyz
from dronevio.models.state import Health, Trajectory

Array = npt.NDArray[np.float64]

APPLICATION = "dronevio"
TIMELINE = "time"
IMAGE_PLANE_M = 0.6  # how far before the camera its image hangs in the 3D view
DEGREES = 180.0 / np.pi


def write_rrd(
    path: Path,
    recording: Recording,
    run: EstimatorRun,
    scored: ScoredTrajectory | None,
    *,
    name: str | None = None,
    outline: Array | None = None,
    progress: Progress = silent,
    video: VideoSettings | None = None,
) -> None:
    """Write a flight to a rerun file, with a blueprint that lays it out.

    Args:
        path: File to write; ``.rrd``.
        recording: What was measured.
        run: What the estimator made of it.
        scored: The run's trajectory beside the truth; None where there is no truth. The estimated path and map are
            shown in the truth's world, by the alignment that was scored.
        name: What the viewer shall call it; the recording's name by default.
        outline: (L, 2, 3) Line segments of the surroundings [m], in the truth's world.
        progress: Told how many frames are encoded.
        video: Size and quality of the video.

    Raises:
        EvaluationError: The run does not belong to the recording.
        InputError: An image cannot be read.
    """
    run.check_belongs_to(recording)
    settings = video or VideoSettings()
    outline = np.zeros((0, 2, 3)) if outline is None else outline
    alignment = IDENTITY if scored is None else scored.alignment
    estimate = alignment.apply(run.trajectory)
    blueprint = flight_blueprint(outline, estimate, recording.ground_truth)
    with _recording_stream(path, name or recording.name, blueprint) as stream:
        log = FlightLog(stream, origin_ns=_first_ns(recording))
        log.surroundings(outline)
        log.paths(recording.ground_truth, estimate)
        log.camera(recording, estimate)
        log.landmarks(run, alignment)
        log.tracks(run)
        log.events(run)
        log.imu(recording)
        log.states(recording.ground_truth, estimate)
        log.costs(run)
        if scored is not None:
            log.errors(scored)
        log.video(recording, settings, progress)


class FlightLog:
    """Writes the parts of a flight to a rerun stream."""

    def __init__(self, stream: rr.RecordingStream, origin_ns: int) -> None:
        """Take the stream, and the time stamp [ns] that is zero on the timeline."""
        self._stream = stream
        self._origin_ns = origin_ns

    def surroundings(self, outline: Array) -> None:
        """Log the axes' meaning and the outline (L, 2, 3) [m] of the room."""
        self._static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        if len(outline):
            self._static(
                Entities.ROOM,
                rr.LineStrips3D(outline.astype(np.float32), colors=[*palette.rgb(palette.ROOM), 150], radii=0.006),
            )

    def paths(self, truth: Trajectory | None, estimate: Trajectory) -> None:
        """Log each path twice: faint as a whole, and bright as far as it has been flown."""
        for entity, path, colour in (
            (Entities.TRUE_PATH, truth, palette.TRUTH),
            (Entities.ESTIMATED_PATH, estimate, palette.ESTIMATE),
        ):
            if path is None or len(path) < 2:
                continue
            step = max(1, len(path) // 1500)  # the truth comes at 200 Hz: more than the eye needs
            t_ns, p = path.t_ns[::step], path.p_world_imu[::step]
            whole = rr.LineStrips3D([p.astype(np.float32)], colors=[*palette.rgb(colour), 150], radii=0.010)
            self._static(f"{entity}/whole", whole)
            self._static(f"{entity}/flown", rr.LineStrips3D.from_fields(colors=palette.rgb(colour), radii=0.022))
            self._columns(
                f"{entity}/flown", t_ns[1:], rr.LineStrips3D.columns(strips=np.stack([p[:-1], p[1:]], axis=1))
            )

    def camera(self, recording: Recording, estimate: Trajectory) -> None:
        """Log the camera's model, and its pose: the true one where it is known, for the image is seen from there."""
        camera = recording.rig.cameras[0]
        body = recording.ground_truth or estimate
        if len(body):
            at_frames, _ = interpolate(body, recording.frame_times_ns)
            self._poses(Entities.CAMERA, at_frames.t_ns, at_frames.Ts_world_imu @ camera.T_imu_cam)
        self._poses(Entities.ESTIMATED_BODY, estimate.t_ns, estimate.Ts_world_imu)
        self._static(Entities.ESTIMATED_BODY, rr.TransformAxes3D(0.35))
        self._static(
            Entities.IMAGE,
            rr.Pinhole(  # a viewer knows no lens distortion: the image is shown as it came
                image_from_camera=camera.model.K,
                resolution=[camera.model.width, camera.model.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=IMAGE_PLANE_M,
                color=palette.rgb(palette.TRUTH if recording.ground_truth else palette.ESTIMATE),
                line_width=0.008,
            ),
        )

    def landmarks(self, run: EstimatorRun, alignment: Alignment) -> None:
        """Log the map points of each frame that has some; the view shows all of them, and those in sight brightly."""
        found = [
            (e.t_ns, alignment.positions(e.landmarks_world)) for e in run.estimates if e.landmarks_world is not None
        ]
        if not found:
            return
        t_ns = np.array([t for t, _ in found], dtype=np.int64)
        columns = rr.Points3D.columns(positions=np.concatenate([points for _, points in found]))
        for entity, colour, radius in (
            (Entities.MAP, [*palette.rgb(palette.MAP), 80], 0.8),
            (Entities.MAP_IN_SIGHT, palette.rgb(palette.MAP), 1.3),
        ):
            self._static(entity, rr.Points3D.from_fields(colors=colour, radii=rr.Radius.ui_points(radius)))
            self._columns(entity, t_ns, columns.partition([len(points) for _, points in found]))

    def tracks(self, run: EstimatorRun) -> None:
        """Log the features followed into each frame, coloured by age."""
        tracks = [tracks_of(estimate) for estimate in run.estimates]
        ages = np.concatenate([track.ages for track in tracks])
        columns = rr.Points2D.columns(
            positions=np.concatenate([track.pixels for track in tracks]) + 0.5,  # rerun's pixels are centred at .5
            colors=palette.age_colours(ages),
        ).partition([len(track.ids) for track in tracks])
        self._static(Entities.TRACKS, rr.Points2D.from_fields(radii=rr.Radius.ui_points(2.5)))
        self._columns(Entities.TRACKS, run.t_ns, columns)

    def events(self, run: EstimatorRun) -> None:
        """Log what the estimator says that happened, and its health whenever it changes."""
        rows = [(e.t_ns, text, "INFO") for e in run.estimates for text in e.events if text != "keyframe"]
        known = None
        for estimate in run.estimates:
            if estimate.health != known:
                known = estimate.health
                level = "INFO" if known in (Health.INITIALISING, Health.TRACKING) else "WARN"
                rows.append((estimate.t_ns, f"health: {known}", level))
        rows.sort(key=lambda row: row[0])
        self._columns(
            Entities.EVENTS,
            np.array([t for t, _, _ in rows], dtype=np.int64),
            rr.TextLog.columns(text=[text for _, text, _ in rows], level=[level for _, _, level in rows]),
        )

    def imu(self, recording: Recording) -> None:
        """Log what the gyroscope [rad/s] and the accelerometer [m/s²] read."""
        imu = recording.imu
        for entity, values in ((Entities.GYRO, imu.gyro_rad_s), (Entities.ACCEL, imu.accel_m_s2)):
            self._series(entity, imu.t_ns, values, names="xyz", colours=palette.AXES)

    def states(self, truth: Trajectory | None, estimate: Trajectory) -> None:
        """Log speed [m/s] and biases; what is true in pale colours."""
        for who, trajectory, speed_colour, bias_colours in (
            ("true", truth, palette.TRUTH, palette.AXES_PALE),
            ("estimated", estimate, palette.ESTIMATE, palette.AXES),
        ):
            if trajectory is None:
                continue
            if (velocity := trajectory.velocity_m_s) is not None:
                speed = np.linalg.norm(velocity, axis=1)[:, None]
                self._series(f"{Entities.SPEED}/{who}", trajectory.t_ns, speed, names=(who,), colours=(speed_colour,))
            for entity, bias in (
                (Entities.GYRO_BIAS, trajectory.gyro_bias_rad_s),
                (Entities.ACCEL_BIAS, trajectory.accel_bias_m_s2),
            ):
                if bias is not None:
                    names = [f"{axis} {who}" for axis in "xyz"]
                    self._series(f"{entity}/{who}", trajectory.t_ns, bias, names=names, colours=bias_colours)

    def costs(self, run: EstimatorRun) -> None:
        """Log what each frame cost [ms] and how many features it kept."""
        cost, count = run.cpu_ms[:, None], run.n_tracks[:, None].astype(np.float64)
        self._series(Entities.COST, run.t_ns, cost, names=("CPU",), colours=(palette.BAND,))
        self._series(Entities.TRACK_COUNT, run.t_ns, count, names=("tracks",), colours=(palette.ESTIMATE,))

    def errors(self, scored: ScoredTrajectory) -> None:
        """Log the errors after alignment, and those that 3σ speaks of: tied to the truth at the first pose."""
        t_ns = scored.truth.t_ns
        for entity, error, unit in (
            (Entities.POSITION_ERROR, scored.translation_error_m, 1.0),
            (Entities.ORIENTATION_ERROR, scored.rotation_error_rad, DEGREES),
        ):
            self._series(f"{entity}/aligned", t_ns, error[:, None] * unit, names=("aligned",), colours=(palette.ROOM,))
        if (stated := scored.consistency) is None:
            return
        for entity, error, sigma, unit in (
            (Entities.POSITION_ERROR, stated.position_error_m, stated.position_sigma_m, 1.0),
            (Entities.ORIENTATION_ERROR, stated.orientation_error_rad, stated.orientation_sigma_rad, DEGREES),
        ):
            size, band = (np.linalg.norm(v, axis=1)[:, None] * unit for v in (error, 3.0 * sigma))
            self._series(
                f"{entity}/tied", stated.t_ns, size, names=("tied at first pose",), colours=(palette.ESTIMATE,)
            )
            self._series(f"{entity}/three_sigma", stated.t_ns, band, names=("3σ claimed",), colours=(palette.BAND,))

    def video(self, recording: Recording, settings: VideoSettings, progress: Progress) -> None:
        """Encode and log every frame of the main camera, a keyframe interval at a time."""
        t_ns = recording.frame_times_ns
        self._static(Entities.IMAGE, rr.VideoStream(codec=rr.VideoCodec.AV1))
        images = (recording.frame(index).images[0] for index in range(len(t_ns)))
        done = 0
        for group in _groups(encode_av1(images, recording.rig.cameras[0].rate_hz, settings)):
            columns = rr.VideoStream.columns(
                sample=[sample.data for sample in group], is_keyframe=[sample.is_keyframe for sample in group]
            )
            self._columns(Entities.IMAGE, t_ns[done : done + len(group)], columns)
            done += len(group)
            progress(done, len(t_ns))

    def _static(self, entity: str, archetype: rr.AsComponents) -> None:
        self._stream.log(entity, archetype, static=True, strict=True)

    def _columns(self, entity: str, t_ns: Times, columns: rr.ComponentColumnList) -> None:
        times = rr.TimeColumn(TIMELINE, duration=(t_ns - self._origin_ns).astype("timedelta64[ns]"))
        self._stream.send_columns(entity, [times], columns, strict=True)

    def _poses(self, entity: str, t_ns: Times, Ts: Array) -> None:
        quat_xyzw = quat_xyzw_from_wxyz(quat_wxyz_from_matrix(Ts[:, :3, :3]))
        self._columns(entity, t_ns, rr.Transform3D.columns(translation=Ts[:, :3, 3], quaternion=quat_xyzw))

    def _series(self, entity: str, t_ns: Times, values: Array, *, names: Sequence[str], colours: Sequence[str]) -> None:
        """Log the columns of values (N, C) as the lines of a plot."""
        self._static(entity, rr.SeriesLines(names=list(names), colors=[palette.rgb(colour) for colour in colours]))
        self._columns(entity, t_ns, rr.Scalars.columns(scalars=values))


@contextmanager
def _recording_stream(path: Path, name: str, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """Open a rerun file; closing it writes the index that tools jump about with."""
    stream = rr.RecordingStream(APPLICATION)
    stream.save(path)
    stream.send_blueprint(blueprint)  # active, not only default: a viewer keeps the layout of the last flight otherwise
    stream.send_recording_name(name)
    try:
        yield stream
    finally:
        stream.disconnect()


def _groups(samples: Iterator[VideoSample]) -> Iterator[list[VideoSample]]:
    """Gather samples into groups that each start with a keyframe."""
    group: list[VideoSample] = []
    for sample in samples:
        if sample.is_keyframe and group:
            yield group
            group = []
        group.append(sample)
    if group:
        yield group


def _first_ns(recording: Recording) -> int:
    """Return the time stamp of the first measurement [ns]."""
    return min(int(recording.frame_times_ns[0]), *(int(t) for t in recording.imu.t_ns[:1]))
