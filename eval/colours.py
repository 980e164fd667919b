"""Colours of plots and recordings: a quantity has the same colour in a report and in the rerun viewer.

They are those of Okabe and Ito (2008), which people with any colour vision can distinguish.
"""

import numpy as np
import numpy.typing as npt

TRUTH = "#009e73"
"""Colour of the ground truth: bluish green."""
ESTIMATE = "#d55e00"
"""Colour of an estimate: vermilion."""
SIGMA = "#56b4e9"
"""Colour of 3σ bands of estimated covariances: sky blue."""
SECOND = "#0072b2"
"""Colour of a second quantity beside an estimate: blue."""
ESTIMATORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colours of several estimators, in order; further ones begin again with another marker."""
AXES = ("#d55e00", "#009e73", "#56b4e9")
"""Colours of the axes x, y and z."""
AXES_PALE = ("#e8a57a", "#7cc9b2", "#b0daf2")
"""Colours of the axes x, y and z of a quantity in the background."""
CORRECTED = SECOND
"""Colour of an estimate that a map corrects: blue."""
LOOP = "#cc79a7"
"""Colour of loops between keyframes: purple."""
REJECTED_LOOP = "#e69f00"
"""Colour of loops that contradict the others: orange."""
PLAN = "#e69f00"
"""Colour of planned trajectories: orange."""
ROUTE = "#cc79a7"
"""Colour of routes: purple."""
LANDMARKS = "#f0e442"
"""Colour of landmarks: yellow."""
SURROUNDINGS = "#8a8f98"
"""Colour of the surroundings: grey."""

_OLDEST_TRACK_FRAMES = 60
_STOPS = np.array([[70, 110, 200], [33, 145, 140], [94, 201, 98], [253, 231, 37]])  # viridis without its dark end


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the red, green and blue values (0–255) of ``#rrggbb``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def age_colours(ages_frames: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """Return (N, 3) RGB colours of feature tracks by age: blue for new ones, yellow from 60 frames on.

    The scale is logarithmic because most tracks are short.
    """
    return _on_scale(np.log(np.clip(ages_frames, 1, _OLDEST_TRACK_FRAMES)) / np.log(_OLDEST_TRACK_FRAMES))


def residual_colours(errors_px: npt.NDArray[np.float64], limit_px: float) -> npt.NDArray[np.uint8]:
    """Return (N, 3) RGB colours of reprojection errors: blue for zero, yellow from a limit on, grey for NaN."""
    level = np.clip(np.nan_to_num(errors_px) / max(limit_px, np.finfo(float).tiny), 0.0, 1.0)
    return np.where(np.isnan(errors_px)[:, None], np.array(rgb(SURROUNDINGS), np.uint8), _on_scale(level))


def height_colours(z_m: npt.NDArray[np.float64], low_m: float, high_m: float) -> npt.NDArray[np.uint8]:
    """Return (N, 3) RGB colours of heights: blue at the low end or below, yellow at the high end or above."""
    return _on_scale(np.clip((z_m - low_m) / max(high_m - low_m, np.finfo(float).tiny), 0.0, 1.0))


def _on_scale(level: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    """Return (N, 3) RGB colours of levels (N,) from 0, blue, to 1, yellow."""
    stops = np.linspace(0.0, 1.0, len(_STOPS))
    return np.stack([np.interp(level, stops, channel) for channel in _STOPS.T], axis=-1).round().astype(np.uint8)
