"""Looks of surfaces: named textures with a colour, and images of the user."""

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import cv2
import numpy as np
from PIL import Image as Pillow

from dronevio.models.arrays import Image
from dronevio.sim.appearance import textures, textures_building, textures_industrial, textures_nature, textures_race
from dronevio.sim.appearance.solids import Paint
from dronevio.sim.appearance.textures import Colour, Pattern

Random = np.random.Generator

LARGEST_SIDE_PX = 4000
"""Largest side of a painted surface [px]."""
_LARGEST_IMAGE_PX = 8192
_KEPT_PX = 2048  # larger images are reduced


@dataclass(frozen=True)
class Texture:
    """A kind of texture."""

    paint: Callable[[Random, int, int, Colour, float], Image]
    """Function that draws an image of a height, a width [px], a colour and a resolution [px/m]."""
    colour: Colour
    """Colour by default."""


def _unscaled(pattern: Pattern) -> Callable[[Random, int, int, Colour, float], Image]:
    """Return a pattern that does not depend on the resolution as a paint of textures."""
    return lambda rng, height, width, colour, ppm: pattern(rng, height, width, colour)


def _grass(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return a meadow."""
    return textures_nature.meadow(rng, height, width, colour, ppm)


TEXTURES: dict[str, Texture] = {
    "plain": Texture(_unscaled(textures.plain), (150, 150, 150)),
    "white": Texture(_unscaled(textures_building.whitewash), (206, 204, 198)),
    "plaster": Texture(_unscaled(textures.plaster), (188, 178, 152)),
    "wallpaper": Texture(_unscaled(textures.wallpaper), (158, 176, 166)),
    "bricks": Texture(_unscaled(textures.bricks), (150, 84, 64)),
    "concrete": Texture(textures_building.concrete, (136, 134, 128)),
    "marble": Texture(textures_building.marble, (196, 192, 184)),
    "tiles": Texture(textures_building.tiles, (176, 182, 186)),
    "metal": Texture(textures_building.sheet_metal, (126, 134, 142)),
    "planks": Texture(_unscaled(textures.planks), (160, 118, 76)),
    "wood": Texture(_unscaled(textures.wood), (150, 106, 66)),
    "cardboard": Texture(_unscaled(textures.cardboard), (176, 136, 92)),
    "crate": Texture(textures_industrial.crate, (166, 126, 82)),
    "container": Texture(_unscaled(textures_race.container), (60, 96, 140)),
    "chequers": Texture(_unscaled(textures_race.chequers), (190, 60, 50)),
    "fabric": Texture(_unscaled(textures.fabric), (120, 96, 110)),
    "stone": Texture(_unscaled(textures_nature.stone), (138, 134, 126)),
    "bark": Texture(_unscaled(textures_nature.bark), (116, 92, 70)),
    "leaves": Texture(_unscaled(textures_nature.leaves), (88, 118, 50)),
    "grass": Texture(_grass, (96, 124, 62)),
}
"""Textures that a file can name."""


@dataclass(frozen=True, eq=False)
class Look:
    """Look of the surfaces of an object: a texture with a colour, or an image."""

    texture: str = "plain"
    """Key of `TEXTURES`, if there is no image."""
    colour: Colour | None = None
    """Red, green and blue, 0 to 255; None for that of the texture."""
    image: Image | None = None
    """(H, W, 3) Image instead of a texture."""
    repeat_m: float | None = None
    """Width on the surface after which the image is repeated [m]; None stretches it over each face."""

    def paint(self, ppm: float) -> Paint:
        """Return the paint for a resolution [px/m]."""
        if self.image is not None:
            width_px = None if self.repeat_m is None else max(round(self.repeat_m * ppm), 1)
            return partial(_shown, image=self.image, width_px=width_px)
        kind = TEXTURES[self.texture]
        return partial(_painted, paint=kind.paint, colour=self.colour or kind.colour, ppm=ppm)


def _painted(
    rng: Random,
    height: int,
    width: int,
    paint: Callable[[Random, int, int, Colour, float], Image],
    colour: Colour,
    ppm: float,
) -> Image:
    """Return a texture, of which very narrow surfaces show a part."""
    whole = paint(rng, max(height, _LEAST_PX), max(width, _LEAST_PX), colour, ppm)
    return np.ascontiguousarray(whole[:height, :width])


_LEAST_PX = 32


def _shown(rng: Random, height: int, width: int, image: Image, width_px: int | None) -> Image:
    """Return an image, stretched or repeated."""
    if width_px is None:
        return _resized(image, height, width)
    tile = _resized(image, max(round(width_px * image.shape[0] / image.shape[1]), 1), width_px)
    return textures_nature.tiled(tile, height, width)


def _resized(image: Image, height: int, width: int) -> Image:
    """Return an image (H, W, 3) of another size [px]."""
    is_smaller = height * width < image.shape[0] * image.shape[1]
    way = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=way), dtype=np.uint8)


@lru_cache(maxsize=64)
def decoded_image(content: bytes) -> Image:
    """Return the image (H, W, 3) in the content of a file, reduced to at most 2048 px.

    Raises:
        ValueError: It is no image, or one with more than 8192 px along a side.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with Pillow.open(io.BytesIO(content), formats=("PNG", "JPEG")) as opened:
                return reduced_image(opened)
    except (OSError, SyntaxError, Warning, Pillow.DecompressionBombError) as error:
        raise ValueError("no PNG or JPEG image") from error


def reduced_image(opened: Pillow.Image) -> Image:
    """Return an image (H, W, 3) of Pillow, reduced to at most 2048 px, which cannot be changed.

    Raises:
        ValueError: It has more than 8192 px along a side.
    """
    if max(opened.size) > _LARGEST_IMAGE_PX:
        raise ValueError(f"{opened.width} × {opened.height} px")
    kept = reduced_to(np.asarray(opened.convert("RGB"), dtype=np.uint8), _KEPT_PX)
    kept.flags.writeable = False
    return kept


def reduced_to(image: Image, largest_px: int) -> Image:
    """Return an image (H, W, 3) whose longer side has at most some pixels."""
    factor = largest_px / max(image.shape[:2])
    if factor >= 1.0:
        return image
    return _resized(image, *(max(round(factor * side), 1) for side in image.shape[:2]))
