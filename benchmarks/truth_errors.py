"""Errors of a ground truth: a constant inclination, a constant rate of its yaw, and a time offset.

The truth of a real flight is measured, too. Motion capture is inclined to gravity by some milliradians, its yaw turns
against gyroscope and images, and its clock is not that of the IMU. Four constants for a whole flight, no matter how
many estimates of it there are, are fitted to the estimates; the position and the yaw of each estimate are free in the
fit, so that its first pose does not decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.models.arrays import Array
from dronevio.models.quaternions import quat_product_wxyz
from dronevio.models.rotation import exp_so3, log_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

POSITION_SIGMA_M, ORIENTATION_SIGMA_RAD = 0.01, 0.003
"""Errors of an estimate by which positions [m] and orientations [rad] are weighted against each other."""
SCALES = np.array([0.01, 0.01, 0.001, 0.01])
"""Typical sizes of the four constants."""
SHIFT = 10.0
"""Added to the constants in these units: steps of derivatives are relative, and some 0.1 ms of a time offset."""


@dataclass(frozen=True)
class TruthErrors:
    """Constants that correct a ground truth."""

    inclination_rad: tuple[float, float] = (0.0, 0.0)
    """Rotation about the horizontal axes of the world that is missing in the truth [rad]."""
    yaw_rate_rad_s: float = 0.0
    """Rate at which the yaw of the orientations must turn in addition [rad/s]; positions are not turned."""
    delay_s: float = 0.0
    """How much later the truth is than its time stamps [s]."""

    def corrected(self, truth: Trajectory) -> Trajectory:
        """Return a ground truth without these errors."""
        R = exp_so3(np.array([*self.inclination_rad, 0.0]))
        yaw = np.zeros((len(truth), 3))
        yaw[:, 2] = self.yaw_rate_rad_s * (truth.t_ns - truth.t_ns[0]) * 1e-9
        turned = quat_wxyz_from_matrix(exp_so3(yaw) @ R)
        v = truth.velocity_m_s
        return Trajectory(
            truth.t_ns + round(1e9 * self.delay_s),
            truth.p_world_imu @ R.T,
            quat_product_wxyz(turned, truth.quat_wxyz),
            None if v is None else v @ R.T,
        )

    def __str__(self) -> str:
        x, y = 1e3 * np.array(self.inclination_rad)
        return (
            f"inclination {x:+.1f}, {y:+.1f} mrad, yaw {1e3 * self.yaw_rate_rad_s:+.3f} mrad/s,"
            f" time {1e3 * self.delay_s:+.1f} ms"
        )


def is_exact(path: Path) -> bool:
    """Return whether the truth of a recording folder is exact: that of a simulated flight."""
    return (path / "scenario.json").exists()


def fitted(truth: Trajectory, estimates: Sequence[Trajectory]) -> TruthErrors:
    """Return the errors of a ground truth that best explain the differences from estimates of one flight."""

    def of(shifted: Array) -> TruthErrors:
        x, y, rate, delay = (SCALES * (shifted - SHIFT)).tolist()
        return TruthErrors((x, y), rate, delay)

    def residuals(shifted: Array) -> Array:
        corrected = of(shifted).corrected(truth)
        return np.concatenate([_differences(corrected, estimate) for estimate in estimates])

    return of(least_squares(residuals, np.full(4, SHIFT), loss="soft_l1", diff_step=1e-3).x)


def _differences(truth: Trajectory, estimate: Trajectory) -> Array:
    """Return the weighted differences of position and orientation (6 N) after alignment of position and yaw.

    Times that the truth does not cover have none, so that their number does not depend on its time stamps.
    """
    true, rows = interpolate(truth, estimate.t_ns)
    found = np.zeros((len(estimate), 6))
    p, known = estimate.p_world_imu[rows], estimate.rotations[rows]
    aligned = align(true.p_world_imu, p)
    turned = np.swapaxes(true.rotations, -1, -2) @ aligned.R_truth_estimate @ known
    in_world = (true.rotations @ log_so3(turned)[..., None])[..., 0]
    in_world[:, 2] -= np.median(in_world[:, 2])
    found[rows, :3] = (aligned.positions(p) - true.p_world_imu) / POSITION_SIGMA_M
    found[rows, 3:] = in_world / ORIENTATION_SIGMA_RAD
    return found.ravel()
