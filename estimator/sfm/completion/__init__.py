"""Longer tracks of a finished reconstruction: tracks of one point are merged, and features are added to its points."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.sfm.completion.guided import add_observations
    from dronevio.estimator.sfm.completion.merging import merge_tracks

__all__ = ["add_observations", "merge_tracks"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.sfm.completion.guided": ("add_observations",),
        "dronevio.estimator.sfm.completion.merging": ("merge_tracks",),
    },
)
