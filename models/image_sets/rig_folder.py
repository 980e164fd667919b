"""Image sets from folders with the images of a calibrated rig: ``cam0``, ``cam1`` and so on, with ``rig.yaml``.

Images of the cameras with one name, apart from its suffix, were taken at the same time. The baseline between two
cameras gives the scale of a reconstruction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from dronevio.models.errors import InputError
from dronevio.models.image_sets.control_points import find_control_points
from dronevio.models.image_sets.folder import PhotoFiles, natural_key, photo_bits, usable_photos
from dronevio.models.image_sets.geotags import GeoTag, geotags_of
from dronevio.models.image_sets.image_set import FocalSource, ImageSet
from dronevio.models.image_sets.masks import find_masks
from dronevio.models.rig import Cameras, RigCamera, camera_indices

RIG_FILE = "rig.yaml"
"""Name of the calibration in a folder, a camchain.yaml of Kalibr; that of an IMU is not needed."""


@dataclass(frozen=True)
class _Photo:
    """An image of a rig."""

    name: str
    """Path below the folder of its camera."""
    number: int
    """Index of the camera in the calibration."""
    camera: int
    """Index of the camera among those that are used."""
    bits: int
    """Significant bits."""
    geotag: GeoTag | str | None
    """Position in the metadata; see `PhotoHeader`."""

    @property
    def moment(self) -> str:
        """What the images of one moment have in common: the name without its suffix."""
        return str(PurePosixPath(self.name).with_suffix(""))


def is_rig_folder(path: Path) -> bool:
    """Return whether a path is a folder with the images of a rig and its calibration."""
    return (path / RIG_FILE).is_file() and (path / "cam0").is_dir()


def image_rig_folder(
    path: Path | str,
    rig: Sequence[RigCamera],
    *,
    cameras: Cameras = None,
    masks: Path | str | None = None,
) -> ImageSet:
    """Return the images of a rig in the folders ``cam0``, ``cam1`` and so on, in natural order of their names.

    Args:
        path: The folder.
        rig: The calibrated cameras.
        cameras: Cameras to use.
        masks: A folder of masks or one mask for all images; see `dronevio.models.image_sets.masks`.

    Raises:
        InputError: The folder of a camera does not exist or has no image that can be used, or there are no masks.
        ConfigError: A camera is not in the calibration, or is given twice.
    """
    folder, mask_path = Path(path), Path(masks) if masks is not None else None
    chosen = camera_indices(cameras, len(rig))
    # The images of all cameras, those of one moment beside each other
    found: list[_Photo] = []
    skipped: dict[str, InputError] = {}
    for k, number in enumerate(chosen):
        headers, unusable = usable_photos(folder / f"cam{number}", mask_path, rig[number].model)
        skipped |= {f"cam{number}/{name}": error for name, error in unusable.items()}
        bits = photo_bits([folder / f"cam{number}" / name for name in headers], list(headers.values()))
        rows = zip(headers.items(), bits, strict=True)
        found += [_Photo(name, number, k, b, header.geotag) for (name, header), b in rows]
    found.sort(key=lambda photo: (natural_key(photo.moment), photo.camera))
    frames = {moment: row for row, moment in enumerate(dict.fromkeys(photo.moment for photo in found))}
    names = tuple(f"cam{photo.number}/{photo.name}" for photo in found)
    image_camera = np.array([photo.camera for photo in found], np.int64)
    models = tuple(rig[number].model for number in chosen)
    calibration: FocalSource = "calibration"
    read = PhotoFiles(tuple(folder / name for name in names), image_camera, models, tuple(p.bits for p in found))
    return ImageSet(
        names=names,
        image_camera=image_camera,
        cameras=models,
        is_calibrated=np.full(len(models), True),
        is_ordered=False,
        t_ns=None,
        frame=np.array([frames[photo.moment] for photo in found], np.int64),
        Ts_imu_cam=np.stack([rig[number].T_imu_cam for number in chosen]),
        read=read,
        read_mask=find_masks(mask_path, names, image_camera, models),
        focal_source=(calibration,) * len(models),
        skipped=skipped,
        geotags=geotags_of([photo.geotag for photo in found]),
        control_points=find_control_points(folder, names),
    )
