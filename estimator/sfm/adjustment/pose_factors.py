"""Factors on the poses of images, by GTSAM: the gauge, a rig, measured poses and measured positions.

Without measured poses or positions, a prior on one pose and on the distance to a second fixes the gauge.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import X

from dronevio.estimator.sfm.adjustment.reprojection import BLOCK
from dronevio.estimator.sfm.adjustment.schur import Blocks
from dronevio.estimator.sfm.model import KnownPoses, PositionPriors
from dronevio.models.arrays import Array, Mask

Indices = npt.NDArray[np.int64]

FIXED_SIGMA = 1e-7
"""Standard deviation of a pose that is held: rotation [rad], position relative to the scale of the scene."""
RANGE_SIGMA = 1e-5
"""Standard deviation of the prior that fixes the scale, relative to the distance."""
RIG_SIGMAS = (1e-5, 1e-5)
"""Standard deviations of a known relative pose: rotation [rad], translation in units of the scene."""
WEAK_ROTATION_SIGMA_RAD = 0.3
"""Standard deviation of the rotation of one image beside measured positions [rad]."""


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A known pose of one camera in the frame of another, which determines the scale."""

    first: int
    """Index of the first image."""
    second: int
    """Index of the second image."""
    T_first_second: Array
    """(4, 4) Pose of the second camera in the frame of the first."""


@dataclass(frozen=True, eq=False)
class PoseFactors:
    """Factors on the poses of the images of an adjustment."""

    graph: gtsam.NonlinearFactorGraph
    """The factors, with the keys X(row)."""

    def cost(self, Ts_world_cam: Array) -> float:
        """Return the sum of the losses at the poses (I, 4, 4)."""
        return float(self.graph.error(self._values(Ts_world_cam)))

    def linearized(self, Ts_world_cam: Array) -> tuple[Blocks, Array]:
        """Return the information on the poses (I, 4, 4) in blocks, and the right-hand side (I, 6)."""
        rows, columns, blocks = [], [], []
        b = np.zeros((len(Ts_world_cam), BLOCK))
        linear = self.graph.linearize(self._values(Ts_world_cam))
        for index in range(linear.size()):
            factor = linear.at(index)
            J, target = factor.jacobian()
            images = [gtsam.Symbol(key).index() for key in factor.keys()]  # noqa: SIM118
            parts = [J[:, BLOCK * n : BLOCK * (n + 1)] for n in range(len(images))]
            for image, part in zip(images, parts, strict=True):
                b[image] += part.T @ target
                rows += [image] * len(images)
                columns += images
                blocks += [part.T @ other for other in parts]
        return Blocks(np.array(rows, np.int64), np.array(columns, np.int64), np.reshape(blocks, (-1, BLOCK, BLOCK))), b

    @cached_property
    def _images(self) -> list[int]:
        """Return the rows of the images that have a factor; iterating over GTSAM's set of keys ends the process."""
        factors = (self.graph.at(n) for n in range(self.graph.size()))
        return sorted({gtsam.Symbol(key).index() for factor in factors for key in factor.keys()})  # noqa: SIM118

    def _values(self, Ts_world_cam: Array) -> gtsam.Values:
        values = gtsam.Values()
        for image in self._images:
            values.insert(X(image), gtsam.Pose3(Ts_world_cam[image]))
        return values


def pose_factors(
    Ts_world_cam: Array,
    is_fixed: Mask,
    rig: Sequence[RelativePose],
    priors: KnownPoses | None,
    positions: PositionPriors | None,
) -> PoseFactors:
    """Return the factors on the poses of images.

    Args:
        Ts_world_cam: (I, 4, 4) Their current poses.
        is_fixed: (I,) Images whose poses are held.
        rig: Known relative poses.
        priors: Measured poses, which then determine the world frame.
        positions: Measured positions, which then determine the world frame.
    """
    graph = gtsam.NonlinearFactorGraph()
    _add_rig(graph, rig)
    if positions is not None:
        _add_positions(graph, positions, Ts_world_cam)
    elif priors is None:
        _fix_gauge(graph, Ts_world_cam, is_fixed, has_scale=bool(rig))
    else:
        _add_priors(graph, priors)
    return PoseFactors(graph)


def _add_rig(graph: gtsam.NonlinearFactorGraph, rig: Sequence[RelativePose]) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(RIG_SIGMAS, 3))
    for pair in rig:
        relative = gtsam.Pose3(pair.T_first_second)
        graph.push_back(gtsam.BetweenFactorPose3(X(pair.first), X(pair.second), relative, noise))


def _add_priors(graph: gtsam.NonlinearFactorGraph, priors: KnownPoses) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([priors.sigma_rad, priors.sigma_m], 3))
    for i in np.flatnonzero(priors.is_known).tolist():
        graph.push_back(gtsam.PriorFactorPose3(X(i), gtsam.Pose3(priors.Ts_world_cam[i]), noise))


def _add_positions(graph: gtsam.NonlinearFactorGraph, positions: PositionPriors, Ts_world_cam: Array) -> None:
    """Add priors on positions, and a weak one on a rotation, for positions on a line do not determine all of them."""
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(positions.cauchy_sigmas)
    for i in np.flatnonzero(np.isfinite(positions.cameras[:, 0])).tolist():
        noise = gtsam.noiseModel.Diagonal.Sigmas(positions.camera_sigmas[i])
        robust = gtsam.noiseModel.Robust.Create(loss, noise)
        graph.push_back(gtsam.GPSFactor(X(i), positions.cameras[i], robust))
    held = gtsam.Rot3(Ts_world_cam[0, :3, :3])
    weak = gtsam.noiseModel.Isotropic.Sigma(3, WEAK_ROTATION_SIGMA_RAD)
    graph.push_back(gtsam.PoseRotationPrior3D(X(0), held, weak))


def _fix_gauge(graph: gtsam.NonlinearFactorGraph, Ts_world_cam: Array, is_fixed: Mask, has_scale: bool) -> None:
    """Hold the fixed poses, or else the first, and its distance to the farthest one unless the scale is determined."""
    held = np.flatnonzero(is_fixed) if is_fixed.any() else np.array([0])
    first = int(held[0])
    distances = np.linalg.norm(Ts_world_cam[:, :3, 3] - Ts_world_cam[first, :3, 3], axis=1)
    scale = float(distances.max())
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([FIXED_SIGMA, FIXED_SIGMA * scale], 3))
    for i in held.tolist():
        graph.push_back(gtsam.PriorFactorPose3(X(i), gtsam.Pose3(Ts_world_cam[i]), noise))
    if not has_scale and len(held) == 1:
        farthest = int(np.argmax(distances))
        range_noise = gtsam.noiseModel.Isotropic.Sigma(1, RANGE_SIGMA * scale)
        graph.push_back(gtsam.RangeFactorPose3(X(first), X(farthest), scale, range_noise))
