"""Front ends that are spoilt on purpose: a share of the tracks is wrong, and nobody tells the back end."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.types import Observations
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame

Array = npt.NDArray[np.float64]

OUTLIER_SHARE = 0.2
_STRAY = 0.1  # of depth: how far a random outlier is off, 46 px at EuRoC's focal length
_DRIFT = 0.003  # of depth a frame: 1.4 px, what a person walking by at some metres' distance does
_FOCAL_PX = 458.0


class Outliers:
    """Moves a share of the tracks that a front end follows, beyond what its own checks see; is a `FrontEnd`.

    Which tracks lie is drawn by identity, for as long as they are followed. Half of them are thrown about anew in every
    frame; the others drift at a constant rate, as features of moving things do, which is harder to see.
    """

    def __init__(self, inner: FrontEnd, share: float = OUTLIER_SHARE, seed: int = 0) -> None:
        """Spoil a front end.

        Args:
            inner: The good one.
            share: Which share of its tracks is to be wrong, 0 to 1.
            seed: Draws which, and how.
        """
        self._inner, self._share, self._seed = inner, share, seed
        self._frames = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def track(self, frame: CameraFrame, *motion: Any, **more: Any) -> Observations:
        """Follow the features into a frame; some of them elsewhere."""
        self._frames += 1
        return self._spoilt(self._inner.track(frame, *motion, **more))

    def replenish(self, rig: Rig | None = None) -> Observations:
        """Look for new features; those that lie go on doing so."""
        return self._spoilt(self._inner.replenish(rig))

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Follow some features no further."""
        self._inner.discard(ids)

    def _spoilt(self, seen: Observations) -> Observations:
        offset = self.offsets(seen.ids, seen.ages)
        return replace(seen, xy=seen.xy + offset, pixels=seen.pixels + _FOCAL_PX * offset)

    def offsets(self, ids: npt.NDArray[np.int64], ages: npt.NDArray[np.int64]) -> Array:
        """Return by how much (N, 2) features of some identities and ages are moved in this frame, at depth 1."""
        size = int(ids.max(initial=0)) + 1
        lying, thrown = np.random.default_rng([self._seed, 0]).random((size, 2))[ids].T
        drift = np.random.default_rng([self._seed, 1]).normal(size=(size, 2))[ids]
        stray = np.random.default_rng([self._seed, 2, self._frames]).normal(size=(size, 2))[ids]
        wrong = np.where(thrown[:, None] < 0.5, _STRAY * stray, _DRIFT * drift * (ages[:, None] - 1))
        return np.asarray(np.where(lying[:, None] < self._share, wrong, 0.0))


FRONT_ENDS: dict[str, Callable[[FrontEnd], FrontEnd]] = {"outliers": Outliers}
"""Ways to spoil a front end, by name: each takes the estimator's own and returns another."""
