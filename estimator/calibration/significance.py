"""Which corrections are significant, independent of the axes in which their parameters are expressed."""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.parameters import ParameterGroup
from dronevio.models.arrays import Array

REFINEMENT_SIGMAS = 1.0
"""Significance of further corrections of parameters that are known to be wrong."""
STATIONARY_SIGMAS = 4.0
"""Significance of a first correction by a window that begins at rest, or by a part of it: systematic errors of the
take-off dominate there."""


@dataclass(frozen=True)
class SignificanceTest:
    """How much a group of parameters must differ from the calibration in use before it is corrected."""

    first_rotation_rad: float
    """Smallest first correction of the rotations, over all cameras together [rad]."""
    rotation_rad: float
    """That of rotations that have been corrected before, without `CalibratedPart.refinement` [rad]."""
    min_sigmas: float = 0.0
    """Smallest significance of a first correction, in standard deviations."""
    by_component: bool = False
    """Whether each parameter is tested by itself, and not along the principal axes of the covariance. These are more
    sensitive, also to errors of the states of a window that begins in motion."""
    corrects_intrinsics: bool = True
    """Whether intrinsics are corrected. They need the views of a complete window: a part of one, and a single keyframe,
    explain by them what other errors have made of a few views."""

    @classmethod
    def of_window(
        cls, config: CalibrationConfig, cameras: int, *, begins_stationary: bool, is_complete: bool
    ) -> "SignificanceTest":
        """Return the test of a window of keyframes; the smallest rotation is the root mean square over the cameras."""
        rotation_rad = config.rotation.min_correction * np.sqrt(cameras)
        if begins_stationary:
            return cls(rotation_rad, rotation_rad, STATIONARY_SIGMAS, corrects_intrinsics=is_complete)
        first_rad = max(config.rotation.min_correction, config.min_motion_correction) * np.sqrt(cameras)
        return cls(first_rad, rotation_rad, by_component=True)

    def is_passed(self, group: ParameterGroup, difference: Array, covariance: Array, *, is_first: bool) -> bool:
        """Return whether a group is corrected.

        Args:
            group: The parameters.
            difference: (D,) Estimate of all parameters minus the corrections in use.
            covariance: (D, D) Covariance of the estimate.
            is_first: Whether the group has not been corrected before.
        """
        part, rows = group.config, group.rows
        if group.is_intrinsic and not self.corrects_intrinsics:
            return False
        smallest, sigmas = part.min_correction, part.significance
        if group.is_rotation:
            smallest = self.first_rotation_rad if is_first else self.rotation_rad
        if is_first or part.refinement == 1.0:
            sigmas = max(sigmas, self.min_sigmas)
        else:
            smallest, sigmas = part.refinement * smallest, min(sigmas, REFINEMENT_SIGMAS)
        of_group = covariance[np.ix_(rows, rows)]
        of_group = np.diag(np.diag(of_group)) if self.by_component else of_group
        return significant_length(difference[rows], of_group, sigmas) > smallest


def significant_length(difference: Array, covariance: Array, sigmas: float) -> float:
    """Return the length of the significant part of a correction, in the unit of its parameters.

    The correction is decomposed along the principal axes of its covariance. A component counts if it is larger than
    some standard deviations. The rotation between two cameras, for example, is often known to a tenth of the
    uncertainty of their common rotation, which no single parameter shows.

    Args:
        difference: (n,) Estimate minus the value in use.
        covariance: (n, n) Covariance of the estimate.
        sigmas: Number of standard deviations beyond which a component is significant.
    """
    variances, axes = np.linalg.eigh(covariance)
    components = axes.T @ difference
    significant = np.abs(components) > sigmas * np.sqrt(np.maximum(variances, 0.0))
    return float(np.linalg.norm(components[significant]))
