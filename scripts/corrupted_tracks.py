"""Front ends whose tracks contain simulated outliers, to measure the robustness of the back end."""

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
_JUMP = 0.1  # standard deviation of independent errors relative to depth, 46 px at EuRoC's focal length
_DRIFT = 0.003  # standard deviation of the drift per frame relative to depth, 1.4 px: a person at some metres' distance
_FOCAL_PX = 458.0


class OutlierFrontEnd:
    """Adds errors to a share of the tracks of another front end; is a `FrontEnd`.

    The tracks are selected by their identity, for as long as they last. One half of them has independent errors in
    every frame. The other half drifts at a constant rate, as tracks on moving objects do, which is harder to detect.
    """

    def __init__(self, inner: FrontEnd, share: float = OUTLIER_SHARE, seed: int = 0) -> None:
        """Wrap a front end.

        Args:
            inner: The front end that tracks.
            share: Share of the tracks that become outliers, 0 to 1.
            seed: Seed of the selection and of the errors.
        """
        self._inner, self._share, self._seed = inner, share, seed
        self._frames = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def track(self, frame: CameraFrame, *motion: Any, **options: Any) -> Observations:
        """Track the features into a frame, and add errors to some of them."""
        self._frames += 1
        return self._corrupted(self._inner.track(frame, *motion, **options))

    def replenish(self, rig: Rig | None = None) -> Observations:
        """Detect new features with a calibration, and add the same errors as in `track`."""
        return self._corrupted(self._inner.replenish(rig))

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking features with the given identities (N,)."""
        self._inner.discard(ids)

    def _corrupted(self, observed: Observations) -> Observations:
        offset = self.offsets(observed.ids, observed.ages)
        return replace(observed, xy=observed.xy + offset, pixels=observed.pixels + _FOCAL_PX * offset)

    def offsets(self, ids: npt.NDArray[np.int64], ages: npt.NDArray[np.int64]) -> Array:
        """Return the errors (N, 2) of features in the current frame in normalized image coordinates.

        Args:
            ids: (N,) Identities of the features.
            ages: (N,) Number of frames in which each feature has been observed.
        """
        size = int(ids.max(initial=0)) + 1
        selection, kind = np.random.default_rng([self._seed, 0]).random((size, 2))[ids].T
        drift = np.random.default_rng([self._seed, 1]).normal(size=(size, 2))[ids]
        jump = np.random.default_rng([self._seed, 2, self._frames]).normal(size=(size, 2))[ids]
        error = np.where(kind[:, None] < 0.5, _JUMP * jump, _DRIFT * drift * (ages[:, None] - 1))
        return np.asarray(np.where(selection[:, None] < self._share, error, 0.0))


CORRUPTED_FRONT_ENDS: dict[str, Callable[[FrontEnd], FrontEnd]] = {"outliers": OutlierFrontEnd}
"""Functions that wrap the front end of the estimator, by name."""
