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


@pytest.mark.parametrize(("beyond_ns", "known"), [(0, True), (1_000, True), (1_001, False), (100_000, False)])
def test_truth_is_not_extrapolated_beyond_a_rounded_stamp(beyond_ns: int, known: bool) -> None:
    """The truth moves at 1 m/s for a second; estimated poses are before its first and after its last pose."""
    t_ns = 10**9 + 10**7 * np.arange(101)
    p, still = np.outer((t_ns - t_ns[0]) * 1e-9, [1.0, 0.0, 0.0]), np.tile([1.0, 0, 0, 0], (101, 1))
    truth = Trajectory(t_ns, p, still)
    wanted_ns = np.array([t_ns[0] - beyond_ns, *t_ns[40:43], t_ns[-1] + beyond_ns])
    true, estimated = associate(truth, Trajectory(wanted_ns, np.zeros((5, 3)), still[:5]))
    assert estimated.t_ns.tolist() == true.t_ns.tolist() == (wanted_ns if known else wanted_ns[1:-1]).tolist()
    x_m = [0.0, 0.4, 0.41, 0.42, 1.0] if known else [0.4, 0.41, 0.42]
    np.testing.assert_array_equal(true.p_world_imu, p[[round(100 * x) for x in x_m]])


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
