"""What an estimator says, in a recording: its path, its doubts, what it follows, and what happened to it.

All of it may come at once or a piece at a time, while the estimator runs: each call takes the next piece.
"""

import re
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import rerun as rr

from dronevio.eval import colours
from dronevio.eval.metrics import (
    IDENTITY,
    Alignment,
    ScoredTrajectory,
    align,
    interpolate,
    rotation_errors_rad,
    translation_errors_m,
)
from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.rerun.sink import Sink, quat_xyzw
from dronevio.eval.run import POSE_IS_VALID, tracks_of
from dronevio.models.imu import Times
from dronevio.models.state import Estimate, Health, Trajectory

Array = npt.NDArray[np.float64]

Gauge = Callable[[Trajectory], Alignment]
"""Lays an estimate into the world that is shown; it is asked once, with the first poses."""

KEYFRAME = "keyframe"
"""The event of an estimate that a later one may refer to."""
_LOOP = re.compile(r"loop closed(?: with (\d+))?")
"""The event of a place that was known again, with the time stamp [ns] at which it had been seen."""
WHOLE_RADIUS, FLOWN_RADIUS = rr.Radius.ui_points(0.8), rr.Radius.ui_points(1.8)
"""How thick paths are on the screen, whatever the size of the world."""
_SIGMAS = 3.0
_DEGREES = 180.0 / np.pi
_GOOD = (Health.INITIALIZING, Health.TRACKING)
_HEALTH_COLOURS = {
    Health.INITIALIZING: colours.SURROUNDINGS,
    Health.TRACKING: colours.TRUTH,
    Health.INERTIAL_ONLY: colours.LANDMARKS,
    Health.LOST: colours.ESTIMATE,
}


def tied_to(truth: Trajectory | None) -> Gauge:
    """Return the gauge that makes the first pose meet the truth in yaw and position: known before the flight ends."""

    def gauge(first_poses: Trajectory) -> Alignment:
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

    return gauge


