"""Camera models of COLMAP, and their conversion from and to ours.

The centre of the first pixel is (0.5, 0.5) in COLMAP and (0, 0) here, so that principal points and observations differ
by half a pixel. COLMAP's ``OPENCV`` is our ``radtan``, ``FULL_OPENCV`` that with more coefficients, ``OPENCV_FISHEYE``
our ``equidistant``, ``FOV`` our ``fov`` and ``EUCM`` our ``eucm``; the others that are read are special cases of
``OPENCV``. Source: COLMAP's ``src/colmap/sensor/models.h``.
"""

from pathlib import Path

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.lenses.lens import LensName
from dronevio.models.reconstructions.parsing import check_image_size

PIXEL_SHIFT = 0.5
"""Coordinate of the centre of the first pixel in COLMAP minus that here [px]."""

MODEL_IDS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "EUCM": 16,
}
"""Numbers of the supported models in binary files, by name."""

PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
}
"""Parameters of the supported models, in the order of the files."""

_OTHER_MODELS = {
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    14: "SIMPLE_FISHEYE",
    15: "FISHEYE",
    17: "EQUIRECTANGULAR",
}
"""Names of the models that are not supported, by their numbers."""
_NAMES = {number: name for name, number in MODEL_IDS.items()} | _OTHER_MODELS
_LENSES: dict[str, LensName] = {"OPENCV_FISHEYE": "equidistant", "FOV": "fov", "EUCM": "eucm"}
"""Lenses of the models that are not special cases of ``radtan``."""


def model_name(model_id: int) -> str:
    """Return the name of a camera model, given its number in a binary file."""
    return _NAMES.get(model_id, f"number {model_id}")


def check_supported(path: Path, camera_id: int, name: str, line: int | None = None) -> None:
    """Check that a camera model of COLMAP is one of those that are supported.

    Raises:
        InputError: The model is another one; the message names the camera and the supported models.
    """
    if name not in PARAMETERS:
        raise InputError(path, f"camera {camera_id}: camera model {name[:40]}", f"one of {', '.join(PARAMETERS)}", line)


def camera_from_colmap(
    path: Path,
    camera_id: int,
    name: str,
    size_px: tuple[int, int],
    parameters: list[float],
    line: int | None = None,
) -> CameraModel:
    """Return the camera model of a camera of COLMAP.

    Args:
        path: The file that contains the camera, for error messages.
        camera_id: Number of the camera, for error messages.
        name: Name of its model.
        size_px: Width and height of the image [px].
        parameters: Parameters in the order of `PARAMETERS`.
        line: Line number of the camera in a text file.

    Raises:
        InputError: The model is not supported, or a value is invalid.
    """
    where = f"camera {camera_id}: "
    check_supported(path, camera_id, name, line)
    names = PARAMETERS[name]
    if len(parameters) != len(names):
        expected = f"{len(names)} parameters ({', '.join(names)})"
        raise InputError(path, f"{where}{len(parameters)} parameters of {name}", expected, line)
    check_image_size(path, *size_px, where, line)
    p = dict(zip(names, parameters, strict=True))
    coefficients = tuple(parameters[names.index("cy") + 1 :])
    lens = _LENSES.get(name, "radtan")
    try:
        return CameraModel(
            width=size_px[0],
            height=size_px[1],
            fx=p["fx"] if "fx" in p else p["f"],
            fy=p["fy"] if "fy" in p else p["f"],
            cx=p["cx"] - PIXEL_SHIFT,
            cy=p["cy"] - PIXEL_SHIFT,
            distortion=(*coefficients, *max(4 - len(coefficients), 0) * (0.0,)) if lens == "radtan" else coefficients,
            lens=lens,
        )
    except ConfigError as error:
        found, _, expected = str(error).partition("; expected ")
        raise InputError(path, where + found, expected, line) from None


def camera_to_colmap(camera: CameraModel) -> tuple[str, list[float]]:
    """Return the name and the parameters of the model of COLMAP that equals a camera.

    It is ``PINHOLE`` for a ``radtan`` lens without distortion.

    Raises:
        ConfigError: COLMAP has no such lens.
    """
    parameters = [camera.fx, camera.fy, camera.cx + PIXEL_SHIFT, camera.cy + PIXEL_SHIFT]
    names = {lens: name for name, lens in _LENSES.items()}
    if camera.lens in names:
        return names[camera.lens], [*parameters, *camera.distortion]
    if camera.lens != "radtan":
        raise ConfigError(f"camera lens {camera.lens}; expected one of radtan, {', '.join(names)} for COLMAP")
    if any(camera.distortion[4:]):
        return "FULL_OPENCV", [*parameters, *camera.distortion, *(8 - len(camera.distortion)) * (0.0,)]
    if any(camera.distortion):
        return "OPENCV", [*parameters, *camera.distortion[:4]]
    return "PINHOLE", parameters
