"""The estimates of one estimator in a recording: path, uncertainty, tracks, landmarks, health and events.

Estimates can be logged all at once or, while the estimator runs, in pieces: each call logs the next piece.
"""

from collections.abc import Callable, Sequence

import numpy as np
import rerun as rr

from dronevio.eval import colours
from dronevio.eval.map_results import MapResults, online_correction
from dronevio.eval.metrics import (
    IDENTITY,
    Alignment,
    ScoredTrajectory,
    align,
    interpolate,
    rotation_errors_rad,
    translation_errors_m,
)
from dronevio.eval.rerun.drone_body import DroneBody
from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.rerun.events import EventLog
from dronevio.eval.rerun.map import MapLog
from dronevio.eval.rerun.sink import Sink, quat_xyzw
from dronevio.eval.run import POSE_IS_VALID, map_trajectory_of, tracks_of
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.state import Estimate, Health, Trajectory

AlignmentRule = Callable[[Trajectory], Alignment]
"""Returns the alignment of an estimate with the displayed world frame, given the first poses; it is called once."""

PATH_RADIUS, PATH_SO_FAR_RADIUS = rr.Radius.ui_points(0.8), rr.Radius.ui_points(1.8)
"""Radii of whole paths, and of paths up to the time cursor, in points of the screen."""
_SIGMAS = 3.0
_DEGREES = 180.0 / np.pi
_HEALTH_COLOURS = {
    Health.INITIALIZING: colours.SURROUNDINGS,
    Health.TRACKING: colours.TRUTH,
    Health.INERTIAL_ONLY: colours.LANDMARKS,
    Health.LOST: colours.ESTIMATE,
}


def anchored_to(truth: Trajectory | None) -> AlignmentRule:
    """Return the rule that aligns yaw and position of the first pose with the truth; identity without truth."""

    def rule(first_poses: Trajectory) -> Alignment:
        if truth is None:
            return IDENTITY
        true, rows = interpolate(truth, first_poses.t_ns)
        if len(rows) == 0:
            return IDENTITY
        first = first_poses[rows]
        return align(
            true.p_world_imu,
            first.p_world_imu,
            "yaw",
            n=1,
            quat_truth_wxyz=true.quat_wxyz,
            quat_estimate_wxyz=first.quat_wxyz,
        )

    return rule


