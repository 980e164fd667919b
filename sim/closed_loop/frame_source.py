"""Interface of cameras whose frames are rendered one at a time, while a flight goes on."""

from typing import Protocol

from dronevio.models.state import CameraFrame, Trajectory


class FrameSource(Protocol):
    """Renders the frames of a flight while it goes on; `LiveCameras` implements it."""

    def ready_ns(self, exposed_ns: int) -> int:
        """Return the time from which a frame can be rendered [ns], given the middle of its exposure [ns]."""

    def frame(self, t_ns: int, exposed_ns: int, lit: bool, truth: Trajectory) -> CameraFrame:
        """Return a frame.

        Args:
            t_ns: Time stamp on the clock of the cameras [ns].
            exposed_ns: True middle of the exposure on the clock of the IMU [ns].
            lit: Whether light reaches the cameras.
            truth: True motion of the IMU around the exposure.
        """
