"""What the images see of a growing reconstruction, by which the next image is chosen.

The score of an image is larger the more evenly the visible points cover it, in grids of several levels (Schönberger and
Frahm, "Structure-from-motion revisited", CVPR 2016, section 4.2).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.models.arrays import Array

Indices = npt.NDArray[np.int64]

VISIBILITY_LEVELS = 6
"""Number of levels of the grids that measure how evenly the visible points cover an image."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """What the images see of the points, by which the next image is chosen."""

    cells: Indices
    """(M, 2) Column and line of the cell of each observation in the finest grid of its image."""
    points: Indices
    """(I,) Number of points that each image observes."""
    score: Array
    """(I,) How evenly they cover it."""

    @classmethod
    def of(cls, scene: Scene, state: SfmState) -> Self:
        """Return the visibility of all points."""
        sizes = np.array([[camera.width, camera.height] for camera in state.cameras])
        relative = (scene.pixels + 0.5) / sizes[scene.image_camera[scene.tracks.image]]
        cells = (np.clip(relative, 0.0, 1.0 - 1e-9) * 2**VISIBILITY_LEVELS).astype(np.int64)
        none = cls(cells, np.zeros(scene.images, np.int64), np.zeros(scene.images))
        return none.updated(scene, state, np.arange(scene.images))

    def updated(self, scene: Scene, state: SfmState, images: Indices) -> Self:
        """Return the visibility in which that of some images, in increasing order, is computed anew."""
        index = np.concatenate([scene.tracks.of_image(image) for image in images.tolist()])
        index = index[state.has_point[scene.tracks.track[index]]]
        row, (column, line) = np.searchsorted(images, scene.tracks.image[index]), self.cells[index].T
        occupied = np.zeros((len(images), 2**VISIBILITY_LEVELS, 2**VISIBILITY_LEVELS), np.bool_)
        occupied[row, column, line] = True
        score = np.zeros(len(images))
        for level in range(VISIBILITY_LEVELS, 0, -1):
            score += 4**level * occupied.sum(axis=(1, 2))
            occupied = occupied[:, ::2] | occupied[:, 1::2]
            occupied = occupied[:, :, ::2] | occupied[:, :, 1::2]
        points, scores = self.points.copy(), self.score.copy()
        points[images], scores[images] = np.bincount(row, minlength=len(images)), score
        return replace(self, points=points, score=scores)
