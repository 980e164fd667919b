"""Content of calibration files: cameras, an IMU or both, from one or more files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuModel, Sampling
from dronevio.models.recordings.files import as_input_error
from dronevio.models.rig import Rig, RigCamera


@dataclass(frozen=True, eq=False)
class Calibration:
    """Content of calibration files: cameras, an IMU or both."""

    paths: tuple[Path, ...]
    """Paths of the files."""
    cameras: tuple[RigCamera, ...]
    """Cameras of the files, possibly none."""
    topics: tuple[str, ...]
    """Image topic of each camera, empty if it is not specified."""
    time_offset_s: float
    """Time offset of the first camera: t_imu = t_cam + offset [s]; those of the others are relative to it."""
    imu: ImuModel | None
    """IMU of the files, None if there is none."""
    T_vehicle_imu: Array
    """(4, 4) Pose of the IMU in the vehicle frame, the identity if it is not specified."""
    sampling: Sampling
    """Sampling of the IMU."""
    is_mounted: bool = True
    """Whether the poses of the cameras are those in the IMU frame; otherwise they are those in the frame of the first
    camera."""

    @classmethod
    def combined(cls, parts: Sequence["Calibration"]) -> "Calibration":
        """Return the calibration of several files, each with cameras, an IMU or both.

        Raises:
            InputError: Two files have cameras, or two have an IMU.
        """
        chain = _only([part for part in parts if part.cameras], "cameras")
        imu = _only([part for part in parts if part.imu is not None], "an IMU")
        cameras, motion = chain or parts[0], imu or parts[0]
        return cls(
            paths=tuple(path for part in parts for path in part.paths),
            cameras=cameras.cameras,
            topics=cameras.topics,
            time_offset_s=cameras.time_offset_s,
            imu=motion.imu,
            T_vehicle_imu=motion.T_vehicle_imu,
            sampling=motion.sampling,
            is_mounted=cameras.is_mounted,
        )

    def rig(self) -> Rig:
        """Return the rig of the cameras and the IMU.

        Raises:
            InputError: The files have no camera, no IMU, or no pose of one to the other.
        """
        if not self.cameras:
            raise InputError(self.paths[0], "no camera", "Kalibr's camchain.yaml: cam0 with intrinsics and T_cam_imu")
        if not self.is_mounted:
            raise InputError(
                self.paths[0],
                "no field cam0.T_cam_imu",
                "the pose of the IMU in the camera frame, a result of kalibr_calibrate_imu_camera",
            )
        if self.imu is None:
            raise InputError(self.paths[0], "no IMU", "Kalibr's imu.yaml as well, with the noise densities")
        with as_input_error(self.paths[0]):
            return Rig(self.cameras, self.imu, self.T_vehicle_imu, self.time_offset_s)


def _only(parts: list[Calibration], what: str) -> Calibration | None:
    """Return the only one of some parts, None if there is none, or raise InputError if there are several."""
    if len(parts) > 1:
        raise InputError(parts[1].paths[0], f"{what}, which {parts[0].paths[0]} has as well", f"one file with {what}")
    return parts[0] if parts else None
