"""Associations of estimated poses with true ones, worked out by hand."""

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.eval.metrics import associate
from dronevio.models.errors import EvaluationError
from dronevio.models.state import Trajectory


@pytest.mark.parametrize(
    ("how", "bridged_ns", "refused_ns"),
    [("interpolate", 500_000_000, 501_000_000), ("nearest", 20_000_000, 22_000_000), ("evo", 18_000_000, 22_000_000)],
)
def test_default_gaps_of_the_associations(how: str, bridged_ns: int, refused_ns: int) -> None:
    """Estimated poses amid true ones: within a gap of 0.5 s, or no more than 10 ms from the nearest."""

    def poses(t_ns: npt.NDArray[np.int64]) -> Trajectory:
        return Trajectory(t_ns, np.zeros((len(t_ns), 3)), np.tile([1.0, 0, 0, 0], (len(t_ns), 1)))

    for gap_ns, found in ((bridged_ns, 4), (refused_ns, None)):
        truth, estimate = poses(gap_ns * np.arange(5)), poses(gap_ns * np.arange(4) + gap_ns // 2)
        if found is None:
            with pytest.raises(EvaluationError, match="have 0 poses in common"):
                associate(truth, estimate, how)  # type: ignore[arg-type]
        else:
            assert len(associate(truth, estimate, how)[0]) == found  # type: ignore[arg-type]


@pytest.mark.parametrize("how", ["interpolate", "nearest", "evo"])
def test_associations_keep_all_that_an_estimate_holds(how: str) -> None:
    n = np.arange(4.0)
    p, quat, v, b_gyro, b_accel = np.outer(n, np.ones(3)), np.tile([1.0, 0, 0, 0], (4, 1)), *np.ones((3, 4, 3))
    estimate = Trajectory(10**9 * np.arange(4), p, quat, v, b_gyro, 2.0 * b_accel, n[:, None, None] * np.ones((15, 15)))
    _, found = associate(estimate, estimate, how)  # type: ignore[arg-type]
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
