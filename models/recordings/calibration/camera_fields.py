"""Fields of a camera in calibration files of EuRoC and Kalibr: size, intrinsics and lens.

``camera_model`` and ``distortion_model`` together name the lens, and the intrinsics begin with the coefficients of the
camera model, as in Kalibr's "supported models". Kalibr has no lens with more than the four coefficients of ``radtan``:
those with five and eight have their names in ROS, so that other programs do not read them as one with four.
"""

from collections.abc import Mapping

from dronevio.models.camera import CameraModel
from dronevio.models.lenses.lens import LENSES, LensName
from dronevio.models.recordings.calibration.yaml_document import YamlDocument
from dronevio.models.recordings.calibration.yaml_text import yaml_text
from dronevio.models.recordings.files import as_input_error

LENS_NAMES: Mapping[str, LensName] = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
    "fov": "fov",
}
"""Lenses of a pinhole camera by the names of their distortion in data sets, Kalibr and ROS."""

_CAMERA_MODELS: Mapping[LensName, tuple[str, ...]] = {"ds": ("xi", "alpha"), "eucm": ("alpha", "beta"), "omni": ("xi",)}
"""Coefficients that precede the focal lengths, for lenses that are the name of a camera model."""
_NO_DISTORTION = (0.0, 0.0, 0.0, 0.0)


def read_camera_model(yaml: YamlDocument, coefficients_key: str, prefix: str = "") -> CameraModel:
    """Return the camera of a calibration file.

    Args:
        yaml: The calibration file.
        coefficients_key: Key of the distortion coefficients.
        prefix: Name of the map that contains the fields, with a dot at its end; empty for the top level.

    Raises:
        InputError: A field is missing or invalid, or the lens is not supported.
    """
    name = yaml.word(f"{prefix}camera_model")
    if name != "pinhole" and name not in _CAMERA_MODELS:
        raise yaml.error(f"{prefix}camera_model", f"one of pinhole, {', '.join(_CAMERA_MODELS)}")
    lens, distortion = _read_distortion(yaml, name, coefficients_key, prefix)
    first = _CAMERA_MODELS.get(lens, ())
    width, height = yaml.image_size(f"{prefix}resolution")
    intrinsics = yaml.numbers(f"{prefix}intrinsics", len(first) + 4)
    fx, fy, cx, cy = intrinsics[len(first) :]
    if min(fx, fy) <= 0.0:
        raise yaml.error(f"{prefix}intrinsics", f"{', '.join((*first, 'fu, fv, cu, cv'))} with positive focal lengths")
    with as_input_error(yaml.path):
        return CameraModel(width, height, fx, fy, cx, cy, (*intrinsics[: len(first)], *distortion), lens)


def camera_model_yaml(m: CameraModel, coefficients_key: str, radtan: str = "radtan") -> str:
    """Return the lines of a camera in a calibration file, without loss of precision.

    Args:
        m: The camera.
        coefficients_key: Key of the distortion coefficients.
        radtan: Name of the radial-tangential distortion with four coefficients.
    """
    first = len(_CAMERA_MODELS.get(m.lens, ()))
    distortion = m.distortion[first:]
    radial = {4: radtan, 5: "plumb_bob", 8: "rational_polynomial"}
    name = {"radtan": radial.get(len(distortion), ""), "omni": radtan}.get(m.lens, m.lens if distortion else "none")
    return (
        f"camera_model: {m.lens if first else 'pinhole'}\n"
        f"intrinsics: {yaml_text(tuple(map(float, (*m.distortion[:first], m.fx, m.fy, m.cx, m.cy))))}\n"
        f"distortion_model: {name}\n"
        f"{coefficients_key}: {yaml_text(tuple(map(float, distortion)))}\n"
        f"resolution: [{m.width}, {m.height}]\n"
    )


def _read_distortion(
    yaml: YamlDocument, camera_model: str, coefficients_key: str, prefix: str
) -> tuple[LensName, tuple[float, ...]]:
    """Return the lens and the distortion coefficients of a camera model, or raise InputError."""
    key = f"{prefix}distortion_model"
    distortion = yaml.word(key) if key in yaml or camera_model == "pinhole" else "none"
    if camera_model in ("ds", "eucm"):
        if distortion != "none":
            raise yaml.error(key, f"none, for the camera model {camera_model}")
        return camera_model, ()  # type: ignore[return-value]  # one of the two names above
    allowed = ["none", *(name for name, lens in LENS_NAMES.items() if camera_model == "pinhole" or lens == "radtan")]
    if distortion not in allowed:
        raise yaml.error(key, f"one of {', '.join(allowed)}")
    lens: LensName = "omni" if camera_model == "omni" else LENS_NAMES.get(distortion, "radtan")
    if distortion == "none":
        return lens, _NO_DISTORTION
    counts = (4,) if lens == "omni" else LENSES[lens].COUNTS
    return lens, yaml.numbers(f"{prefix}{coefficients_key}", *counts)
