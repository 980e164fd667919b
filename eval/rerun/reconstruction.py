"""Rerun files of reconstructions from images.

The 3D view shows the coloured points, and the frusta of the cameras with small images. The timeline counts the
registered images: at each, its camera is highlighted, the points that it observes are larger, and another view shows
the image with the observations and their residuals.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dronevio.eval import colours
from dronevio.eval.images import downscaled
from dronevio.eval.rerun import entities
from dronevio.eval.rerun.blueprint import BACKGROUND
from dronevio.eval.rerun.entities import ComponentEntities
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.scene import ResidualStyle, frustum_depth, reconstruction_view, upright_rotation
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import EvaluationError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.recordings.files import check_output_path
from dronevio.models.recordings.images import encode_jpeg

ReadImage = Callable[[str], Image | None]
"""Function that returns the image (H, W) or (H, W, 3) of a name, or None if there is none."""

THUMBNAIL_PX = 256
"""Length of the longer side of the images in the 3D view [px]."""
IMAGE_PX = 1280
"""Largest length of the longer side of the images in the image view [px]."""
_POINT_RADIUS = rr.Radius.ui_points(1.2)
_OBSERVED_RADIUS = rr.Radius.ui_points(2.6)
_KEYPOINT_RADIUS = rr.Radius.ui_points(2.5)
_RESIDUAL_RADIUS = rr.Radius.ui_points(0.8)
_NO_AXES = rr.TransformAxes3D(0.0)  # the viewer draws axes of every camera otherwise
_IMAGES_PER_S = 2.0  # speed of the playback


def write_reconstruction_rerun(
    reconstructions: Sequence[Reconstruction],
    path: Path,
    images: ReadImage | None = None,
    *,
    up: Array | None = None,
    name: str = "reconstruction",
) -> None:
    """Write a rerun file of a reconstruction.

    Args:
        reconstructions: The components, each with a world frame of its own.
        path: File to write, with the suffix ``.rrd``.
        images: Function that returns the image of a name; None to show the observations without images. It is called
            once for each image.
        up: (3,) Up direction in the world frames; None to estimate it from the cameras.
        name: Name of the recording in the viewer.

    Raises:
        EvaluationError: There is no component.
        InputError: The path is a folder, or one of its folders is a file; or an image cannot be read.
    """
    if not reconstructions:
        raise EvaluationError("a reconstruction without components; expected at least one registered image")
    check_output_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    style = ResidualStyle.of(reconstructions)
    blueprint = reconstruction_blueprint(reconstructions, style, up)
    with Sink.to_file(path, name, blueprint, origin_ns=0) as sink:
        sink.static(entities.KEYPOINTS, rr.Points2D.from_fields(radii=_KEYPOINT_RADIUS))
        sink.static(entities.RESIDUALS, rr.LineStrips2D.from_fields(radii=_RESIDUAL_RADIUS))
        first = 0
        for index, component in enumerate(reconstructions):
            _log_component(sink, ComponentEntities(index), component, images, first, style)
            first += len(component.image_names)


def reconstruction_blueprint(
    reconstructions: Sequence[Reconstruction], style: ResidualStyle, up: Array | None = None
) -> rrb.Blueprint:
    """Return the layout: the components on the left, the current image and its numbers on the right.

    Args:
        reconstructions: The components.
        style: How residuals are drawn.
        up: (3,) Up direction in the world frames; None to estimate it from the cameras.
    """
    worlds = [_world(index, component, up) for index, component in enumerate(reconstructions)]
    title = f"Observations: residual 0 (blue) to {style.limit_px:.2g} px (yellow), vectors × {style.factor:g}"
    return rrb.Blueprint(
        rrb.Horizontal(
            worlds[0] if len(worlds) == 1 else rrb.Tabs(*worlds, active_tab=0),
            rrb.Vertical(
                rrb.Spatial2DView(origin=entities.CURRENT_IMAGE, name=title, background=BACKGROUND),
                rrb.TextDocumentView(origin=entities.SUMMARY, name="Current image"),
                row_shares=[2.5, 1.0],
            ),
            column_shares=[1.6, 1.0],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=entities.IMAGE_TIMELINE, loop_mode="all", fps=_IMAGES_PER_S),
        auto_views=False,
        auto_layout=False,
    )


def _world(index: int, component: Reconstruction, up: Array | None) -> rrb.Spatial3DView:
    """Return the 3D view of a component, seen from behind its cameras."""
    controls = rrb.EyeControls3D()
    if len(component.points) or len(component.image_names):
        R_scene_world = upright_rotation(component, up)
        position, target = reconstruction_view(component, R_scene_world)
        controls = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=R_scene_world[2]
        )
    return rrb.Spatial3DView(
        origin=ComponentEntities(index).root,
        name=f"Component {index + 1}: {len(component.image_names)} images, {len(component.points)} points",
        eye_controls=controls,
        line_grid=False,
        background=BACKGROUND,
    )


def _log_component(
    sink: Sink,
    paths: ComponentEntities,
    component: Reconstruction,
    images: ReadImage | None,
    first: int,
    style: ResidualStyle,
) -> None:
    """Log the points and the images of a component, whose first image has a number on the timeline."""
    points = component.points.astype(np.float32)
    sink.static(paths.points, rr.Points3D(points, colors=component.colours, radii=_POINT_RADIUS))
    sink.static(paths.observed_points, rr.Points3D.from_fields(radii=_OBSERVED_RADIUS))
    sink.static(f"{paths.current_camera}/image", _NO_AXES)
    depth = frustum_depth(component)
    residuals = component.reprojection_residuals_px()
    for i, name in enumerate(component.image_names):
        T, model = component.Ts_world_cam[i], component.cameras[component.image_camera[i]]
        image = None if images is None else images(name)
        pose = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
        sink.static(paths.camera(name), pose)
        sink.static(f"{paths.camera(name)}/image", _NO_AXES)
        _log_thumbnail(sink, f"{paths.camera(name)}/image", model, image, depth)
        is_seen = component.observation_image == i
        row = _ImageRow(sink, first + i)
        row.log_camera(paths.current_camera, T, model, 1.02 * depth)  # in front of the image of the static one
        seen = component.observation_point[is_seen]
        larger = rr.Points3D.columns(positions=points[seen], colors=component.colours[seen])
        row.log(paths.observed_points, larger.partition([len(seen)]))
        row.log_image(image, model, component.observation_px[is_seen], residuals[is_seen], style)
        row.log_summary(name, residuals[is_seen])


def _log_thumbnail(sink: Sink, entity: str, model: CameraModel, image: Image | None, depth: float) -> None:
    """Log a camera matrix and a small image; the viewer does not undistort images."""
    if image is None:
        sink.static(entity, _pinhole(model, 1.0, depth, colours.ESTIMATE))
        return
    small = downscaled(image, THUMBNAIL_PX)
    sink.static(entity, _pinhole(model, small.shape[1] / model.width, depth, colours.ESTIMATE))
    sink.static(entity, rr.EncodedImage(contents=encode_jpeg(small, quality=70), media_type="image/jpeg"))


def _pinhole(model: CameraModel, scale: float, depth: float, colour: str) -> rr.Pinhole:
    """Return the frustum of a camera for images of another scale."""
    return rr.Pinhole(
        image_from_camera=_scaled_matrix(model, scale),
        resolution=[scale * model.width, scale * model.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=depth,
        color=colours.rgb(colour),
        line_width=-0.8,  # in points of the screen, because it is negative
    )


def _scaled_matrix(model: CameraModel, scale: float) -> Array:
    """Return the camera matrix (3, 3) for images of another scale; rerun's pixel centres are at .5."""
    K = model.K
    K[:2, 2] += 0.5
    K[:2] *= scale
    return K