class EstimateLog:
    """Logs the estimates of one estimator."""

    def __init__(
        self,
        sink: Sink,
        name: str,
        colour: str,
        rule: AlignmentRule,
        *,
        is_single: bool = True,
        axis_m: float = 0.35,
        body: DroneBody | None = None,
        map_alignment: Alignment | None = None,
    ) -> None:
        """Log how the estimates are drawn.

        Args:
            sink: Output of the rows.
            name: Name of the estimator.
            colour: Colour of its path and curves.
            rule: Determines the alignment with the displayed world frame.
            is_single: Whether it is the only estimator of the recording, so that curves need not bear its name.
            axis_m: Length of the axes of the IMU frame [m].
            body: Body of the drone, whose edges are drawn at the estimated pose; None to draw the axes only.
            map_alignment: Alignment of the online path of the map with the displayed world frame; that of the estimate
                if it is None.
        """
        self._sink = sink
        self._entities = EstimateEntities(name)
        self._name = name
        self._colour = colour
        self._rule = rule
        self._is_single = is_single
        self._alignment: Alignment | None = None
        self._map_alignment = map_alignment
        self._map: MapLog | None = None
        self._last_p: Array = np.zeros((0, 3))
        self._events = EventLog(sink, self._entities)
        self._error_styles_are_logged = False
        self._closed_loops = 0
        self._log_styles(axis_m)
        if body is not None:
            lines = rr.LineStrips3D(body.edges, colors=colours.rgb(colour), radii=rr.Radius.ui_points(1.2))
            sink.static(self._entities.body, lines)

    def _log_styles(self, axis_m: float) -> None:
        """Log colours and sizes of all entities."""
        static, entities, rgb = self._sink.static, self._entities, colours.rgb(self._colour)
        loop_rgb = colours.rgb(colours.LOOP)
        static(entities.path_so_far, rr.LineStrips3D.from_fields(colors=rgb, radii=PATH_SO_FAR_RADIUS))
        static(entities.imu, rr.TransformAxes3D(axis_m))
        static(entities.covariance, rr.Ellipsoids3D.from_fields(colors=rgb, line_radii=rr.Radius.ui_points(0.6)))
        static(entities.keyframes, rr.Points3D.from_fields(colors=rgb, radii=rr.Radius.ui_points(2.5)))
        static(entities.loops, rr.LineStrips3D.from_fields(colors=loop_rgb, radii=rr.Radius.ui_points(1.2)))
        static(entities.event_markers, rr.Points3D.from_fields(colors=[255, 255, 255], radii=rr.Radius.ui_points(5.0)))
        static(entities.tracks, rr.Points2D.from_fields(radii=rr.Radius.ui_points(2.5)))
        for entity, brightness, radius in ((entities.landmarks, 0.75, 0.8), (entities.visible_landmarks, 1.0, 1.3)):
            colour = [
                round(brightness * v) for v in colours.rgb(colours.LANDMARKS if self._is_single else self._colour)
            ]
            static(entity, rr.Points3D.from_fields(colors=colour, radii=rr.Radius.ui_points(radius)))
        names, shades = [str(health) for health in Health], [colours.rgb(_HEALTH_COLOURS[h]) for h in Health]
        static(entities.health, rr.StateConfiguration(values=names, labels=names, colors=shades))
        for entity, label in (
            (entities.speed, "estimated"),
            (entities.cost, "processor time"),
            (entities.track_count, "tracks"),
        ):
            self._sink.curve_styles(entity, [label if self._is_single else self._name], [self._colour])
        for entity in (entities.gyro_bias, entities.accel_bias):
            label = "estimated" if self._is_single else self._name
            self._sink.curve_styles(entity, [f"{axis} {label}" for axis in "xyz"], colours.AXES)

    def path(self, trajectory: Trajectory) -> None:
        """Log the whole path (N poses), which is drawn pale; it must be known beforehand."""
        if len(trajectory) > 1:
            p = self._aligned(trajectory).p_world_imu.astype(np.float32)
            colour = [*colours.rgb(self._colour), 150]
            self._sink.static(self._entities.path, rr.LineStrips3D([p], colors=colour, radii=PATH_RADIUS))

    def poses(self, trajectory: Trajectory) -> Trajectory:
        """Log the next N poses with their covariances, velocities and biases, and return them aligned."""
        if len(trajectory) == 0:
            return trajectory
        aligned, t_ns, entities = self._aligned(trajectory), trajectory.t_ns, self._entities
        Ts = aligned.Ts_world_imu
        path = np.concatenate([self._last_p, aligned.p_world_imu])
        self._last_p = path[-1:]
        self._events.add_positions(t_ns, aligned.p_world_imu)
        if len(path) > 1:
            self._sink.segments(entities.path_so_far, t_ns[1 - len(path) :], path[:-1], path[1:])
        self._sink.poses(entities.imu, t_ns, Ts)
        if aligned.covariance is not None:
            half_axes_m, R = ellipsoids(aligned.covariance[:, 3:6, 3:6])
            columns = rr.Ellipsoids3D.columns(
                centers=aligned.p_world_imu, half_sizes=_SIGMAS * half_axes_m, quaternions=quat_xyzw(R)
            )
            self._sink.columns(entities.covariance, t_ns, columns)
        if aligned.velocity_m_s is not None:
            self._sink.values(entities.speed, t_ns, np.linalg.norm(aligned.velocity_m_s, axis=1))
        for entity, bias in (
            (entities.gyro_bias, aligned.gyro_bias_rad_s),
            (entities.accel_bias, aligned.accel_bias_m_s2),
        ):
            if bias is not None:
                self._sink.values(entity, t_ns, bias)
        return aligned

    def estimates(self, estimates: Sequence[Estimate], cpu_ms: Array) -> Trajectory:
        """Log the next M estimates and their processor times (M,) [ms].

        Returns:
            The valid poses among them, aligned.
        """
        valid = (e.state for e in estimates if e.health in POSE_IS_VALID and e.state is not None)
        aligned = self.poses(Trajectory.from_states(valid))
        if not estimates:
            return aligned
        t_ns = np.array([e.t_ns for e in estimates], dtype=np.int64)
        self._log_tracks(estimates, t_ns)
        self._log_landmarks([e for e in estimates if e.landmarks_odom is not None])
        self._events.log(estimates)
        self._log_map(estimates)
        self._sink.values(self._entities.cost, t_ns, cpu_ms)
        counts = np.array([float(len(tracks_of(e).ids)) for e in estimates])
        self._sink.values(self._entities.track_count, t_ns, counts)
        return aligned

    def _log_map(self, estimates: Sequence[Estimate]) -> None:
        """Log the corrected path and the correction of estimates that have one."""
        correction = online_correction(estimates, self._closed_loops)
        if not len(correction.t_ns) or self._alignment is None:
            return
        if self._map is None:
            self._map = MapLog(self._sink, self._entities.map)
        self._closed_loops = int(correction.loops[-1])
        self._map.online((self._map_alignment or self._alignment).apply(map_trajectory_of(estimates)), correction)

    def final_map(self, results: MapResults) -> None:
        """Log the map after the flight; the estimates must be logged before."""
        if self._map is not None and self._alignment is not None:
            self._map.final(results, self._alignment)

    def errors(self, scored: ScoredTrajectory) -> None:
        """Log the errors after alignment, and those anchored at the first pose with three standard deviations."""
        self._log_error_styles()
        for entity, error, unit in (
            (self._entities.position_error, scored.translation_error_m, 1.0),
            (self._entities.orientation_error, scored.rotation_error_rad, _DEGREES),
        ):
            self._sink.values(entity.aligned, scored.truth.t_ns, error * unit)
        if (anchored := scored.consistency) is None:
            return
        for entity, errors, sigmas, unit in (
            (self._entities.position_error, anchored.position_error_m, anchored.position_sigma_m, 1.0),
            (
                self._entities.orientation_error,
                anchored.orientation_error_rad,
                anchored.orientation_sigma_rad,
                _DEGREES,
            ),
        ):
            self._sink.values(entity.anchored, anchored.t_ns, np.linalg.norm(errors, axis=1) * unit)
            self._sink.values(entity.three_sigma, anchored.t_ns, np.linalg.norm(_SIGMAS * sigmas, axis=1) * unit)

    def anchored_errors(self, truth: Trajectory, aligned: Trajectory) -> None:
        """Log the errors of N aligned poses, which are anchored at the first pose of all."""
        self._log_error_styles()
        true, rows = interpolate(truth, aligned.t_ns)
        distance_m = translation_errors_m(true.p_world_imu, aligned.p_world_imu[rows])
        angle_deg = rotation_errors_rad(true.quat_wxyz, aligned.quat_wxyz[rows]) * _DEGREES
        self._sink.values(self._entities.position_error.anchored, true.t_ns, distance_m)
        self._sink.values(self._entities.orientation_error.anchored, true.t_ns, angle_deg)

    def _log_error_styles(self) -> None:
        """Log colours and names of the error curves before the first error."""
        if self._error_styles_are_logged:
            return
        self._error_styles_are_logged = True
        name, single, styles = self._name, self._is_single, self._sink.curve_styles
        for error in (self._entities.position_error, self._entities.orientation_error):
            colour = colours.SURROUNDINGS if single else self._colour
            styles(error.aligned, ["aligned" if single else name], [colour])
            styles(error.anchored, ["anchored at the first pose" if single else f"{name}, anchored"], [self._colour])
            styles(error.three_sigma, ["3σ, estimated" if single else f"{name}, 3σ"], [colours.SIGMA])

    def _aligned(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory in the displayed world frame."""
        if self._alignment is None:
            self._alignment = self._rule(trajectory)
        return self._alignment.apply(trajectory)

    def _log_tracks(self, estimates: Sequence[Estimate], t_ns: Times) -> None:
        """Log the features that are tracked into each frame, coloured by age."""
        tracks = [tracks_of(estimate) for estimate in estimates]
        columns = rr.Points2D.columns(
            positions=np.concatenate([track.pixels for track in tracks]) + 0.5,  # rerun's pixel centres are at .5
            colors=colours.age_colours(np.concatenate([track.ages for track in tracks])),
        ).partition([len(track.ids) for track in tracks])
        self._sink.columns(self._entities.tracks, t_ns, columns)

    def _log_landmarks(self, estimates: Sequence[Estimate]) -> None:
        """Log the landmarks of estimates that have some; the view shows all, and the present ones brightly."""
        if not estimates or self._alignment is None:
            return
        points = [self._alignment.positions(e.landmarks_odom) for e in estimates if e.landmarks_odom is not None]
        t_ns = np.array([e.t_ns for e in estimates], dtype=np.int64)
        columns = rr.Points3D.columns(positions=np.concatenate(points)).partition([len(p) for p in points])
        for entity in (self._entities.landmarks, self._entities.visible_landmarks):
            self._sink.columns(entity, t_ns, columns)


def ellipsoids(covariances: Array) -> tuple[Array, Array]:
    """Return half axes (N, 3) at 1σ and rotations (N, 3, 3) of the ellipsoids of covariances (N, 3, 3)."""
    variances, axes = np.linalg.eigh(covariances)
    axes[..., 2] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection
    return np.sqrt(np.maximum(variances, 0.0)), axes
