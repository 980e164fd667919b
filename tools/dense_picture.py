"""Make the picture of a villa in docs/images: a photograph beside the points and the mesh of five photographs.

The photographs of Villa del Balbianello are among the example data of GTSAM's wheel::

    .venv/bin/python tools/dense_picture.py --out docs/images/dense.jpg
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import gtsam
import numpy as np
import tyro

import dronevio as dv
from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.views import ViewLoader
from dronevio.eval.images import depth_colours, downscaled
from dronevio.eval.report.dense import DenseResults, pictures
from dronevio.models.image_sets import image_folder
from dronevio.models.recordings.images import encode_jpeg

WIDTH_PX = 1280
"""Width of the picture [px]."""


@dataclass(frozen=True)
class DensePictureCommand:
    """Make the picture of a villa from five photographs."""

    out: Path = Path("docs/images/dense.jpg")
    """File to write."""


def make(command: DensePictureCommand) -> None:
    """Reconstruct the villa and write the picture."""
    folder = Path(gtsam.findExampleDataFile("Balbianello/BalbianelloMedium-1.jpg")).parent
    images = image_folder(folder)
    reconstruction = dv.sfm(images).reconstructions[0]
    result = dv.dense(images, reconstruction)
    load = ViewLoader(images, reconstruction, DenseConfig().views)
    results = DenseResults(
        reconstruction=reconstruction,
        cloud=result.cloud,
        mesh=result.mesh,
        inverse_depths=[depth.inverse_depth for depth in result.depths],
        read_image=lambda i: load(i).colours,
        point_size=result.spacing,
    )
    upper = np.hstack([load(2).colours, depth_colours(result.depths[2].inverse_depth)])
    lower = np.hstack(pictures(results))
    rows = [cv2.resize(row, (WIDTH_PX, row.shape[0] * WIDTH_PX // row.shape[1])) for row in (upper, lower)]
    command.out.write_bytes(encode_jpeg(downscaled(np.vstack(rows), 2 * WIDTH_PX), quality=88))


if __name__ == "__main__":
    make(tyro.cli(DensePictureCommand, description=__doc__))