class EstimateLog:
    """Logs one estimator."""

    def __init__(
        self, sink: Sink, name: str, colour: str, gauge: Gauge, *, alone: bool = True, axis_m: float = 0.35
    ) -> None:
        """Say how the estimator is drawn.

        Args:
            sink: Where to log.
            name: What it is called.
            colour: Its path and its curves.
            gauge: Lays its world into the one that is shown.
            alone: No other is in the recording: its curves are called by what they show, not by its name.
            axis_m: Length of the axes that stand for the IMU [m].
        """
        self._sink = sink
        self._at = EstimateEntities(name)
        self._name = name
        self._colour = colour
        self._gauge = gauge
        self._alone = alone
        self._alignment: Alignment | None = None
        self._last_p: Array = np.zeros((0, 3))
        self._known: Health | None = None
        self._t_ns: list[Times] = []
        self._p: list[Array] = []
        self._errors_are_drawn = False
        self._draw(axis_m)

    def _draw(self, axis_m: float) -> None:
        """Log how everything looks."""
        name, alone = self._name, self._alone
        static, at, rgb = self._sink.static, self._at, colours.rgb(self._colour)
        static(at.flown, rr.LineStrips3D.from_fields(colors=rgb, radii=FLOWN_RADIUS))
        static(at.body, rr.TransformAxes3D(axis_m))
        static(at.covariance, rr.Ellipsoids3D.from_fields(colors=rgb, line_radii=rr.Radius.ui_points(0.6)))
        static(at.keyframes, rr.Points3D.from_fields(colors=rgb, radii=rr.Radius.ui_points(2.5)))
        static(
            at.loops, rr.LineStrips3D.from_fields(colors=colours.rgb(colours.LANDMARKS), radii=rr.Radius.ui_points(1.2))
        )
        static(at.markers, rr.Points3D.from_fields(colors=[255, 255, 255], radii=rr.Radius.ui_points(5.0)))
        static(at.tracks, rr.Points2D.from_fields(radii=rr.Radius.ui_points(2.5)))
        for entity, opacity, radius in ((at.map, 80, 0.8), (at.map_in_sight, 255, 1.3)):
            colour = colours.rgb(colours.LANDMARKS if alone else self._colour)
            static(entity, rr.Points3D.from_fields(colors=[*colour, opacity], radii=rr.Radius.ui_points(radius)))
        names, shades = [str(health) for health in Health], [colours.rgb(_HEALTH_COLOURS[h]) for h in Health]
        static(at.health, rr.StateConfiguration(values=names, labels=names, colors=shades))
        for entity, label in ((at.speed, "estimated"), (at.cost, "CPU"), (at.track_count, "tracks")):
            self._sink.lines(entity, [label if alone else name], [self._colour])
        for entity in (at.gyro_bias, at.accel_bias):
            self._sink.lines(entity, [f"{axis} {'estimated' if alone else name}" for axis in "xyz"], colours.AXES)

    def whole(self, trajectory: Trajectory) -> None:
        """Log the whole path (N poses), faintly, where it is known beforehand."""
        if len(trajectory) > 1:
            p = self._into_view(trajectory).p_world_imu.astype(np.float32)
            colour = [*colours.rgb(self._colour), 150]
            self._sink.static(self._at.whole, rr.LineStrips3D([p], colors=colour, radii=WHOLE_RADIUS))

    def poses(self, trajectory: Trajectory) -> Trajectory:
        """Log the next N poses, and what comes with them: covariances, velocities, biases; return them as shown."""
        if len(trajectory) == 0:
            return trajectory
        shown, t_ns, at = self._into_view(trajectory), trajectory.t_ns, self._at
        Ts = shown.Ts_world_imu
        path = np.concatenate([self._last_p, shown.p_world_imu])
        self._last_p = path[-1:]
        self._t_ns.append(t_ns)
        self._p.append(shown.p_world_imu)
        if len(path) > 1:
            self._sink.segments(at.flown, t_ns[1 - len(path) :], path[:-1], path[1:])
        self._sink.poses(at.body, t_ns, Ts)
        if shown.covariance is not None:
            half_m, R = ellipsoids(shown.covariance[:, 3:6, 3:6])
            columns = rr.Ellipsoids3D.columns(
                centers=shown.p_world_imu, half_sizes=_SIGMAS * half_m, quaternions=quat_xyzw(R)
            )
            self._sink.columns(at.covariance, t_ns, columns)
        if shown.velocity_m_s is not None:
            self._sink.values(at.speed, t_ns, np.linalg.norm(shown.velocity_m_s, axis=1))
        for entity, bias in ((at.gyro_bias, shown.gyro_bias_rad_s), (at.accel_bias, shown.accel_bias_m_s2)):
            if bias is not None:
                self._sink.values(entity, t_ns, bias)
        return shown

    def answers(self, estimates: Sequence[Estimate], cpu_ms: Array) -> Trajectory:
        """Log the next M answers of an estimator that runs in our hands, and their cost (M,) [ms].

        Returns:
            The poses among them, as shown.
        """
        valid = (e.state for e in estimates if e.health in POSE_IS_VALID and e.state is not None)
        shown = self.poses(Trajectory.from_states(valid))
        if not estimates:
            return shown
        t_ns = np.array([e.t_ns for e in estimates], dtype=np.int64)
        self._tracks(estimates, t_ns)
        self._map([e for e in estimates if e.landmarks_world is not None])
        self._events(estimates)
        self._sink.values(self._at.cost, t_ns, cpu_ms)
        self._sink.values(self._at.track_count, t_ns, np.array([float(len(tracks_of(e).ids)) for e in estimates]))
        return shown

    def errors(self, scored: ScoredTrajectory) -> None:
        """Log the errors after alignment, and those that 3σ speaks of: tied to the truth at the first pose."""
        self._draw_errors()
        for entity, error, unit in (
            (self._at.position_error, scored.translation_error_m, 1.0),
            (self._at.orientation_error, scored.rotation_error_rad, _DEGREES),
        ):
            self._sink.values(entity.aligned, scored.truth.t_ns, error * unit)
        if (stated := scored.consistency) is None:
            return
        for entity, errors, sigmas, unit in (
            (self._at.position_error, stated.position_error_m, stated.position_sigma_m, 1.0),
            (self._at.orientation_error, stated.orientation_error_rad, stated.orientation_sigma_rad, _DEGREES),
        ):
            self._sink.values(entity.tied, stated.t_ns, np.linalg.norm(errors, axis=1) * unit)
            self._sink.values(entity.band, stated.t_ns, np.linalg.norm(_SIGMAS * sigmas, axis=1) * unit)

    def errors_so_far(self, truth: Trajectory, shown: Trajectory) -> None:
        """Log the errors of N poses, as they are shown: tied to the truth at the first pose of all."""
        self._draw_errors()
        true, rows = interpolate(truth, shown.t_ns)
        distance_m = translation_errors_m(true.p_world_imu, shown.p_world_imu[rows])
        angle_deg = rotation_errors_rad(true.quat_wxyz, shown.quat_wxyz[rows]) * _DEGREES
        self._sink.values(self._at.position_error.tied, true.t_ns, distance_m)
        self._sink.values(self._at.orientation_error.tied, true.t_ns, angle_deg)

    def _draw_errors(self) -> None:
        """Log how errors look, where there are some."""
        if self._errors_are_drawn:
            return
        self._errors_are_drawn = True
        at, name, alone = self._at, self._name, self._alone
        for error in (at.position_error, at.orientation_error):
            self._sink.lines(
                error.aligned, ["aligned" if alone else name], [colours.SURROUNDINGS if alone else self._colour]
            )
            self._sink.lines(error.tied, ["tied at first pose" if alone else f"{name}, tied"], [self._colour])
            self._sink.lines(error.band, ["3σ claimed" if alone else f"{name}, 3σ claimed"], [colours.SIGMA])

    def _into_view(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory in the world that is shown."""
        if self._alignment is None:
            self._alignment = self._gauge(trajectory)
        return self._alignment.apply(trajectory)

    def _tracks(self, estimates: Sequence[Estimate], t_ns: Times) -> None:
        """Log the features followed into each frame, coloured by age."""
        tracks = [tracks_of(estimate) for estimate in estimates]
        columns = rr.Points2D.columns(
            positions=np.concatenate([track.pixels for track in tracks]) + 0.5,  # rerun's pixels are centred at .5
            colors=colours.age_colours(np.concatenate([track.ages for track in tracks])),
        ).partition([len(track.ids) for track in tracks])
        self._sink.columns(self._at.tracks, t_ns, columns)

    def _map(self, estimates: Sequence[Estimate]) -> None:
        """Log the map points of each estimate, which has some; the view shows all, and those in sight brightly."""
        if not estimates or self._alignment is None:
            return
        points = [self._alignment.positions(e.landmarks_world) for e in estimates if e.landmarks_world is not None]
        t_ns = np.array([e.t_ns for e in estimates], dtype=np.int64)
        columns = rr.Points3D.columns(positions=np.concatenate(points)).partition([len(p) for p in points])
        for entity in (self._at.map, self._at.map_in_sight):
            self._sink.columns(entity, t_ns, columns)

    def _events(self, estimates: Sequence[Estimate]) -> None:
        """Log what the estimator says that happened, and its health whenever it changes, where it was at the time."""
        rows: list[tuple[int, str, str]] = []
        health: list[tuple[int, str]] = []
        keyframes: list[int] = []
        for estimate in estimates:
            keyframes += [estimate.t_ns] * (KEYFRAME in estimate.events)
            rows += [(estimate.t_ns, text, "INFO") for text in estimate.events if text != KEYFRAME]
            if estimate.health != self._known:
                self._known = estimate.health
                level = "INFO" if self._known in _GOOD else "WARN"
                rows.append((estimate.t_ns, f"health: {self._known}", level))
                health.append((estimate.t_ns, str(self._known)))
        t_ns = np.array([t for t, _, _ in rows], dtype=np.int64)
        texts = [text for _, text, _ in rows]
        log = rr.TextLog.columns(text=texts, level=[level for _, _, level in rows])
        self._sink.columns(self._at.events, t_ns, log)
        changes = rr.StateChange.columns(state=[name for _, name in health])
        self._sink.columns(self._at.health, np.array([t for t, _ in health], dtype=np.int64), changes)
        self._mark(self._at.keyframes, np.array(keyframes, dtype=np.int64), None)
        self._mark(self._at.markers, *_together(t_ns, texts))
        self._loops(t_ns, texts)

    def _mark(self, entity: str, t_ns: Times, labels: Sequence[str] | None) -> None:
        """Log points, perhaps with labels, at the places where the estimator was at times (N,); none before it knew."""
        known = [i for i, t in enumerate(t_ns) if self._p and t >= self._t_ns[0][0]]
        if known:
            places = self._places(t_ns[known])
            words = None if labels is None else [labels[i] for i in known]
            self._sink.columns(entity, t_ns[known], rr.Points3D.columns(positions=places, labels=words))

    def _loops(self, t_ns: Times, texts: Sequence[str]) -> None:
        """Log a line from each place that was known again to where it had been seen."""
        found = [(i, match) for i, text in enumerate(texts) if (match := _LOOP.fullmatch(text)) and match[1]]
        if found and self._p:
            now = t_ns[[i for i, _ in found]]
            then = np.array([int(match[1]) for _, match in found], dtype=np.int64)
            self._sink.segments(self._at.loops, now, self._places(now), self._places(then))

    def _places(self, t_ns: Times) -> Array:
        """Return where (N, 3) the estimator was at times (N,): at the last pose up to then."""
        rows = np.searchsorted(np.concatenate(self._t_ns), t_ns, side="right") - 1
        return np.concatenate(self._p)[np.maximum(rows, 0)]


def _together(t_ns: Times, texts: Sequence[str]) -> tuple[Times, list[str]]:
    """Return times (N,) that all differ, and what was said at each of them."""
    instants, first = np.unique(t_ns, return_index=True)
    ends = [*first, len(texts)][1:]
    return instants, [", ".join(texts[start:end]) for start, end in zip(first, ends, strict=True)]


def ellipsoids(covariances: Array) -> tuple[Array, Array]:
    """Return the half axes (N, 3) at one σ and the rotations (N, 3, 3) of the ellipsoids of covariances (N, 3, 3)."""
    variances, axes = np.linalg.eigh(covariances)
    axes[..., 2] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a mirror
    return np.sqrt(np.maximum(variances, 0.0)), axes
