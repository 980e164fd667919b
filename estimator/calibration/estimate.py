"""The estimate of the calibration by all windows: an information filter, and which corrections are applied.

The posterior of a window's adjustment is the prior of the next one, so that what no motion has made observable keeps
the prior of the given calibration. A group of parameters is corrected where it differs from the calibration in use by
more than the uncertainty explains and by enough to matter. It follows the estimate from then on.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.corrections import GRAVITY, MEAN_RADIUS2, ROWS_PER_CAMERA, Corrections, seen_errors
from dronevio.estimator.calibration.parameters import ParameterTable, largest_chi2
from dronevio.estimator.calibration.significance import SignificanceTest
from dronevio.estimator.types import CalibrationSigmas
from dronevio.models.arrays import Array

INFLATION_CORRECTION = (5e-3, np.radians(1.0))
"""Corrections of time offset [s], and of rotation [rad] and intrinsics, which turn directions as much, to which
`CalibrationConfig.inflation_sigmas` correspond."""
MAX_INVERSE_DEPTH_ERROR = 0.02
"""Largest error of inverse depths by stereo [1/m] that a corrected calibration may have."""
MAX_ROTATION_ERROR = 0.0112
"""Largest standard deviation of the rotation of a view by which a refuted calibration is known again [rad]: half of the
prior."""
MAX_DISAGREEMENT = 3.0
"""Standard deviations of χ² above its mean up to which intrinsics in use agree with an estimate."""
MIN_INFLATION = 0.03
"""Smallest share of these that is applied, however small a correction is."""


@dataclass(frozen=True, eq=False)
class ParameterEstimate:
    """What is known of the D corrections after some windows, and those that are applied."""

    mean: Array
    """(D,) Estimated corrections, whether they are applied or not."""
    covariance: Array
    """(D, D) Covariance of the estimated corrections."""
    newest_mean: Array
    """(D,) Those by the last adjustment, also of a part of a window, or by the prior."""
    newest_covariance: Array
    """(D, D) Their covariance."""
    applied: Array
    """(D,) Corrections that are applied to the given calibration."""
    newest_change: Array
    """(D,) Change of these by the last correction."""
    follows: npt.NDArray[np.bool_]
    """(D,) Whether a parameter has been corrected, and follows the estimate."""
    is_plausible: bool = True
    """Whether all corrections so far have been plausible."""
    updated_ns: int | None = None
    """Time of the last complete window; None before the first [ns]."""

    def errors(self, A: Array) -> Array:
        """Return standard deviations (n,) of linear combinations (n, D) of the errors of the calibration in use.

        They contain what has been estimated and is not applied, because it is too small or not significant.
        """
        variances = np.einsum("ni,ij,nj->n", A, self.newest_covariance, A)
        return np.asarray(np.sqrt(variances + (A @ (self.newest_mean - self.applied)) ** 2))

    @cached_property
    def seen_sigmas(self) -> CalibrationSigmas:
        """Standard deviations of what the first camera shows of the errors of the calibration in use."""
        offset_s, *view_rad, focal, radial = self.errors(seen_errors(len(self.mean)))
        return CalibrationSigmas(float(offset_s), float(max(view_rad)), float(np.hypot(focal, MEAN_RADIUS2 * radial)))

    def is_refuted(self, parameters: ParameterTable) -> bool:
        """Return whether images have refuted given rotations or intrinsics."""
        return bool((self.follows & parameters.is_of_images).any())

    def is_known(self, parameters: ParameterTable) -> bool:
        """Return whether the given calibration is not refuted, or the rotation of the first camera is known again."""
        return not self.is_refuted(parameters) or self.seen_sigmas.rotation_rad < MAX_ROTATION_ERROR

    def cameras_without_depth(self, parameters: ParameterTable) -> frozenset[int]:
        """Return the indices of the cameras whose matches do not determine depths.

        The given calibration is presumed to determine them until images refute it; from then on, it must be known.
        """
        if not self.is_refuted(parameters):
            return frozenset()
        errors = self.errors(parameters.inverse_depth_errors)
        return frozenset((np.flatnonzero(errors > MAX_INVERSE_DEPTH_ERROR) // ROWS_PER_CAMERA).tolist())

    @classmethod
    def prior(cls, parameters: ParameterTable) -> "ParameterEstimate":
        """Return the estimate before any window."""
        zeros, covariance = np.zeros_like(parameters.sigmas), np.diag(parameters.sigmas**2)
        return cls(zeros, covariance, zeros, covariance, zeros, zeros, np.zeros(len(zeros), dtype=np.bool_))

    def predicted(self, t_ns: int, walk: Array) -> "ParameterEstimate":
        """Return the estimate at the time of a window [ns], with the random walk (D,) since the one before."""
        elapsed_s = 0.0 if self.updated_ns is None else (t_ns - self.updated_ns) * 1e-9
        return replace(self, covariance=self.covariance + np.diag(walk**2 * elapsed_s), updated_ns=t_ns)

    def fused(self, mean: Array, covariance: Array, *, is_complete: bool) -> "ParameterEstimate":
        """Return the estimate after an adjustment, of which this one is the prior.

        Those that follow the adjustment of a part of a window contain its observations, too, so that its result is not
        kept.

        Args:
            mean: (D,) Corrections by the adjustment.
            covariance: (D, D) Their covariance.
            is_complete: Whether the adjustment is that of a complete window.
        """
        if not is_complete:
            return replace(self, newest_mean=mean, newest_covariance=covariance)
        newest = replace(self, newest_mean=mean, newest_covariance=covariance)
        return replace(newest, mean=mean, covariance=covariance)

    def corrected(
        self, mean: Array, covariance: Array, parameters: ParameterTable, test: SignificanceTest, *, is_complete: bool
    ) -> "ParameterEstimate | None":
        """Return the estimate with the corrections applied that are significant; None where none is.

        Args:
            mean: (D,) Corrections by the last adjustment.
            covariance: (D, D) Their covariance.
            parameters: The parameters.
            test: Determines what is significant.
            is_complete: Whether the adjustment is that of a complete window, so that its result is kept.
        """
        # Significance of each group; that of rotations with the intrinsics in use, if these agree with the estimate
        joint, is_wrong = (mean, covariance), np.zeros(len(mean), np.bool_)
        rotations = given_values(*joint, parameters.is_intrinsic & ~self.follows, self.applied)
        for group in parameters.groups:
            by, P = rotations if group.is_rotation else joint
            is_first = not self.follows[group.rows[0]]
            is_wrong[group.rows] = test.is_passed(group, by - self.applied, P, is_first=is_first)
        if not is_wrong.any():
            return None
        # Rotations and intrinsics together, if corrections of some of them would leave wrong depths
        follows = self.follows | is_wrong
        best, _ = given_values(*joint, parameters.is_of_images & ~follows, self.applied)
        left = np.where(follows, best, self.applied) - mean
        if (np.abs(parameters.inverse_depth_errors @ left) > MAX_INVERSE_DEPTH_ERROR).any():
            follows |= parameters.is_of_images
        mean, covariance = with_wider_prior(mean, covariance, parameters.sigmas, is_wrong & ~self.follows)
        best, _ = given_values(mean, covariance, parameters.is_of_images & ~follows, self.applied)
        applied = np.where(follows, best, self.applied)
        change = applied - self.applied
        is_plausible = self.is_plausible and parameters.are_plausible(applied, joint[0])
        known = self.fused(mean, covariance, is_complete=is_complete)
        return replace(known, applied=applied, newest_change=change, follows=follows, is_plausible=is_plausible)


def given_values(mean: Array, covariance: Array, is_given: npt.NDArray[np.bool_], values: Array) -> tuple[Array, Array]:
    """Return an estimate given that some parameters have certain values, if these agree with it, else the estimate.

    Args:
        mean: (D,) Estimated corrections.
        covariance: (D, D) Their covariance.
        is_given: (D,) Whether a parameter has the given value.
        values: (D,) These values; others do not count.

    Returns:
        The conditional mean (D,) and covariance (D, D).
    """
    n, known = int(is_given.sum()), np.flatnonzero(is_given)
    difference, P = (values - mean)[known], covariance[np.ix_(known, known)]
    if not n or difference @ np.linalg.solve(P, difference) > largest_chi2(n, MAX_DISAGREEMENT):
        return mean, covariance
    gain = np.linalg.solve(P, covariance[known]).T
    return mean + gain @ difference, covariance - gain @ covariance[known]


def with_wider_prior(
    mean: Array, covariance: Array, sigmas: Array, is_wrong: npt.NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return an estimate whose prior standard deviations are at least the corrections, where the calibration is wrong.

    A correction beyond the standard deviation of the given calibration refutes the latter, which would draw the
    estimate back for the rest of the flight (empirical Bayes).

    Args:
        mean: (D,) Estimated corrections, with a prior of mean zero.
        covariance: (D, D) Their covariance.
        sigmas: (D,) Standard deviations of that prior.
        is_wrong: (D,) Whether the given value of a parameter is known to be wrong.
    """
    wider = np.where(is_wrong, np.maximum(sigmas, np.abs(mean)), sigmas)
    if np.array_equal(wider, sigmas):
        return mean, covariance
    information = np.linalg.inv(covariance)
    widened = np.linalg.inv(information + np.diag(wider**-2.0 - sigmas**-2.0))
    return widened @ (information @ mean), widened


def inflation_share(change: Array) -> float:
    """Return the share of the covariance inflation that a change (D,) of the applied corrections requires."""
    c = Corrections.from_vector(change)
    if c.translation_m.any():
        return 1.0
    of_images = np.concatenate([c.rotation_rad, c.focal, c.principal, c.radial], axis=1)
    sizes = abs(c.time_offset_s), float(np.linalg.norm(of_images))
    return float(np.clip(max(np.divide(sizes, INFLATION_CORRECTION)), MIN_INFLATION, 1.0))


def covariance_inflation(change: Array, config: CalibrationConfig) -> Array:
    """Return the covariance (15, 15) of the error that a change (D,) of the corrections leaves in a state."""
    is_only_gravity = not np.delete(change, GRAVITY).any()
    sigmas = np.array(config.gravity_inflation_sigmas if is_only_gravity else config.inflation_sigmas)
    return np.diag(np.repeat((1.0 if is_only_gravity else inflation_share(change)) * sigmas, 3) ** 2)
