"""Make a picture of dense surfaces in docs/images: an image, its depths, and the mesh without and with its texture.

The photographs of Villa del Balbianello are among the example data of GTSAM's wheel; the room is a simulated flight::

    .venv/bin/python tools/dense_picture.py --out docs/images/dense.jpg
    .venv/bin/dronevio fly room-v0 --out build/room
    .venv/bin/python tools/dense_picture.py build/room --frames 60 --out docs/images/dense-room.jpg
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import gtsam
import numpy as np
import tyro
from environment_pictures import record_hashes

import dronevio as dv
from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.views import ViewLoader
from dronevio.eval.images import depth_colours, downscaled
from dronevio.eval.report.dense import DenseResults, pictures, textured_picture
from dronevio.models.image_sets.open import open_images
from dronevio.models.recordings.images import encode_jpeg

WIDTH_PX = 1280
"""Width of the picture [px]."""


@dataclass(frozen=True)
class DensePictureCommand:
    """Make a picture of the surfaces of a scene."""

    images: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of photographs, or a recording; the villa by default."""
    frames: int | None = None
    """Number of frames of a recording."""
    out: Path = Path("docs/images/dense.jpg")
    """File to write."""


def make(command: DensePictureCommand) -> None:
    """Reconstruct the scene and write the picture, in which the middle image is shown."""
    villa = Path(gtsam.findExampleDataFile("Balbianello/BalbianelloMedium-1.jpg")).parent
    images = open_images(command.images or villa, frames=command.frames)
    reconstruction = dv.sfm(images).reconstructions[0]
    result = dv.dense(images, reconstruction, with_texture=True)
    load = ViewLoader(images, reconstruction, DenseConfig().views)
    results = DenseResults(
        reconstruction=reconstruction,
        cloud=result.cloud,
        mesh=result.mesh,
        inverse_depths=[depth.inverse_depth for depth in result.depths],
        read_image=lambda i: load(i).colours,
        point_size=result.spacing,
    )
    texture = textured_picture(results)
    assert texture is not None
    shown = len(load) // 2
    upper = np.hstack([load(shown).colours, depth_colours(result.depths[shown].inverse_depth)])
    lower = np.hstack([pictures(results)[1], texture])
    rows = [cv2.resize(row, (WIDTH_PX, row.shape[0] * WIDTH_PX // row.shape[1])) for row in (upper, lower)]
    command.out.write_bytes(encode_jpeg(downscaled(np.vstack(rows), 2 * WIDTH_PX), quality=88))
    record_hashes()


if __name__ == "__main__":
    make(tyro.cli(DensePictureCommand, description=__doc__))
