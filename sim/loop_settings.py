"""Settings of control loops that are closed over an estimator."""

from dataclasses import dataclass

import numpy as np

from dronevio.models.errors import ConfigError


@dataclass(frozen=True)
class LoopSettings:
    """Latencies of a flight on the estimated state."""

    frame_latency_s: float = 0.03
    """Time from the middle of an exposure until the estimate of the frame is available to the controller: transfer and
    processing of the images [s]. In between, the IMU propagates the last estimate."""
    command_latency_s: float = 0.0
    """Time from the computation of a command until it reaches the rotors, rounded to intervals of the IMU [s]; the
    interval in which it is computed comes in addition."""
    max_wait_s: float = 15.0
    """Longest time for which the vehicle waits on the pad for the first state, beyond the planned take-off [s]."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: A value is negative or not finite.
        """
        for name, value in vars(self).items():
            if not 0.0 <= value < np.inf:
                raise ConfigError(f"{name} = {value}; expected 0 or a positive number of seconds")
