"""Opening of image sets: a folder of photographs, a video or a recording, which is recognized from the path."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets.folder import CameraSharing, image_folder
from dronevio.models.image_sets.image_set import ImageSet
from dronevio.models.image_sets.photos import PHOTO_SUFFIXES
from dronevio.models.image_sets.recording import image_recording
from dronevio.models.image_sets.rig_folder import RIG_FILE, image_rig_folder, is_rig_folder
from dronevio.models.image_sets.video import VIDEO_SUFFIXES, image_video
from dronevio.models.lenses.lens import LensName
from dronevio.models.recordings.calibration.reading import read_cameras
from dronevio.models.recordings.open import is_bag, is_recording_folder
from dronevio.models.rig import Cameras


def open_images(
    path: Path | str,
    *,
    camera: CameraSharing | None = None,
    model: CameraModel | None = None,
    masks: Path | str | None = None,
    every: int | None = None,
    cameras: Cameras = None,
    frames: int | Sequence[int] | None = None,
    lens: LensName | None = None,
) -> ImageSet:
    """Return the images of a folder, a video or a recording.

    Args:
        path: A folder of images, also of a rig (`dronevio.models.image_sets.rig_folder`), a video (``.mp4``, ``.avi``,
            ``.mov``, ``.mkv`` or ``.webm``), or a recording that `open_recording` opens.
        camera: For folders: ``shared`` cameras, the default, or ``per-image``; see `image_folder`.
        model: For folders and videos: calibration of the one camera; None for initial values.
        masks: A folder of masks or one mask for all images; see `dronevio.models.image_sets.masks`.
        every: For videos: distance between the frames to use, by default 1.
        cameras: For recordings: cameras to use, by default the first. For folders of a rig: the same, by default all.
        frames: For recordings: number of frames, spread evenly, or their indices; by default all.
        lens: For folders and videos without a calibration: ``radtan``, a pinhole and the default, or ``equidistant``, a
            fisheye.

    Raises:
        InputError: The path is none of these, or is damaged.
        ConfigError: An option is given that does not apply, or has an invalid value.
    """
    path = Path(path)
    options = {"camera": camera, "model": model, "every": every, "cameras": cameras, "frames": frames, "lens": lens}
    if model is not None and lens is not None:
        raise ConfigError(f"{path}: a lens beside a calibration, which has one; expected only one of them")
    if is_recording(path):
        _check_options(path, "a recording", options, ("cameras", "frames"))
        return image_recording(path, cameras=(0,) if cameras is None else cameras, frames=frames, masks=masks)
    if is_rig_folder(path):
        _check_options(path, "a folder of a rig", options, ("cameras",))
        return image_rig_folder(path, read_cameras(path / RIG_FILE), cameras=cameras, masks=masks)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        _check_options(path, "a video", options, ("model", "every", "lens"))
        return image_video(path, 1 if every is None else every, model, masks, lens or "radtan")
    if not path.exists():
        raise InputError(path, "no such file or folder", _expected())
    if not path.is_dir():
        raise InputError(path, "a file that is neither a video nor a recording", _expected())
    if (path / "report.json").is_file() and (path / "report.html").is_file():
        raise InputError(path, "a result, whose pictures are those of its report", "the folder of its images")
    _check_options(path, "a folder of images", options, ("camera", "model", "lens"))
    return image_folder(path, camera=camera or "shared", model=model, masks=masks, lens=lens or "radtan")


def is_recording(path: Path) -> bool:
    """Return whether a path is that of a recording: a bag or a folder of a data set."""
    return is_bag(path) or is_recording_folder(path)


def _check_options(path: Path, kind: str, options: Mapping[str, object], allowed: tuple[str, ...]) -> None:
    """Raise ConfigError if an option is given that does not apply to a kind of images."""
    for name, value in options.items():
        if value is not None and name not in allowed:
            raise ConfigError(f"{path}: the option {name} for {kind}; expected only {', '.join(allowed)}")


def _expected() -> str:
    """Return the description of a path for error messages."""
    return f"a folder of images ({', '.join(PHOTO_SUFFIXES)}), a video ({', '.join(VIDEO_SUFFIXES)}) or a recording"
