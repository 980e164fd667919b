"""Contact sheets: pictures of worlds from several viewpoints, for inspection."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.recordings.files import check_output_path
from dronevio.models.rotation import exp_so3, rotation_z
from dronevio.sim.appearance.textures import to_image
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.pictures.texturedness import poses_along
from dronevio.sim.world import World, world_builder
from dronevio.sim.worlds.own.names import shown_world

LENS = CameraModel(width=480, height=300, fx=250.0, fy=250.0, cx=239.5, cy=149.5)
"""Camera of the pictures: 88° wide, without distortion."""
VIEWS = 12
"""Number of pictures on the sheet of one world."""
VIEWS_EACH = 3
"""Number of pictures of each world on the sheet of several worlds."""

_COLUMNS = 4
_WORLDS_A_ROW = 2  # on the sheet of several worlds
_CANDIDATES = 4  # candidate positions of each view, of which the one with the largest depth is used
_FAR_PERCENT = 85  # percentile of the depths of a view that is compared
_VIEW_OFFSET_RAD = 0.45  # heading of the views off the route, alternating left and right
_DOWN_RAD = 0.06
_GAMMA = 2.2  # gamma of a display
_GAP_PX, _CAPTION_PX = 6, 30
_PAPER, _INK, _FAINT = (24, 26, 30), (240, 240, 236), (168, 172, 178)
_SUPERSAMPLING = 2.0


def viewpoints(route: Array, count: int) -> Array:
    """Return camera poses (count, 4, 4) along a closed route (R, 3), with alternating heading and slightly downward."""
    poses = poses_along(route, count)
    for number, T in enumerate(poses):
        aside = _VIEW_OFFSET_RAD * (-1.0, 1.0, 0.0)[number % 3]
        T[:3, :3] = rotation_z(aside) @ T[:3, :3] @ exp_so3(np.array([-_DOWN_RAD, 0.0, 0.0]))
    return poses


def taken_views(world: World, count: int, camera: CameraModel = LENS) -> Iterator[Image]:
    """Yield pictures (H, W, 3) of a world along its route; dark worlds are shown with the gamma of a display.

    Raises:
        GraphicsError: There is no off-screen OpenGL.
    """
    poses = viewpoints(world.route, _CANDIDATES * count).reshape(count, _CANDIDATES, 4, 4)
    with OffscreenCamera(world.spec.compile(), camera, _SUPERSAMPLING) as eye:
        for candidates in poses:
            sees_m = [float(np.percentile(eye.render_depth(T), _FAR_PERCENT)) for T in candidates]
            picture = eye.render_rgb(candidates[int(np.argmax(sees_m))])
            yield to_image(picture * np.float32(world.illumination ** (1.0 / _GAMMA)))


def views(world: World, count: int, camera: CameraModel = LENS) -> list[Image]:
    """Return the pictures (H, W, 3) of `taken_views`.

    Raises:
        GraphicsError: There is no off-screen OpenGL.
    """
    return list(taken_views(world, count, camera))


def contact_sheet(pictures: Sequence[Image]) -> Image:
    """Return pictures (H, W, 3) of a world as one picture, in rows of four."""
    return _in_rows(pictures, _COLUMNS)


def sheet_of_worlds(names: Sequence[str], pictures: Sequence[Sequence[Image]]) -> Image:
    """Return a picture (H, W, 3) of several worlds, the pictures of each side by side under its name.

    Args:
        names: Names of the worlds.
        pictures: Pictures (H, W, 3) of each world, of equal number and size.
    """
    blocks = [_block(name, strip) for name, strip in zip(names, pictures, strict=True)]
    return _framed(_in_rows(blocks, min(_WORLDS_A_ROW, len(blocks))))


def write_picture(path: Path, picture: Image) -> None:
    """Write a picture (H, W, 3) in the format of the file's suffix.

    Raises:
        InputError: The ending names no kind of image.
        OSError: It cannot be written.
    """
    require_picture(path)
    path.write_bytes(cv2.imencode(path.suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())


def require_picture(path: Path) -> None:
    """Raise InputError unless the file can be written and its suffix is that of an image format."""
    if not path.parent.is_dir():
        raise InputError(path, "no such folder", "a file in a folder that exists")
    check_output_path(path)
    if not path.suffix or not cv2.haveImageWriter(path.name):
        raise InputError(path, f"the ending {path.suffix!r}", "that of an image, such as .png or .jpg")


def _in_rows(pictures: Sequence[Image], columns: int) -> Image:
    """Return pictures (H, W, 3) of one size arranged in rows; unused cells are empty."""
    filled = [*pictures, *[np.full_like(pictures[0], _PAPER)] * (-len(pictures) % columns)]
    return np.vstack([np.hstack(filled[k : k + columns]) for k in range(0, len(filled), columns)])


def _framed(picture: Image) -> Image:
    """Return a picture with a narrow margin."""
    margins = ((_GAP_PX, _GAP_PX), (_GAP_PX, _GAP_PX))
    return np.stack([np.pad(picture[..., k], margins, constant_values=_PAPER[k]) for k in range(3)], axis=-1)


def _block(name: str, pictures: Sequence[Image]) -> Image:
    """Return the pictures of a world side by side under its name and description."""
    strip = np.hstack([_framed(picture) for picture in pictures])
    title = shown_world(name)
    caption = np.full((_CAPTION_PX, strip.shape[1], 3), _PAPER, np.uint8)
    font, base = cv2.FONT_HERSHEY_SIMPLEX, _CAPTION_PX - 9
    cv2.putText(caption, title, (_GAP_PX + 2, base), font, 0.75, _INK, 2, cv2.LINE_AA)
    (width, _), _ = cv2.getTextSize(title, font, 0.75, 2)
    builder = world_builder(name)
    words = builder.description if builder.difficulty == "normal" else f"{builder.description} ({builder.difficulty})"
    cv2.putText(caption, words, (_GAP_PX + width + 18, base), font, 0.52, _FAINT, 1, cv2.LINE_AA)
    return np.asarray(np.vstack([caption, strip]), dtype=np.uint8)
