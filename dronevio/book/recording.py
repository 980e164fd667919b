"""The reconstruction of the robotics book's photographs as a recording to walk around in."""

from pathlib import Path

import matplotlib.image
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dronevio.estimator.book.sfm import SfmExperiment

_POINT_RADIUS = 0.006
_PLANE_DISTANCE = 0.3  # how far in front of its camera a photograph hangs


def record_sfm(experiment: SfmExperiment, path: Path) -> None:
    """Write the points in their colours and the cameras with their photographs as ``path`` (.rrd)."""
    blueprint = rrb.Blueprint(rrb.Spatial3DView(origin="/", name="Villa Balbianello"), collapse_panels=True)
    with rr.RecordingStream("dronevio_book_sfm") as stream:
        stream.save(path, default_blueprint=blueprint)
        # Bundler's world is its first camera's frame in OpenGL's manner: y up, and the photographs were held upright.
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        stream.log(
            "points", rr.Points3D(experiment.points, colors=experiment.colours, radii=_POINT_RADIUS), static=True
        )
        for i, photograph in enumerate(experiment.photographs):
            _record_camera(stream, experiment, i, photograph)


def _record_camera(stream: rr.RecordingStream, experiment: SfmExperiment, index: int, photograph: Path) -> None:
    """Log one camera, its photograph and what was seen in it."""
    T, entity = experiment.Ts_world_cam[index], f"cameras/{index + 1}"
    height, width = _size(photograph)
    focal_px = float(experiment.focal_px[index])
    seen = experiment.observation_camera == index
    stream.log(entity, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
    stream.log(
        entity,
        rr.Pinhole(focal_length=focal_px, width=width, height=height, image_plane_distance=_PLANE_DISTANCE),
        static=True,
    )
    stream.log(f"{entity}/photograph", rr.EncodedImage(path=photograph), static=True)
    pixels = experiment.observed_px[seen] + 0.5 * np.array([width, height])
    colours = experiment.colours[experiment.observation_point[seen]]
    stream.log(f"{entity}/photograph/observed", rr.Points2D(pixels, colors=colours, radii=2.0), static=True)


def _size(photograph: Path) -> tuple[int, int]:
    """Return the height and width [px] of an image file."""
    height, width = matplotlib.image.imread(photograph).shape[:2]
    return int(height), int(width)
