"""A flight in a recording: measurements, surroundings and ground truth.

`RerunLog` writes to a file or a viewer (`dronevio.eval.rerun.sink`), all at once or in pieces during the flight.
`dronevio.eval.rerun.files` writes files, `dronevio.eval.rerun.live` sends to a viewer.
"""

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

import numpy as np
import rerun as rr

from dronevio.eval import colours
from dronevio.eval.metrics import Alignment, interpolate
from dronevio.eval.rerun import entities
from dronevio.eval.rerun.drone_body import SPAN_M, DroneBody
from dronevio.eval.rerun.estimate import PATH_RADIUS, PATH_SO_FAR_RADIUS, AlignmentRule, EstimateLog
from dronevio.eval.rerun.images import ImageLog
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import Surroundings
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.scenery import TexturedMesh
from dronevio.models.state import CameraFrame, Trajectory

ImageLogFactory = Callable[[Sink, str, float], ImageLog]
"""Makes the log of a camera's images from sink, entity and frame rate [Hz]."""

_IMAGE_PLANE_SHARE = 0.06  # distance of an image in the 3D view from its camera, as a share of the scene's diagonal
_IMAGE_PLANE_LIMITS_M = (0.1, 10.0)
_BODY_SHARE = 0.05  # smallest span of the drawn drone, as a share of the scene's diagonal
_AXIS_SHARE = 0.6  # length of the axes of the estimated IMU frame, as a share of that distance
_MAX_PATH_POINTS = 1500  # of a drawn path: the truth has 200 poses per second


