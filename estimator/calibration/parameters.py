"""The parameters of the online calibration: their priors, and which of them are corrected together."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.config import CalibratedPart, CalibrationConfig
from dronevio.estimator.calibration.corrections import COMMON_PARAMETERS, GRAVITY, GYRO_SCALE, PARAMETERS_PER_CAMERA
from dronevio.models.arrays import Array, Integers

FIXED_SIGMA = 1e-9
"""Standard deviation of parameters that are known; it keeps the matrices regular."""

REFUTED_SIGMAS, REFUTED_FOCAL_SIGMAS = 1.5, 0.7
"""Prior standard deviations beyond which a change of the intrinsics, and of the focal length, which scales the motion,
shows that the given ones were very wrong."""


def largest_chi2(n: int, sigmas: float) -> float:
    """Return the χ² of n degrees of freedom that is some of its standard deviations above its mean."""
    return n + sigmas * float(np.sqrt(2.0 * n))


@dataclass(frozen=True, eq=False)
class ParameterGroup:
    """Parameters that are corrected together."""

    rows: Integers
    """Their rows in the vector of all parameters."""
    config: CalibratedPart
    """Settings of these parameters."""
    is_rotation: bool = False
    """Whether they are the rotations of all cameras."""
    refuted_sigmas: float | None = None
    """For intrinsics, prior standard deviations beyond which a change shows that the given ones were very wrong."""

    @property
    def is_intrinsic(self) -> bool:
        """Whether they are intrinsics of a camera."""
        return self.refuted_sigmas is not None


@dataclass(frozen=True, eq=False)
class ParameterTable:
    """All D = 3 + 10 C parameters of C cameras, gravity and gyroscope, in the order of `Corrections`."""

    groups: tuple[ParameterGroup, ...]
    """The parameters that are corrected. The rotations of all cameras are one group, because a window determines the
    rotation between two cameras better than that of each."""
    sigmas: Array
    """(D,) Standard deviations of the given calibration."""
    max_sigmas: float
    """Largest plausible correction, in these standard deviations."""
    walk: Array
    """(D,) Random walk, per √s."""
    inverse_depth_errors: Array
    """(2 C, D) What errors of the parameters add to inverse depths by stereo; see `corrections.inverse_depth_errors`.
    """

    @classmethod
    def of(cls, config: CalibrationConfig, cameras: int, inverse_depth_errors: Array | None = None) -> "ParameterTable":
        """Return the parameters of a number of cameras, by default of cameras that share no view.

        The positions of several cameras have a prior also where they are not corrected: errors that stereo matches have
        in common look like another direction of the baseline.
        """
        of_camera = COMMON_PARAMETERS + np.arange(PARAMETERS_PER_CAMERA * cameras).reshape(cameras, -1)
        groups = [
            ParameterGroup(np.array([0]), config.time_offset),
            ParameterGroup(np.array([GRAVITY]), config.gravity),
            ParameterGroup(of_camera[:, :3].ravel(), config.rotation, is_rotation=True),
        ]
        for rows in of_camera:
            parts = config.translation, config.focal, config.principal, config.radial
            position, *intrinsics = zip(np.split(rows[3:], [3, 4, 6]), parts, strict=True)
            limits = REFUTED_FOCAL_SIGMAS, REFUTED_SIGMAS, REFUTED_SIGMAS
            refuted = (ParameterGroup(*part, refuted_sigmas=s) for part, s in zip(intrinsics, limits, strict=True))
            groups += [ParameterGroup(*position), *refuted]
        sigmas = np.full(COMMON_PARAMETERS + of_camera.size, FIXED_SIGMA)
        sigmas[GYRO_SCALE] = max(config.gyro_scale_sigma, FIXED_SIGMA)
        walk = np.zeros(len(sigmas))
        if cameras > 1:
            sigmas[of_camera[:, 3:6]] = max(config.position_sigma_m, FIXED_SIGMA)
        corrected = tuple(group for group in groups if group.config.online)
        for group in corrected:
            sigmas[group.rows], walk[group.rows] = group.config.sigma, group.config.walk
        A = np.zeros((0, len(sigmas))) if inverse_depth_errors is None else inverse_depth_errors
        return cls(corrected, sigmas, config.max_correction_sigmas, walk, A)

    @property
    def is_unknown(self) -> npt.NDArray[np.bool_]:
        """(D,) Whether a parameter is an unknown of the adjustments, corrected or not."""
        return self.sigmas > FIXED_SIGMA

    @cached_property
    def is_of_images(self) -> npt.NDArray[np.bool_]:
        """(D,) Whether a parameter is a rotation or an intrinsic of a camera that is corrected."""
        return self._rows_of(*(group for group in self.groups if group.is_rotation or group.is_intrinsic))

    @cached_property
    def is_intrinsic(self) -> npt.NDArray[np.bool_]:
        """(D,) Whether a parameter is an intrinsic of a camera that is corrected."""
        return self._rows_of(*(group for group in self.groups if group.is_intrinsic))

    def _rows_of(self, *groups: ParameterGroup) -> npt.NDArray[np.bool_]:
        """(D,) Whether a parameter belongs to one of some groups."""
        rows = [group.rows for group in groups]
        return np.isin(np.arange(len(self.sigmas)), np.concatenate(rows) if rows else [])

    def are_plausible(self, applied: Array, mean: Array) -> bool:
        """Return whether corrections are plausible.

        Each that is applied has a limit, and so has the sum of the squares of all unknowns, which is χ² distributed:
        what no calibration explains, such as exchanged cameras, takes many of them, each of which may be plausible.

        Args:
            applied: (D,) Corrections that are applied.
            mean: (D,) Estimate of all corrections.
        """
        squares, limit = (mean / self.sigmas)[self.is_unknown] ** 2, self.max_sigmas
        is_each = bool((np.abs(applied) <= limit * self.sigmas).all())
        return is_each and bool(squares.sum() <= largest_chi2(len(squares), limit))

    def refutes_intrinsics(self, change: Array) -> bool:
        """Return whether a change (D,) shows that intrinsics were very wrong."""
        in_sigmas = np.abs(change) / self.sigmas
        limits = ((group.rows, group.refuted_sigmas) for group in self.groups)
        return any(limit is not None and bool((in_sigmas[rows] > limit).any()) for rows, limit in limits)
