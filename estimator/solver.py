"""The solver under the smoother: GTSAM's incremental fixed-lag smoother over poses, velocities and biases of keyframes.

Adds to it what it lacks: a linearisation that follows the estimate where iSAM2 (Kaess et al., IJRR 2012) would hold it.
"""

from collections.abc import Sequence
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X

Array = npt.NDArray[np.float64]
Stamps = dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex]


class FixedLagSolver:
    """Holds the factors of a window, and marginalises what is older than the lag into a linear prior."""

    def __init__(self, lag_s: float, relinearise_threshold: float) -> None:
        self._lag_s = lag_s
        self._relinearise_threshold = relinearise_threshold
        self._isam = self._new()

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: Stamps, removed: Sequence[int] = ()
    ) -> list[int]:
        """Add factors and variables, take one step, and let go of what left the window.

        Args:
            graph: New factors.
            values: First values of the new variables.
            stamps: Their times [s].
            removed: Slots of factors to remove.

        Returns:
            The slots that the new factors got.

        Raises:
            RuntimeError: The linear system has no unique solution.
        """
        self._isam.update(graph, values, stamps, removed)
        return list(self._isam.getISAM2Result().getNewFactorsIndices())

    @property
    def keyframes(self) -> list[int]:
        """The keyframes in the window, in order."""
        return sorted({gtsam.symbolIndex(key) for key in self._isam.timestamps()})

    def pose(self, k: int) -> gtsam.Pose3:
        """Return the pose of the IMU at a keyframe."""
        return self._isam.calculateEstimatePose3(X(k))

    def velocity(self, k: int) -> Array:
        """Return its velocity (3,) [m/s]."""
        return np.asarray(self._isam.calculateEstimateVector(V(k)))

    def bias(self, k: int) -> gtsam.imuBias.ConstantBias:
        """Return its biases."""
        return self._isam.calculateEstimateConstantBias(B(k))

    def covariance(self, k: int) -> Array:
        """Return the covariance (15, 15) of a keyframe's pose, velocity and biases, in GTSAM's order."""
        return np.asarray(self._isam.getISAM2().jointMarginalCovariance([X(k), V(k), B(k)]).fullMatrix())

    def drift_from_linearisation(self) -> float:
        """Return how far the farthest pose of the window is from where it was linearised [rad or m]."""
        delta = self._isam.getDelta()
        return max(float(np.abs(delta.at(X(k))).max()) for k in self.keyframes)

    def linearise_anew(self) -> dict[int, int]:
        """Put the window's factors into a new solver, linearised where the window is now.

        iSAM2 never moves the linearisation of a variable that the marginal prior touches, and with smart factors it
        soon touches most of the window. Where the estimate has moved far meanwhile, what it then marginalises is wrong.
        The prior itself stays linear, about the point at which it was made.

        Returns:
            The new slot of each old one.

        Raises:
            RuntimeError: The linear system has no unique solution; the solver is then what it was.
        """
        old, origin = self._isam.getFactors(), self._isam.getLinearizationPoint()
        graph, places = gtsam.NonlinearFactorGraph(), {}
        for slot in range(old.size()):
            if not old.exists(slot):
                continue
            factor = old.at(slot)
            if isinstance(factor, gtsam.LinearContainerFactor):
                factor = gtsam.LinearContainerFactor(factor.factor(), _restricted(origin, factor.keys()))
            places[slot] = graph.size()
            graph.add(factor)
        isam = self._new()
        stamps: Stamps = dict(self._isam.timestamps().items())
        isam.update(graph, self._isam.calculateEstimate(), stamps, [])
        self._isam = isam
        slots = isam.getISAM2Result().getNewFactorsIndices()
        return {slot: slots[place] for slot, place in places.items()}

    def _new(self) -> gtsam.IncrementalFixedLagSmoother:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(self._relinearise_threshold)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(self._lag_s, params)


def stamps_of(k: int, t_ns: int) -> Stamps:
    """Return the time of a keyframe's variables."""
    return {key(k): t_ns * 1e-9 for key in (X, V, B)}


def insert_state(values: gtsam.Values, k: int, nav: gtsam.NavState, bias: gtsam.imuBias.ConstantBias) -> None:
    """Add a keyframe's variables to some values."""
    values.insert(X(k), nav.pose())
    values.insert(V(k), nav.velocity())
    values.insert(B(k), bias)


def _restricted(values: gtsam.Values, keys: Sequence[int]) -> gtsam.Values:
    """Return the poses, velocities and biases of some keys alone."""
    found = gtsam.Values()
    for key in keys:
        match chr(gtsam.symbolChr(key)):
            case "x":
                found.insert(key, values.atPose3(key))
            case "v":
                found.insert(key, values.atVector(key))
            case _:
                found.insert(key, values.atConstantBias(key))
    return found
