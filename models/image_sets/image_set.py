"""Set of images of a scene with their cameras, the input of structure from motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets.control_points import ControlPoints
from dronevio.models.image_sets.geotags import GeoTags
from dronevio.models.imu import ImuModel, ImuSamples, Times

Indices = npt.NDArray[np.int64]

FocalSource = Literal["calibration", "exif-35mm", "exif-focal-plane", "assumed"]
"""Source of a focal length: a calibration, the 35 mm equivalent or the resolution of the focal plane in EXIF data, or
the assumed field of view of `dronevio.models.image_sets.intrinsics`."""


@dataclass(frozen=True, eq=False)
class InertialData:
    """Measurements of the IMU on which the cameras of a set of images are mounted."""

    samples: ImuSamples
    """Samples of the whole recording."""
    model: ImuModel
    """Noise of the IMU."""
    time_offset_s: float
    """Time offset of the camera clock: t_imu = t_cam + offset [s]."""


@dataclass(frozen=True, eq=False)
class ImageSet:
    """I images of a scene by K cameras. The pixels are read on request."""

    names: tuple[str, ...]
    """(I,) Unique names of the images: the path below the folder of the images, the camera and the time stamp as in
    ``cam0/1403636579763555584`` for recordings, and the index as in ``frame-000120`` for videos."""
    image_camera: Indices
    """(I,) Index of the camera of each image."""
    cameras: tuple[CameraModel, ...]
    """(K,) Camera models; initial values where a camera is not calibrated."""
    is_calibrated: Mask
    """(K,) Whether the camera model comes from a calibration."""
    is_ordered: bool
    """Whether the images are in the order of time, as in recordings and videos."""
    t_ns: Times | None
    """(I,) Time stamps of the images [ns], None if they are unknown."""
    frame: Indices | None
    """(I,) Index of the frame of a rig, counted from 0, to which each image belongs; None without a rig. The images of
    one frame were taken at the same time."""
    Ts_imu_cam: Array | None
    """(K, 4, 4) Poses of the cameras in the IMU frame, None without a rig."""
    read: Callable[[int], Image]
    """Returns the image with a given index: grey (H, W), or red, green and blue (H, W, 3). Rows and columns are those
    of the file, whatever orientation it requests for its display. Several threads may call it; it raises InputError if
    the image is missing, damaged or of another size than its camera."""
    read_mask: Callable[[int], Mask | None]
    """Returns the mask (H, W) of the image with a given index, False where no features may be detected; None if the
    whole image is used. It raises InputError as `read` does."""
    focal_source: tuple[FocalSource, ...] = ()
    """(K,) Source of the focal length of each camera, empty if it is unknown."""
    inertial: InertialData | None = None
    """Measurements of the IMU during the images, None without any."""
    skipped: Mapping[str, InputError] = field(default_factory=dict)
    """Why files that look like images are not among them, by their names."""
    geotags: GeoTags | None = None
    """Positions and orientations of the images by their metadata, None without any."""
    control_points: ControlPoints | None = None
    """Ground control points in the images, None without any."""

    def __post_init__(self) -> None:
        """Check shapes, indices and names.

        Raises:
            ConfigError: A shape or an index contradicts the others, or two images have one name.
        """
        images, cameras = len(self.names), len(self.cameras)
        shapes: dict[str, tuple[int, ...]] = {
            "image_camera": (images,),
            "is_calibrated": (cameras,),
            "t_ns": (images,),
            "frame": (images,),
            "Ts_imu_cam": (cameras, 4, 4),
        }
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise ConfigError(f"image set: {name} has shape {values.shape}; expected {shape}")
        if images and not (self.image_camera.min() >= 0 and self.image_camera.max() < cameras):
            raise ConfigError(
                f"image set: image_camera has values from {self.image_camera.min()} to {self.image_camera.max()};"
                f" expected 0 to {cameras - 1}"
            )
        if self.geotags is not None and self.geotags.geodetic.shape != (images, 3):
            found = self.geotags.geodetic.shape
            raise ConfigError(f"image set: geotags have positions of shape {found}; expected {(images, 3)}")
        if len(set(self.names)) != images:
            repeated = next(name for name in self.names if self.names.count(name) > 1)
            raise ConfigError(f"image set: two images with the name {repeated}; expected unique names")
        if self.focal_source and len(self.focal_source) != cameras:
            raise ConfigError(
                f"image set: focal_source has {len(self.focal_source)} values; expected {cameras}, one for each camera"
            )

    def __len__(self) -> int:
        return len(self.names)
