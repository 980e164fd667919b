"""Photographs of the report of a reconstruction, with the observations and their residuals."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dronevio.eval import colours
from dronevio.eval.images import downscaled
from dronevio.eval.report.reconstruction.model import ReconstructionResults
from dronevio.eval.scene import ResidualStyle
from dronevio.models.arrays import Array
from dronevio.models.recordings.images import encode_jpeg

MAX_PHOTOGRAPHS = 6
"""Number of images with observations that the page shows."""
_PHOTOGRAPH_PX = 1000  # largest length of the longer side
_MAX_MARKS = 1500  # of one photograph


@dataclass(frozen=True)
class Mark:
    """An observation in a photograph."""

    x: float
    """Column in the shown image [px]."""
    y: float
    """Row in the shown image [px]."""
    end_x: float
    """Column of the end of the enlarged residual [px]."""
    end_y: float
    """Row of the end of the enlarged residual [px]."""
    colour: str
    """Colour by the length of the residual, as ``#rrggbb``."""


@dataclass(frozen=True)
class Photograph:
    """An image with its observations."""

    width: int
    """Number of columns of the shown image [px]."""
    height: int
    """Number of rows of the shown image [px]."""
    caption: str
    """Name of the image and number of its observations."""
    jpeg_base64: str
    """The image; empty if it is not known."""
    marks: list[Mark]
    """Observations in the image."""


def photographs(results: ReconstructionResults, style: ResidualStyle) -> Iterator[Photograph]:
    """Yield images spread evenly over all registered ones."""
    images = [(k, i) for k, component in enumerate(results.components) for i in range(len(component.image_names))]
    shares = (np.arange(MAX_PHOTOGRAPHS) + 0.5) / MAX_PHOTOGRAPHS
    for index in sorted({int(share * len(images)) for share in shares if images}):
        yield _photograph(results, *images[index], style)


def _photograph(results: ReconstructionResults, component_index: int, index: int, style: ResidualStyle) -> Photograph:
    """Return an image of a component with its observations."""
    component = results.components[component_index]
    name, model = component.image_names[index], component.cameras[component.image_camera[index]]
    image = None if results.read_image is None else results.read_image(name)
    if image is None:
        scale = min(1.0, _PHOTOGRAPH_PX / max(model.width, model.height))
        width, height, data = max(1, round(scale * model.width)), max(1, round(scale * model.height)), ""
    else:
        small = downscaled(image, _PHOTOGRAPH_PX)
        height, width = small.shape[:2]
        scale, data = width / model.width, base64.b64encode(encode_jpeg(small)).decode("ascii")
    is_seen = component.observation_image == index
    residuals = results.residuals_px[component_index][is_seen]
    pixels = component.observation_px[is_seen]
    errors = np.linalg.norm(residuals, axis=1)
    chosen = np.unique(np.linspace(0, len(pixels) - 1, min(len(pixels), _MAX_MARKS)).astype(int))
    ends = pixels + style.factor * np.nan_to_num(residuals)
    start_end = scale * (np.concatenate([pixels, ends], axis=1) + 0.5) - 0.5
    hexes = hex_colours(errors, style.limit_px)
    marks = [Mark(x, y, end_x, end_y, hexes[k]) for k in chosen for x, y, end_x, end_y in (start_end[k].tolist(),)]
    finite = errors[np.isfinite(errors)]
    median = f", median error {np.median(finite):.2f} px" if len(finite) else ""
    some = f", {len(marks)} of them shown" if len(marks) < len(pixels) else ""
    return Photograph(width, height, f"{name}: {len(pixels)} observations{some}{median}", data, marks)


def hex_colours(errors_px: Array, limit_px: float) -> list[str]:
    """Return the colours of reprojection errors as ``#rrggbb``."""
    return ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in colours.residual_colours(errors_px, limit_px).tolist()]
