"""Intrinsics of cameras without a calibration: what is known of them beforehand, and which of them images determine.

A camera that flies straight ahead, or two images of a plane, determine neither focal length nor distortion, and the
least squares then choose absurd ones. Therefore each parameter has a prior: the focal length that EXIF data or an
assumed field of view give, and small distortion. While a reconstruction grows, focal length and k1 are estimated with
these priors; at the end k2 is, too, and those are held at the prior that the images do not determine.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets.image_set import FocalSource
from dronevio.models.reconstruction import SelfCalibration

FOCAL_SIGMAS: Mapping[FocalSource, float] = MappingProxyType(
    {"calibration": 0.02, "exif-35mm": 0.1, "exif-focal-plane": 0.1, "assumed": 0.3}
)
"""Standard deviation of a focal length by its source, relative to it."""
DISTORTION_SIGMAS = (0.2, 0.1)
"""Standard deviations of the radial distortion coefficients k1 and k2 of a pinhole."""
PLAUSIBLE_SIGMAS = 3.0
"""Largest deviation from the first guess in an adjustment while a reconstruction grows, in standard deviations."""
EVIDENCE_SIGMAS = 5.0
"""Ratio of a distortion coefficient to its standard deviation from which images determine it."""
MAX_FOCAL_SHARE = 0.5
"""Largest ratio of the standard deviation of a focal length to that of its prior at which images determine it."""
LARGE_DISTORTION = 0.5
"""Distortion coefficient above which it needs evidence, too, if it is the only one."""
PARAMETERS = 3
"""Number of parameters of a pinhole that are estimated: focal length, k1, k2."""
_NAMES = ("f", "k1", "k2")
_RADII = 200


@dataclass(frozen=True)
class IntrinsicsPrior:
    """What is known of a camera before its images are adjusted, and which of its parameters are estimated."""

    camera: CameraModel
    """The first guess."""
    focal_sigma: float = FOCAL_SIGMAS["assumed"]
    """Standard deviation of its focal length, relative to it."""
    distortion_sigmas: tuple[float, float] = DISTORTION_SIGMAS
    """Standard deviations of k1 and k2 of a pinhole."""
    estimated: int = 2
    """Number of parameters that are estimated, of focal length, k1, k2 in this order. Of a fisheye, all are."""

    def held(self, camera: CameraModel) -> CameraModel:
        """Return a camera with the values of the prior where a parameter is not estimated."""
        if not self.is_pinhole:
            return camera
        own = np.array([camera.fx, *camera.distortion[:2]])
        f, k1, k2 = np.where(np.arange(3) < self.estimated, own, self.mean).tolist()
        return replace(camera, fx=f, fy=f, distortion=(k1, k2, 0.0, 0.0))

    def is_plausible(self, camera: CameraModel) -> bool:
        """Return whether all parameters of a pinhole are within three standard deviations; a fisheye always is."""
        if not self.is_pinhole:
            return True
        deviation = np.array([camera.fx, *camera.distortion[:2]]) - self.mean
        return bool((np.abs(deviation) <= PLAUSIBLE_SIGMAS * self.sigmas).all())

    @property
    def is_pinhole(self) -> bool:
        """Whether the camera is a pinhole with radial distortion; otherwise it is a fisheye."""
        return self.camera.lens == "radtan"

    @property
    def mean(self) -> Array:
        """(3,) Focal length [px], k1 and k2 of the first guess of a pinhole."""
        return np.array([self.camera.fx, *self.camera.distortion[:2]])

    @property
    def sigmas(self) -> Array:
        """(3,) Standard deviations of focal length [px], k1 and k2 of a pinhole."""
        return np.array([self.focal_sigma * self.camera.fx, *self.distortion_sigmas])


def self_calibration(prior: IntrinsicsPrior, covariance: Array | None) -> SelfCalibration:
    """Return which parameters of a camera are estimated.

    Args:
        prior: The prior, which states it.
        covariance: Covariance of the parameters as `intrinsics_covariances` orders them; None if all are held.
    """
    sigmas = np.empty(0) if covariance is None else np.sqrt(np.diag(covariance))
    if not prior.is_pinhole:
        return SelfCalibration(dict(zip(("f", "k1", "k2", "k3", "k4"), sigmas.tolist(), strict=False)))
    estimated = _NAMES[: prior.estimated]
    return SelfCalibration(dict(zip(estimated, sigmas.tolist(), strict=False)), _NAMES[prior.estimated :])


def without_undetermined(prior: IntrinsicsPrior, camera: CameraModel, covariance: Array) -> IntrinsicsPrior:
    """Return the prior of a pinhole with those parameters held that its images do not determine.

    Args:
        prior: The prior with which the camera was estimated.
        camera: The estimate.
        covariance: (3, 3) Covariance of focal length [px], k1 and k2; infinite if the images do not determine it.
    """
    deviation = np.array([camera.fx, *camera.distortion[:2]]) - prior.mean
    sigmas = np.sqrt(np.diag(covariance))
    evidence = np.abs(deviation) / np.maximum(sigmas, 1e-12)
    estimated = prior.estimated
    is_determined = sigmas[0] < MAX_FOCAL_SHARE * prior.sigmas[0]
    has_evidence = estimated > 1 and evidence[estimated - 1] >= EVIDENCE_SIGMAS
    is_small = estimated == 2 and abs(camera.distortion[0]) <= LARGE_DISTORTION and is_determined
    if estimated > 1 and not (is_monotonic(camera) and (has_evidence or is_small)):
        estimated -= 1
    elif not is_determined:
        estimated = 0
    return replace(prior, estimated=estimated)


def is_monotonic(camera: CameraModel) -> bool:
    """Return whether the radial distortion of a pinhole increases up to the corners of its image."""
    k1, k2 = camera.distortion[:2]
    x = max(camera.cx, camera.width - 1 - camera.cx) / camera.fx
    y = max(camera.cy, camera.height - 1 - camera.cy) / camera.fy
    corner = float(np.hypot(x, y))
    # The undistorted radius of the corner lies below twice its distorted one, or the lens is no pinhole.
    r2 = np.square(np.linspace(0.0, 2.0 * corner, _RADII))
    distorted = np.sqrt(r2) * (1.0 + r2 * (k1 + r2 * k2))
    slope = 1.0 + r2 * (3.0 * k1 + r2 * 5.0 * k2)
    reached = np.flatnonzero(distorted >= corner)
    return bool(len(reached)) and bool((slope[: reached[0] + 1] > 0.0).all())
