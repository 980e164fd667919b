"""Recordings of flights, and trajectories, as files: what other programs wrote and what they will read."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.models.recordings.euroc import EurocRecording, write_euroc, write_euroc_recording
    from dronevio.models.recordings.kitti import read_kitti, write_kitti
    from dronevio.models.recordings.open import open_recording, read_trajectory
    from dronevio.models.recordings.tum import read_tum, write_tum

__all__ = [
    "EurocRecording",
    "open_recording",
    "read_kitti",
    "read_trajectory",
    "read_tum",
    "write_euroc",
    "write_euroc_recording",
    "write_kitti",
    "write_tum",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.models.recordings.euroc": ("EurocRecording", "write_euroc", "write_euroc_recording"),
        "dronevio.models.recordings.kitti": ("read_kitti", "write_kitti"),
        "dronevio.models.recordings.open": ("open_recording", "read_trajectory"),
        "dronevio.models.recordings.tum": ("read_tum", "write_tum"),
    },
)
