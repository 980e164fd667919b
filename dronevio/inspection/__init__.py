"""Inspection of recordings: what one holds, whether the odometry will work on it, and what to do if not.

`inspect` looks at the time stamps, the IMU samples and some of the images, and returns rows with verdicts. Each module
judges one part; the limits stand at its top, each with its reason.
"""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.inspection.inspection import inspect
    from dronevio.inspection.model import Finding, Inspection, Topic, Verdict

__all__ = ["Finding", "Inspection", "Topic", "Verdict", "inspect"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.inspection.inspection": ("inspect",),
        "dronevio.inspection.model": ("Finding", "Inspection", "Topic", "Verdict"),
    },
)
