"""Associations of estimated with true poses, with values worked out by hand."""

from typing import get_args

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.eval.metrics import Association, associate
from dronevio.models.errors import EvaluationError
from dronevio.models.state import Trajectory


@pytest.mark.parametrize(
    ("association", "accepted_ns", "refused_ns"),
    [("interpolate", 500_000_000, 501_000_000), ("nearest", 20_000_000, 22_000_000), ("evo", 18_000_000, 22_000_000)],
)
def test_default_gaps_of_the_associations(association: Association, accepted_ns: int, refused_ns: int) -> None:
    """Estimated poses halfway between true ones: within a gap of 0.5 s, or no more than 10 ms from the nearest."""

    def poses(t_ns: npt.NDArray[np.int64]) -> Trajectory:
        return Trajectory(t_ns, np.zeros((len(t_ns), 3)), np.tile([1.0, 0, 0, 0], (len(t_ns), 1)))

    def halfway(gap_ns: int) -> tuple[Trajectory, Trajectory]:
        return poses(gap_ns * np.arange(5)), poses(gap_ns * np.arange(4) + gap_ns // 2)

    assert len(associate(*halfway(accepted_ns), association)[0]) == 4
    with pytest.raises(EvaluationError, match="have 0 poses in common"):
        associate(*halfway(refused_ns), association)


@pytest.mark.parametrize("association", get_args(Association))
def test_associations_keep_all_fields_of_an_estimate(association: Association) -> None:
    n = np.arange(4.0)
    p, quat, v, b_gyro, b_accel = np.outer(n, np.ones(3)), np.tile([1.0, 0, 0, 0], (4, 1)), *np.ones((3, 4, 3))
    estimate = Trajectory(10**9 * np.arange(4), p, quat, v, b_gyro, 2.0 * b_accel, n[:, None, None] * np.ones((15, 15)))
    _, found = associate(estimate, estimate, association)
    for name in (
        "t_ns",
        "p_world_imu",
        "quat_wxyz",
        "velocity_m_s",
        "gyro_bias_rad_s",
        "accel_bias_m_s2",
        "covariance",
    ):
        np.testing.assert_array_equal(getattr(found, name), getattr(estimate, name), err_msg=name)
