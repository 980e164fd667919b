"""The reconstruction of the photographs as a rerun recording."""

from pathlib import Path

import matplotlib.image
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dronevio.estimator.book.sfm import SfmExperiment
from dronevio.eval.colours import SURROUNDINGS, rgb

_POINT_RADIUS = 0.006
_PLANE_DISTANCE = 0.3  # distance of a photograph from its camera, in units of the reconstruction


def write_sfm_rerun(experiment: SfmExperiment, path: Path) -> None:
    """Write points and cameras with their photographs to a rerun file.

    Args:
        experiment: The reconstruction. Its points before the adjustment are grey.
        path: File to write (.rrd).
    """
    blueprint = rrb.Blueprint(rrb.Spatial3DView(origin="/", name="Villa Balbianello"), collapse_panels=True)
    with rr.RecordingStream("dronevio_book_sfm") as stream:
        stream.save(path, default_blueprint=blueprint)
        # The world frame of Bundler is that of its first camera in OpenGL's convention, y up.
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        stream.log(
            "points", rr.Points3D(experiment.points, colors=experiment.colours, radii=_POINT_RADIUS), static=True
        )
        stream.log(
            "points_before",
            rr.Points3D(experiment.points_initial, colors=rgb(SURROUNDINGS), radii=0.5 * _POINT_RADIUS),
            static=True,
        )
        for i, photograph in enumerate(experiment.photographs):
            _record_camera(stream, experiment, i, photograph)


def _record_camera(stream: rr.RecordingStream, experiment: SfmExperiment, index: int, photograph: Path) -> None:
    """Log one camera, its photograph and its observations."""
    T, entity = experiment.Ts_world_cam[index], f"cameras/{index + 1}"
    height, width = _size(photograph)
    focal_px = float(experiment.focal_px[index])
    observed = experiment.observation_camera == index
    stream.log(entity, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
    stream.log(
        entity,
        rr.Pinhole(focal_length=focal_px, width=width, height=height, image_plane_distance=_PLANE_DISTANCE),
        static=True,
    )
    stream.log(f"{entity}/photograph", rr.EncodedImage(path=photograph), static=True)
    pixels = experiment.observed_px[observed] + 0.5 * np.array([width, height])
    colours = experiment.colours[experiment.observation_point[observed]]
    stream.log(f"{entity}/photograph/observed", rr.Points2D(pixels, colors=colours, radii=2.0), static=True)


def _size(photograph: Path) -> tuple[int, int]:
    """Return the height and the width of an image file [px]."""
    height, width = matplotlib.image.imread(photograph).shape[:2]
    return int(height), int(width)