class _ImageRow:
    """Logs what belongs to one image, at its number on the timeline."""

    def __init__(self, sink: Sink, index: int) -> None:
        self._sink = sink
        self._index = index

    def log(self, entity: str, columns: rr.ComponentColumnList) -> None:
        """Log a row of an entity."""
        self._sink.row(entity, entities.IMAGE_TIMELINE, self._index, columns)

    def log_camera(self, entity: str, T_world_cam: Array, model: CameraModel, depth: float) -> None:
        """Log the highlighted frustum of the camera."""
        self.log(entity, rr.Transform3D.columns(translation=[T_world_cam[:3, 3]], mat3x3=[T_world_cam[:3, :3]]))
        self.log(
            f"{entity}/image",
            rr.Pinhole.columns(
                image_from_camera=[_scaled_matrix(model, 1.0)],
                resolution=[[model.width, model.height]],
                camera_xyz=[rr.ViewCoordinates.RDF],
                image_plane_distance=[depth],
                color=[colours.rgb(colours.LANDMARKS)],
                line_width=[-2.0],
            ),
        )

    def log_image(
        self, image: Image | None, model: CameraModel, pixels: Array, residuals_px: Array, style: ResidualStyle
    ) -> None:
        """Log the image, if there is one, with its observations (M, 2) and their residuals (M, 2)."""
        scale = 1.0
        if image is None:
            self.log(entities.CURRENT_IMAGE, rr.Clear.columns(is_recursive=[False]))
        else:
            shown = downscaled(image, IMAGE_PX)
            scale = shown.shape[1] / model.width
            self.log(
                entities.CURRENT_IMAGE, rr.EncodedImage.columns(blob=[encode_jpeg(shown)], media_type=["image/jpeg"])
            )
        ends = pixels + style.factor * np.nan_to_num(residuals_px)
        rgb = colours.residual_colours(np.linalg.norm(residuals_px, axis=1), style.limit_px)
        start_end = (scale * (np.stack([pixels, ends], axis=1) + 0.5)).astype(np.float32)  # pixel centres at .5
        count = [len(pixels)]
        self.log(entities.KEYPOINTS, rr.Points2D.columns(positions=start_end[:, 0], colors=rgb).partition(count))
        self.log(entities.RESIDUALS, rr.LineStrips2D.columns(strips=start_end, colors=rgb).partition(count))

    def log_summary(self, name: str, residuals_px: Array) -> None:
        """Log the name of the image, the number of its observations and their median error as a text."""
        errors = np.linalg.norm(residuals_px, axis=1)
        errors = errors[np.isfinite(errors)]
        median = f"{np.median(errors):.2f} px" if len(errors) else "–"
        rows = [f"| image | {name} |", "|---|---:|", f"| observations | {len(residuals_px)} |"]
        rows += [f"| median reprojection error | {median} |"]
        columns = rr.TextDocument.columns(text=["\n".join(rows) + "\n"], media_type=[rr.MediaType.MARKDOWN])
        self.log(entities.SUMMARY, columns)
