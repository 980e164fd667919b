"""KITTI's scores, worked out by hand."""

import numpy as np
import pytest

from dronevio.eval.metrics.kitti import kitti_scores
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, pose_matrix


def road(frames: int, turn_deg: float = 0.0, step_m: float = 1.0) -> Array:
    """Return poses (N, 3, 4) along z, each rotated by a further angle about the vertical axis y."""
    n = np.arange(frames)
    R = exp_so3(np.outer(np.radians(turn_deg) * n, [0.0, 1.0, 0.0]))
    return pose_matrix(R, np.outer(step_m * n, [0.0, 0.0, 1.0]))[:, :3]


def test_kitti_rotation_errors_are_in_degrees() -> None:
    """A tenth of a degree per metre; a segment ends at the first frame beyond its length, one metre further."""
    found = kitti_scores(road(301), road(301, turn_deg=0.1))
    assert found.rpe_deg == pytest.approx(0.1, rel=1e-6)
    lengths, _, deg_per_100_m = zip(*found.by_length, strict=True)
    assert lengths == (100.0, 200.0)  # no frame lies beyond 300 m
    assert deg_per_100_m == pytest.approx((10.1, 10.05), rel=1e-6)
    first, second = 20, 10  # segments begin at every tenth frame, up to frames 190 and 90
    assert found.segments == first + second
    assert found.rotation_deg_per_100_m == pytest.approx((first * 10.1 + second * 10.05) / 30, rel=1e-6)


def test_kitti_aligns_the_first_estimated_frame() -> None:
    """Frames 5 to 10 of a curved road in another world frame: the error is zero, and that of a scale of 1.1 not."""
    truth = road(11, turn_deg=5.0)
    R, t_m = exp_so3(np.array([0.3, -0.2, 0.5])), np.array([7.0, 8.0, 9.0])
    frames = np.arange(5, 11)
    estimate = R @ truth[frames]
    estimate[:, :, 3] += t_m
    found = kitti_scores(truth, estimate, frames)
    assert (found.ate_m, found.rpe_m) == pytest.approx((0.0, 0.0), abs=1e-12)
    estimate[:, :, 3] *= 1.1
    found = kitti_scores(truth, estimate, frames)
    assert found.rpe_m == pytest.approx(0.1)
    assert found.ate_m == pytest.approx(0.1 * np.sqrt((0 + 1 + 4 + 9 + 16 + 25) / 6))
