"""Settings of control loops that are closed over an estimator."""

from dataclasses import dataclass
from typing import Annotated

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class LoopSettings(Settings):
    """Latencies of a flight on the estimated state."""

    frame_latency_s: Annotated[float, Range(0.0, 1.0)] = 0.03
    """Time from the middle of an exposure until the estimate of the frame is available to the controller: transfer and
    processing of the images [s]. In between, the IMU propagates the last estimate."""
    command_latency_s: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Time from the computation of a command until it reaches the rotors, rounded to intervals of the IMU [s]; the
    interval in which it is computed comes in addition."""
    max_wait_s: Annotated[float, Range(0.0, 300.0)] = 15.0
    """Longest time for which the vehicle waits on the pad for the first state, beyond the planned take-off [s]."""
