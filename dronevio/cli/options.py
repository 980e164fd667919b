"""Groups of options that several commands have in common.

A command has such a group as a field of one of the annotated types, whose options carry no prefix on the command line.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dronevio.models.ranges import Settings
from dronevio.models.recordings.bag.options import BagTopics

if TYPE_CHECKING:
    from dronevio.models.recordings.open import StoredRecording


@dataclass(frozen=True)
class PrintOptions:
    """How a command prints its result."""

    json: bool = False
    """Print one JSON document instead of tables."""


@dataclass(frozen=True)
class OutputOptions(PrintOptions):
    """How a command writes and prints its result."""

    overwrite: bool = False
    """Replace an earlier result of this command. The replacement takes place when the new result is complete."""


@dataclass(frozen=True)
class RecordingOptions(Settings):
    """How a command reads a recording."""

    cameras: tuple[str, ...] | None = None
    """Cameras to use, by index or name: 0 or cam0, 1 or cam1, and so on. The first one is the main camera. All cameras
    are used by default."""
    calibration: tuple[Path, ...] = ()
    """Calibration files that replace or complete that of the recording: Kalibr's camchain.yaml, imu.yaml or both, or
    Basalt's calibration.json."""
    imu: str | None = None
    """IMU whose noise parameters replace those of the recording, or supply them where they are unknown: euroc,
    ADIS16448, BMI088, MPU-6050 or tactical."""
    imu_rotation: str | None = None
    """Axes of the IMU of a video along x (right), y (down) and z (forward) of the camera, where a small letter is the
    opposite direction: yxz for GoPro cameras, which is the default. With estimate, the rotation of the images against
    the gyroscope tells them. It replaces the pose of the calibration."""
    topics: BagTopics = field(default_factory=BagTopics)
    """Topics of a bag that has several of one type."""

    def open(self, path: Path, repair: bool = False) -> "StoredRecording":
        """Open a recording.

        Args:
            path: The recording.
            repair: Whether to go on with its defects and to list them.

        Raises:
            InputError: It cannot be read.
            ConfigError: A camera does not exist, or there is no IMU of the given name.
        """
        from dronevio.models.recordings.open import open_recording

        imu = None
        if self.imu is not None:
            from dronevio.models.imu_presets import imu_named

            imu = imu_named(self.imu)
        is_estimated = self.imu_rotation == "estimate"
        axes = "XYZ" if is_estimated else self.imu_rotation
        recording = open_recording(path, self.cameras, self.calibration, self.topics, repair, imu, axes)
        if is_estimated:
            from dronevio.models.recordings.gopro import VideoRecording
            from dronevio.recording.imu_rotation import with_estimated_rotation

            assert isinstance(recording, VideoRecording)  # others refuse the option
            recording = with_estimated_rotation(recording)
        return recording


_without_prefix = tyro.conf.arg(name="")
Printing = Annotated[PrintOptions, _without_prefix]
Output = Annotated[OutputOptions, _without_prefix]
RecordingInput = Annotated[RecordingOptions, _without_prefix]