class RerunLog:
    """Writes a flight to a sink; images that are not yet written are written when its context is left."""

    def __init__(self, sink: Sink, rig: Rig, make_image_log: ImageLogFactory, points: Array) -> None:
        """Log the rig.

        Args:
            sink: Output of the rows.
            rig: The sensors of the drone.
            make_image_log: Makes the log of each camera's images.
            points: (N, 3) Points that the 3D view shows [m], which determine the size of the drawn rig.
        """
        self._sink = sink
        diagonal_m = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
        self._image_plane_m = float(np.clip(_IMAGE_PLANE_SHARE * diagonal_m, *_IMAGE_PLANE_LIMITS_M))
        self._images = [make_image_log(sink, entities.image(i), camera.rate_hz) for i, camera in enumerate(rig.cameras)]
        sink.static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for entity, unit in ((entities.GYRO, "rad/s"), (entities.ACCEL, "m/s²")):
            sink.curve_styles(entity, [f"{axis} [{unit}]" for axis in "xyz"], colours.AXES)
        self._body = DroneBody.of(rig, max(SPAN_M, _BODY_SHARE * diagonal_m))
        self._log_cameras(rig)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for images in self._images:
            images.close()

    def surroundings(self, surroundings: Surroundings, times_ns: Times) -> None:
        """Log the surfaces of the surroundings or their outline, and moving objects at times (N,) [ns]."""
        log_surroundings(self._sink, surroundings, times_ns, entities.SURROUNDINGS, entities.MOVING_OBJECTS)

    def truth(self, truth: Trajectory, frame_times_ns: Times, colour: str = colours.TRUTH) -> None:
        """Log the true path, pale as a whole and bright up to the time cursor, with speed and biases.

        Args:
            truth: The true trajectory.
            frame_times_ns: (M,) Time stamps of the frames [ns], at which the true pose of the rig is shown.
            colour: Colour of the path, as ``#rrggbb``.
        """
        drawn = truth[:: max(1, len(truth) // _MAX_PATH_POINTS)]
        t_ns, p, rgb = drawn.t_ns, drawn.p_world_imu, colours.rgb(colour)
        if len(p) > 1:
            path = rr.LineStrips3D([p.astype(np.float32)], colors=[*rgb, 150], radii=PATH_RADIUS)
            style = rr.LineStrips3D.from_fields(colors=rgb, radii=PATH_SO_FAR_RADIUS)
            self._sink.static(entities.TRUE_PATH, path)
            self._sink.static(entities.TRUE_PATH_SO_FAR, style)
            self._sink.segments(entities.TRUE_PATH_SO_FAR, t_ns[1:], p[:-1], p[1:])
        self._log_body(entities.TRUE_BODY, colour)
        self.rig_poses(interpolate(truth, frame_times_ns)[0])
        if truth.velocity_m_s is not None:
            self._sink.curve_styles(f"{entities.SPEED}/true", ["true"], [colour])
            speed = np.linalg.norm(truth.velocity_m_s, axis=1)
            self._sink.values(f"{entities.SPEED}/true", truth.t_ns, speed)
        for entity, bias in (
            (entities.GYRO_BIAS, truth.gyro_bias_rad_s),
            (entities.ACCEL_BIAS, truth.accel_bias_m_s2),
        ):
            if bias is not None:
                self._sink.curve_styles(f"{entity}/true", [f"{axis} true" for axis in "xyz"], colours.AXES_PALE)
                self._sink.values(f"{entity}/true", truth.t_ns, bias)

    def rig_poses(self, trajectory: Trajectory) -> None:
        """Log the poses of the rig's IMU, to which its cameras are attached."""
        self._sink.poses(entities.RIG, trajectory.t_ns, trajectory.Ts_world_imu)

    def imu(self, samples: ImuSamples) -> None:
        """Log the readings of gyroscope [rad/s] and accelerometer [m/s²]."""
        self._sink.values(entities.GYRO, samples.t_ns, samples.gyro_rad_s)
        self._sink.values(entities.ACCEL, samples.t_ns, samples.accel_m_s2)

    def frame(self, frame: CameraFrame) -> None:
        """Log the images of the cameras that have one."""
        for images, image in zip(self._images, frame.images, strict=True):
            if image.size:
                images.add(frame.t_ns, image)

    def estimator(
        self,
        name: str,
        colour: str,
        rule: AlignmentRule,
        is_single: bool = True,
        map_alignment: Alignment | None = None,
    ) -> EstimateLog:
        """Return the log of an estimator; see `EstimateLog`."""
        return EstimateLog(
            self._sink,
            name,
            colour,
            rule,
            is_single=is_single,
            axis_m=_AXIS_SHARE * self._image_plane_m,
            body=self._body,
            map_alignment=map_alignment,
        )

    def summary(self, markdown: str) -> None:
        """Log a text about the whole recording."""
        self._sink.static(entities.SUMMARY, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def _log_body(self, entity: str, colour: str) -> None:
        """Log the solid body of the drone."""
        corners = self._body.triangles.reshape(-1, 3).astype(np.float32)
        rgb = self._body.colours(colours.rgb(colour))
        self._sink.static(entity, rr.Mesh3D(vertex_positions=corners, vertex_colors=rgb))

    def _log_cameras(self, rig: Rig) -> None:
        """Log poses and camera matrices of the cameras; the viewer does not undistort images."""
        for index, camera in enumerate(rig.cameras):
            T = camera.T_imu_cam
            self._sink.static(entities.camera(index), rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            self._sink.static(
                entities.image(index),
                rr.Pinhole(
                    image_from_camera=camera.model.K,
                    resolution=[camera.model.width, camera.model.height],
                    camera_xyz=rr.ViewCoordinates.RDF,
                    image_plane_distance=self._image_plane_m,
                    color=colours.rgb(colours.TRUTH),
                    line_width=-0.8,  # in points of the screen, because it is negative
                ),
            )


def log_surroundings(sink: Sink, surroundings: Surroundings, times_ns: Times, fixed: str, moving: str) -> None:
    """Log the surfaces of surroundings or their outline, and moving objects.

    Args:
        sink: Output of the rows.
        surroundings: The surroundings.
        times_ns: (N,) Times at which moving objects are shown [ns].
        fixed: Path of what does not move.
        moving: Path above those of moving objects.
    """
    _log_meshes(sink, fixed, surroundings.meshes)
    if len(surroundings.outline) and not surroundings.meshes:
        colour = [*colours.rgb(colours.SURROUNDINGS), 150]
        strips = surroundings.outline.astype(np.float32)
        sink.static(fixed, rr.LineStrips3D(strips, colors=colour, radii=rr.Radius.ui_points(0.5)))
    for box in surroundings.moving_boxes:
        entity = f"{moving}/{rr.escape_entity_path_part(box.name)}"
        _log_meshes(sink, entity, box.meshes)
        if not box.meshes:
            rgb = colours.rgb(colours.SURROUNDINGS)
            sink.static(entity, rr.Boxes3D(mins=[box.low], sizes=[box.high - box.low], colors=rgb))
        sink.poses(entity, times_ns, box.poses(np.asarray((times_ns - times_ns[:1]) * 1e-9)))


def _log_meshes(sink: Sink, entity: str, meshes: Sequence[TexturedMesh]) -> None:
    """Log textured surfaces, which are visible from their front, so that rooms are seen into from outside."""
    for index, mesh in enumerate(meshes):
        drawn = rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.triangles,
            vertex_texcoords=mesh.texture_coordinates,
            albedo_texture=mesh.texture,
            face_rendering="Front",
        )
        sink.static(f"{entity}/surface{index}", drawn)


def scene_points(surroundings: Surroundings, paths: Sequence[Trajectory]) -> Array:
    """Return points (N, 3) of the surroundings and around paths, which the 3D view must show [m]."""
    positions = np.concatenate([np.zeros((0, 3)), *(path.p_world_imu for path in paths)])
    if len(positions):
        margin_m = _IMAGE_PLANE_SHARE * np.linalg.norm(np.ptp(positions, axis=0))
        offsets = np.concatenate([np.eye(3), -np.eye(3)]) * margin_m
        sampled = positions[:: max(1, len(positions) // _MAX_PATH_POINTS), None]
        positions = (sampled + offsets).reshape(-1, 3)
    return np.concatenate([surroundings.outline.reshape(-1, 3), positions])


def first_time_ns(recording: Recording) -> int:
    """Return the time stamp of a recording's first measurement [ns]."""
    return min(int(recording.frame_times_ns[0]), *(int(t) for t in recording.imu.t_ns[:1]))
