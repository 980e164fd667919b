"""The colours of every picture: the same thing has the same colour in the report and in the recording.

From Okabe and Ito's palette (2008), which people with any colour vision can tell apart.
"""

import numpy as np
import numpy.typing as npt

TRUTH = "#009e73"
"""What really happened: bluish green."""
ESTIMATE = "#d55e00"
"""What the estimator said: vermilion."""
BAND = "#56b4e9"
"""What the estimator holds possible, 3σ: sky blue."""
CLAIM = "#0072b2"
"""A second thing beside the estimate: blue."""
ESTIMATORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Estimators beside each other, in order; after the last the first comes again, with another mark."""
AXES = ("#d55e00", "#009e73", "#56b4e9")
"""x, y and z."""
AXES_PALE = ("#e8a57a", "#7cc9b2", "#b0daf2")
"""x, y and z, for what stands behind."""
MAP = "#f0e442"
"""What the estimator found in space: yellow."""
ROOM = "#8a8f98"
"""What stands around: grey."""

_OLDEST_TRACK_FRAMES = 60
_AGE_STOPS = np.array([[70, 110, 200], [33, 145, 140], [94, 201, 98], [253, 231, 37]])  # viridis without its dark end


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the red, green and blue (0–255) of ``#rrggbb``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def age_colours(ages_frames: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """Return (N, 3) RGB colours of tracks by age: blue when new, yellow from 60 frames (3 s at 20 Hz) on.

    The scale is logarithmic, as most tracks die young.
    """
    level = np.log(np.clip(ages_frames, 1, _OLDEST_TRACK_FRAMES)) / np.log(_OLDEST_TRACK_FRAMES)
    stops = np.linspace(0.0, 1.0, len(_AGE_STOPS))
    return np.stack([np.interp(level, stops, channel) for channel in _AGE_STOPS.T], axis=-1).round().astype(np.uint8)
